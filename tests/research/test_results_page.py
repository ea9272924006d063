import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.experiments.declaration import load_study
from guiderail.tools.tables import read_table, write_table
from research.figures import reproduce
from research.figures.thesis import THESIS
from research.results_page import FIGURES, OF_SMOOTHNESS, write_results
from research.studies import study_names, study_path


@pytest.fixture
def finished(tmp_path):
    rows = [
        {
            "method": "skgrl", "after_episodes": 40, "eval_set": "gantry", "seed": seed, "success_rate": rate,
            "training_episodes": 40, "training_episodes_to_convergence": after, "training_max_commanded_violation": -1e-4,
            "training_collisions": 1, "training_wall_time": 1800.0,
        }
        for seed, rate, after in ((30, 1.0, 12), (31, 0.97, None))
    ]  # fmt: skip
    rows.append({"method": "nothing", "after_episodes": 0, "eval_set": "gantry", "seed": 0, "success_rate": 0.14})
    write_table(tmp_path / "study" / "connector", pd.DataFrame(rows))
    return tmp_path / "study"


def test_every_seed_stands_beside_the_thesis_with_what_differs(finished, tmp_path):
    page = write_results([finished], tmp_path / "results").read_text()
    assert "| skgrl | 40 | rails | 100%, 97% | 12, never | within | 2 | 1.00 |" in page
    assert "| nothing | – | rails | 14% | – | – | – | – |" in page
    assert THESIS["5.9"] in page
    assert "guiderail study connector --out studies" in page
    (differs,) = (line for line in page.splitlines() if line.startswith("Differs from the thesis in (skgrl)"))
    assert "reward shaped (thesis: sparse)" in differs
    assert "Declared by the study, and not in this table: kgrl" in page


def test_a_study_that_judges_nothing_has_its_rows_too(finished, tmp_path):
    table = read_table(finished / "connector.csv").iloc[:2].drop(columns="success_rate")
    write_table(tmp_path / "unjudged" / "connector", table.assign(eval_set=""))
    page = write_results([tmp_path / "unjudged"], tmp_path / "results").read_text()
    assert "| skgrl | 40 | – | – | 12, never | within | 2 | 1.00 |" in page


def test_a_sweep_has_a_picture_and_says_where_each_method_breaks(tmp_path):
    rates = {"rl_sct": (1.0, 1.0, 0.95, 0.85, 0.6, 0.0), "uniform_random": (0.05,) * 6}
    rows = [
        {"method": method, "after_episodes": 100 * learned, "eval_set": one.name, "seed": 110, "episodes": 40,
         "success_rate": rate, "training_episodes": 100 if learned else None, "training_episodes_to_convergence": None,
         "training_max_commanded_violation": -1e-4, "training_collisions": 0, "training_wall_time": 600.0}
        for method, learned in (("rl_sct", True), ("uniform_random", False))
        for one, rate in zip(load_study(study_path("pouring_sweep")).judgements, rates[method], strict=True)
    ]  # fmt: skip
    write_table(tmp_path / "study" / "pouring_sweep", pd.DataFrame(rows))
    page, picture = write_results([tmp_path / "study"], tmp_path / "results"), tmp_path / "results/pouring_sweep.svg"
    text, drawn = page.read_text(), picture.read_bytes()
    assert "](pouring_sweep.svg)" in text
    assert "| rl_sct | 100% | 100% | 95% | 85% | 60% | 0% | 30 |" in text
    assert "| white | 5% | 5% | 5% | 5% | 5% | 5% | from the easiest on |" in text
    assert "| rl_sct | 100 | – | – | never | within | 0 | 0.17 |" in text
    assert "| white | – |" not in text
    assert "Declared by the study, and not in this table: rule," in text
    write_results([], tmp_path / "results")
    assert picture.read_bytes() == drawn


def test_the_benchmark_of_smoothness_has_a_line_for_every_way_to_explore(tmp_path):
    row = {"method": "KGRL", "place": "free", **dict.fromkeys(OF_SMOOTHNESS[2:], 0.25), "ldlj_measured_angular": 1.0}
    write_table(tmp_path / "study" / "smoothness", pd.DataFrame([row, row | {"method": "gSDE"}]))
    page = write_results([tmp_path / "study"], tmp_path / "results").read_text()
    assert page.count("| free |" + " 0.25 |" * 7) == 2
    assert "ldlj" not in page


def test_the_page_is_written_anew_from_what_is_stored(finished, tmp_path):
    first = write_results([finished], tmp_path / "results").read_bytes()
    assert write_results([], tmp_path / "results").read_bytes() == first


def test_what_is_no_study_is_refused(tmp_path):
    with pytest.raises(InputError, match="holds no table of a study and no figure"):
        write_results([tmp_path], tmp_path / "results")
    with pytest.raises(InputError, match="name folders of them"):
        write_results([], tmp_path / "results")


def test_figures_stand_beside_studies_that_there_are():
    assert set(FIGURES) <= set(study_names())
    assert {number for numbers in FIGURES.values() for number in numbers} <= set(THESIS)


def test_every_figure_of_the_thesis_has_its_line_and_those_that_were_made_their_numbers(finished, tmp_path):
    reproduce("table 4.1", out=tmp_path / "figures")
    page = write_results([finished, tmp_path / "figures"], tmp_path / "results").read_text()
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in page.splitlines() if line.startswith("| ")}
    for number, words in THESIS.items():
        assert words in lines[number]
    assert "the presets of that name have the thesis's values: yes, all" in lines["table 4.1"]
    assert "`guiderail reproduce 'table 4.1'`" in lines["table 4.1"]
    assert "study [connector](#connector)" in lines["5.9"]
    assert str(tmp_path) not in page
    assert write_results([], tmp_path / "results").read_text() == page


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"seconds": "x", "command": "", "figure": ""}', "[" * 9999])
def test_what_no_figure_left_is_refused(content, tmp_path):
    (tmp_path / "figure_5_9.json").write_text(content)
    with pytest.raises(InputError, match="not what guiderail reproduce leaves"):
        write_results([tmp_path], tmp_path / "results")
