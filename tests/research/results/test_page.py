"""Pages of results."""

import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.tables import read_table, write_table
from guiderail_studies.declaration import load_study
from research.command import run_program
from research.figures import reproduce
from research.figures.thesis import THESIS
from research.results.__main__ import main
from research.results.page import FIGURES_OF_STUDIES, PROGRAMS, store, write_pages
from research.studies import study_names, study_path


def write_results(folders, out):
    """Store results in a folder and return the text of all its pages."""
    store(folders, out)
    return "\n".join(page.read_text() for page in write_pages(out, out))


@pytest.fixture
def connector_study(tmp_path):
    """Return the folder of a study of the connector, with the rows of two seeds and of a baseline."""
    rows = [
        {
            "method": "skgrl", "after_episodes": 40, "eval_set": "gantry", "seed": seed, "success_rate": rate,
            "episodes": 100, "training_episodes": 40, "training_episodes_to_convergence": converged,
            "training_max_commanded_violation": -1e-4, "training_collisions": 1, "training_wall_time": 1800.0,
            "training_ended_in_collision": 3, "training_ended_in_spill": spills,
            "max_commanded_violation": -1e-4, "violating_episodes": 0, "training_violating_episodes": 0,
            "peak_force": 10.0, "training_peak_force": 10.0,
        }
        for seed, rate, converged, spills in ((30, 1.0, 12, 0), (31, 0.97, None, 2))
    ]  # fmt: skip
    rows.append({"method": "nothing", "after_episodes": 0, "eval_set": "gantry", "seed": 0, "success_rate": 0.14})
    write_table(tmp_path / "study" / "connector", pd.DataFrame(rows))
    return tmp_path / "study"


def test_page_has_seeds_thesis_results_and_differences(connector_study, tmp_path):
    page = write_results([connector_study], tmp_path / "results")
    assert "| skgrl | 40 | gantry | 100%, 97% | 12, never | none | 2 | 6 + 2 spills of 80 | 1.00 |" in page
    assert "| nothing | – | gantry | 14% | – | – | – | – | – |" in page
    assert THESIS["5.9"] in page
    assert "guiderail study research/studies/connector.yaml --out studies" in page
    (differs,) = (line for line in page.splitlines() if line.startswith("Differences from the thesis (skgrl)"))
    assert "reward shaped (thesis: sparse)" in differs
    assert "Not run: skgrl, seeds 32–34; kgrl." in page


def test_common_differences_of_methods_are_stated_once(connector_study, tmp_path):
    table = read_table(connector_study / "connector.csv")
    methods = pd.concat([table, table[table["method"] == "skgrl"].assign(method="kgrl")], ignore_index=True)
    write_table(tmp_path / "both" / "connector", methods)
    page = write_results([tmp_path / "both"], tmp_path / "results")
    assert "Differences from the thesis (skgrl, kgrl): " in page
    assert page.count("reward shaped (thesis: sparse)") == 1
    assert "\n- skgrl: history of poses: commanded (thesis: measured)" in page


def test_page_has_the_rows_of_a_study_without_evaluation(connector_study, tmp_path):
    table = read_table(connector_study / "connector.csv").iloc[:2]
    table = table.drop(columns="success_rate").assign(eval_set="", training_success_rate=0.5)
    write_table(tmp_path / "training" / "connector", table)
    page = write_results([tmp_path / "training"], tmp_path / "results")
    assert "| skgrl | 40 | – | – | 12, never | none | 2 | 6 + 2 spills of 80 | 1.00 |" in page


def test_sweep_has_a_picture_and_breaking_points(tmp_path):
    rates = {"rl_sct": (1.0, 1.0, 0.95, 0.85, 0.6, 0.0), "uniform_random": (0.05,) * 6}
    rows = [
        {"method": method, "after_episodes": 100 * learned, "eval_set": eval_set.name, "seed": 110, "episodes": 40,
         "success_rate": rate, "training_episodes": 100 if learned else None, "training_episodes_to_convergence": None,
         "training_max_commanded_violation": -1e-4, "training_collisions": 0, "training_wall_time": 600.0,
         "training_ended_in_collision": 0, "training_ended_in_spill": 0}
        for method, learned in (("rl_sct", True), ("uniform_random", False))
        for eval_set, rate in zip(load_study(study_path("pouring_sweep")).eval_sets, rates[method], strict=True)
    ]  # fmt: skip
    write_table(tmp_path / "study" / "pouring_sweep", pd.DataFrame(rows))
    page, picture = write_results([tmp_path / "study"], tmp_path / "results"), tmp_path / "results/pouring_sweep.svg"
    content = picture.read_bytes()
    assert "](pouring_sweep.svg)" in page
    assert "| rl_sct | 100% | 100% | 95% | 85% | 60% | 0% | 30 |" in page
    assert "| uniform_random | 5% | 5% | 5% | 5% | 5% | 5% | from the easiest on |" in page
    assert "| rl_sct | 100 | – | – | never | none | 0 | 0 of 100 | 0.17 |" in page
    assert "| uniform_random | – |" not in page
    assert "Not run: " in page
    write_results([], tmp_path / "results")
    assert picture.read_bytes() == content


def test_smoothness_table_has_the_selected_columns(tmp_path):
    columns = PROGRAMS["smoothness"]
    row = {"method": "KGRL", "place": "free", **dict.fromkeys(columns[2:], 0.25), "ldlj_measured_angular": 1.0}
    write_table(tmp_path / "study" / "smoothness", pd.DataFrame([row, row | {"method": "gSDE"}]))
    page = write_results([tmp_path / "study"], tmp_path / "results")
    assert page.count("| free |" + " 0.25 |" * 7) == 2
    assert "ldlj" not in page


def test_pages_are_identical_when_written_from_stored_results(connector_study, tmp_path):
    first = write_results([connector_study], tmp_path / "results")
    assert write_results([], tmp_path / "results") == first


def test_folders_without_results_are_refused(tmp_path, capsys):
    with pytest.raises(InputError, match="holds no table of a study and no figure"):
        store([tmp_path], tmp_path / "results")
    with pytest.raises(SystemExit) as ended:
        run_program(main, ["--out", str(tmp_path / "results")])
    assert ended.value.code == 2
    assert "name folders that have them" in capsys.readouterr().err


def test_figures_of_studies_exist():
    assert set(FIGURES_OF_STUDIES) <= set(study_names())
    assert {number for numbers in FIGURES_OF_STUDIES.values() for number in numbers} <= set(THESIS)


def test_figures_page_has_all_figures_with_results(connector_study, tmp_path):
    reproduce("table 4.1", out=tmp_path / "figures")
    page = write_results([connector_study, tmp_path / "figures"], tmp_path / "results")
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in page.splitlines() if line.startswith("| ")}
    for number, words in THESIS.items():
        assert words in lines[number]
    assert "the presets of that name have the thesis's values: yes, all" in lines["table 4.1"]
    assert "`python -m research.figures 'table 4.1'`" in lines["table 4.1"]
    assert "study [connector](connector.md#connector)" in lines["5.9"]
    assert str(tmp_path) not in page


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"seconds": "x", "command": "", "figure": ""}', "[" * 9999])
def test_invalid_figure_file_is_refused(content, tmp_path):
    (tmp_path / "figure_5_9.json").write_text(content)
    with pytest.raises(InputError, match=r"was not written by python -m research\.figures"):
        store([tmp_path], tmp_path / "results")
