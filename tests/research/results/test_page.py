"""Pages of results."""

import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.tables import read_table, write_table
from guiderail_studies.declaration import load_study
from research.command import run_program
from research.results.__main__ import main
from research.results.page import PROGRAMS, store, write_pages
from research.studies import study_path


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
            "peak_force": 10.0, "training_peak_force": 10.0, "success_low": 0.05, "success_high": 0.3,
        }
        for seed, rate, converged, spills in ((30, 1.0, 12, 0), (31, 0.97, None, 2))
    ]  # fmt: skip
    nothing = {key: value for key, value in rows[0].items() if not key.startswith("training")}
    rows.append(nothing | {"method": "nothing", "after_episodes": 0, "seed": 0, "success_rate": 0.14})
    write_table(tmp_path / "study" / "connector", pd.DataFrame(rows))
    return tmp_path / "study"


def test_page_has_one_row_for_a_method_and_no_seeds(connector_study, tmp_path):
    page = write_results([connector_study], tmp_path / "results")
    assert "The same for all methods: training episodes (seeds): 40 (30, 31); " in page
    assert "| sKGRL | 98 (97–100) |" in page
    assert "guiderail study research/studies/NAME.yaml --out studies" in page
    assert "- `connector`, not run: skgrl, seeds 32–34; kgrl" in page
    assert "| `connector` |" not in page


def test_evaluation_sets_are_in_the_row_of_a_method(connector_study, tmp_path):
    table = read_table(connector_study / "connector.csv").assign(method="other")
    elsewhere = table.assign(eval_set="elsewhere", success_rate=0.5, max_commanded_violation=4e-4, violating_episodes=2)
    for episodes, cells in (
        (100, "gantry: 98 (97–100); elsewhere: 50"),
        (20, "gantry: 98 (97–100); elsewhere: 50, of 20 each"),
    ):
        both = pd.concat([table, elsewhere.assign(episodes=episodes)])
        write_table(tmp_path / "both" / "connector", both[both["training_episodes"].notna()])
        page = write_results([tmp_path / "both"], tmp_path / "results")
        assert f"| `connector` | other | 40 (30, 31) | {cells} | 0.40 mm, in 4 episodes |" in page


def test_equal_numbers_of_episodes_are_stated_once(connector_study, tmp_path):
    table = read_table(connector_study / "connector.csv").assign(method="other", episodes=20)
    both = pd.concat([table, table.assign(eval_set="elsewhere", success_rate=0.5)])
    write_table(tmp_path / "both" / "connector", both[both["training_episodes"].notna()])
    page = write_results([tmp_path / "both"], tmp_path / "results")
    assert "| gantry: 98 (97–100); elsewhere: 50; of 20 each | none |" in page


def test_differences_of_each_study_are_a_table(connector_study, tmp_path):
    table = read_table(connector_study / "connector.csv")
    methods = pd.concat([table, table[table["method"] == "skgrl"].assign(method="kgrl")], ignore_index=True)
    write_table(tmp_path / "both" / "connector", methods)
    write_results([tmp_path / "both"], tmp_path / "results")
    differences = read_table(tmp_path / "results" / "differences.csv").set_index("difference")["methods"]
    assert differences["reward shaped (thesis: sparse)"] == "skgrl kgrl"
    assert differences["history of poses: commanded (thesis: measured)"] == "skgrl"


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
    assert "| success below 90% at | mug offset [mm], 0 to 60 |" in page
    assert "| rl_sct | 30 |" in page
    assert "Below 90% at every value: uniform_random." in page
    assert "| uniform_random |" not in page
    assert ", not run: " in page
    write_results([], tmp_path / "results")
    assert picture.read_bytes() == content


def test_smoothness_table_has_the_selected_columns(tmp_path):
    columns = PROGRAMS["smoothness"]
    row = {"method": "KGRL", "place": "free", **dict.fromkeys(columns[1:], 0.25), "ldlj_measured_angular": 1.0}
    rows = [row, row | {"place": "connector", "peak_force": 3.0}, row | {"method": "gSDE"}]
    write_table(tmp_path / "study" / "smoothness", pd.DataFrame(rows))
    page = write_results([tmp_path / "study"], tmp_path / "results")
    assert "Place: connector; other places in the table: free." in page
    assert "| KGRL |" + " 0.25 |" * 3 + " 3 |" in page
    assert "gSDE" not in page
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
    assert "name folders of finished studies" in capsys.readouterr().err


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"seconds": "x", "command": "", "figure": ""}', "[" * 9999])
def test_invalid_figure_file_is_refused(content, tmp_path):
    (tmp_path / "figure_5_9.json").write_text(content)
    with pytest.raises(InputError, match=r"was not written by python -m research\.figures"):
        store([tmp_path], tmp_path / "results")
