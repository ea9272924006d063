"""Tables of all methods on the pages of results and in the README."""

import io
import sys
from functools import cache
from pathlib import Path

import pandas as pd
import pytest

from guiderail.tools.learning.learner_config import LEARNERS
from guiderail.tools.tables import read_table
from guiderail_studies.declaration import load_study
from research.results.methods import (
    README_COLUMNS,
    README_TITLES,
    hard_tasks_table,
    knowledge,
    methods_table,
    offsets,
    replace_table,
    task_table,
)
from research.results.page import PAGES, write_pages
from research.results.sections import BASELINES, NO_DEMONSTRATION, ONLY_NAMED, SECTIONS, Row, Section
from research.studies import study_path

ROOT = Path(__file__).parents[3]
TABLES, PAGES_FOLDER = ROOT / "research" / "results", ROOT / "docs" / "results"


def rows(text):
    """Return the cells of the body rows of all Markdown tables in a text."""
    lines = [line for line in text.splitlines() if line.startswith("| ") and not line.startswith("| ---")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in cells if row[0] not in ("method", "task")]


@pytest.fixture(scope="module")
def hard_tasks():
    """Return the table of the hard tasks of the stored results, which takes most of a second."""
    return hard_tasks_table(TABLES)


def test_pages_have_the_table_of_the_stored_results(hard_tasks):
    for page, table in (
        ("README.md", hard_tasks_table(TABLES, README_COLUMNS, README_TITLES)),
        ("docs/results.md", hard_tasks),
    ):
        text = (ROOT / page).read_text(encoding="utf-8")
        assert replace_table(text, table) == text, f"{page} is stale: python -m research.results"


def test_hard_tasks_table_has_at_most_ten_rows_of_hard_tasks(hard_tasks):
    titles = [row[0] for row in rows(hard_tasks)]
    assert 4 <= len(titles) <= 10
    assert all("hard" in title for title in titles)


def test_pages_have_the_stored_results(tmp_path, monkeypatch):
    monkeypatch.setattr("research.results.page.draw_sweeps", lambda *_: None)  # tested in test_page.py
    monkeypatch.setattr("research.results.methods.read_table", cache(read_table))  # each table has many rows of pages
    for page in write_pages(TABLES, tmp_path):
        stored = PAGES_FOLDER / page.name
        assert page.read_text() == stored.read_text(), f"{stored} is stale: python -m research.results"


def test_rows_of_sections_name_methods_of_studies():
    assert set(SECTIONS) == set(PAGES)
    for row in (row for sections in SECTIONS.values() for section in sections for row in section.rows):
        study = load_study(study_path(row.study))
        assert row.method in study.methods, f"{row.study} has no {row.method}"
        assert row.eval_set is None or row.eval_set in [eval_set.name for eval_set in study.eval_set]
        assert row.eval_set is not None or len(study.eval_set) < 2, f"{row.study} has several evaluation sets"


def test_page_names_studies_without_a_row():
    page = (PAGES_FOLDER / "connector.md").read_text("utf-8")
    for name in (name for name in ONLY_NAMED if name.startswith("connector")):
        assert load_study(study_path(name)).task == "BncConnector"
        assert f"`{name}`" in page.partition("Only in `research/results`")[2].partition(".")[0]
        assert f"| `{name}` |" not in page


def test_guided_methods_are_rows_of_their_section():
    for section in (section for sections in SECTIONS.values() for section in sections):
        assert set(section.guided) <= {row.name for row in section.rows}


def test_missing_study_is_left_out(tmp_path):
    name = "connector_hard_baselines.csv"
    (tmp_path / name).write_bytes((TABLES / name).read_bytes())
    (sentence,) = (line for line in task_table("BncConnector", tmp_path).splitlines() if line.startswith("Without"))
    assert rows(task_table("BncConnector", tmp_path)) == []
    names = [part.split(" (")[0].rpartition(" ")[0] for part in sentence.removeprefix("Without learning: ").split("; ")]
    assert names == list(BASELINES)
    assert task_table("BncConnector", tmp_path / "nowhere") == ""
    assert rows(hard_tasks_table(tmp_path)) == []
    assert len(NO_DEMONSTRATION) == len(BASELINES)


HEADER = (
    "method,seed,after_episodes,eval_set,episodes,success_rate,success_low,success_high,max_commanded_violation,"
    "violating_episodes,peak_force,training_episodes,training_success_rate,training_episodes_to_convergence,"
    "training_max_commanded_violation,training_violating_episodes,training_peak_force,training_ended_in_collision,"
    "training_ended_in_spill\n"
)


def test_table_has_the_last_evaluation_of_each_seed(tmp_path):
    (tmp_path / "connector_hard_converged.csv").write_text(
        HEADER
        + "residual,7,20,fresh,100,0.1,0,0,0,0,1.0,20,0.1,,0,0,2.0,1,0\n"
        + "residual,7,60,fresh,100,0.98,0,0,0.0001,3,12.25,60,0.8,15,0.0004,5,31.0,3,1\n"
        + "residual,8,60,fresh,100,1.0,0,0,-0.1,0,14.5,60,0.8,,0.0,0,20.0,3,0\n"
        + "kgrl,7,60,fresh,100,0.97,0,0,-0.1,0,12.25,60,0.8,15,-0.1,0,31.0,2,0\n"
    )
    kgrl, residual = rows(task_table("BncConnector", tmp_path))
    assert kgrl[0] == "KGRL"
    assert residual[1:] == [
        "60 (7, 8)", "99 (98–100)", "never (15–never)", "6", "0.40 mm, in 8 episodes", "14.5 (31.0)",
    ]  # fmt: skip
    (row,) = rows(hard_tasks_table(tmp_path))
    effort = "60 (1); residual RL: 60 (2)"
    # Residual RL: 3 of 200 held-out episodes have violations (1.5 %), 7 of 120 training episodes were stopped (6 %).
    assert row == [
        "Connector, hard, converged contact",
        "KGRL 97 (one seed)",
        "99 (98–100)",
        "– / –",
        "3 / 6",
        "0 / 2",
        effort,
    ]


def test_guided_methods_are_compared_with_the_best_peer(tmp_path):
    template = "{},{},60,fresh,100,{},0,0,-0.1,0,12.25,60,0.97,15,-0.1,0,31.0,2,0\n"
    rates = {"kgrl": (0.9, 1.0, 1.0, 1.0), "residual": (0.5, 0.9, 0.9, 1.0), "safe_residual": (0.1, 0.2, 0.3, 0.4)}
    lines = [template.format(name, seed, rate) for name, values in rates.items() for seed, rate in enumerate(values)]
    (tmp_path / "connector_hard_converged.csv").write_text(HEADER + "".join(lines))
    text = task_table("BncConnector", tmp_path)
    assert [row[2].split(" (")[0] for row in rows(text)] == ["100", "90", "25"]
    # KGRL is better in 10 of the 16 pairs of seeds, and equal in 5: (10 + 5 / 2) / 16 = 0.78.
    assert "a seed succeeds more often than one of residual RL: KGRL 0.78 (95 %: " in text
    assert "equal knowledge" not in text


@pytest.mark.parametrize(("num_seeds", "cell"), [(4, "100"), (5, "100 (100–100)")])
def test_fewer_than_five_seeds_have_no_interval(num_seeds, cell, tmp_path):
    template = "{},{},60,fresh,100,{},0,0,-0.1,0,12.25,60,0.97,15,-0.1,0,31.0,2,0\n"
    lines = [
        template.format(name, seed, rate)
        for name, rate in (("kgrl", 1.0), ("residual", 0.5))
        for seed in range(num_seeds)
    ]
    (tmp_path / "connector_hard_converged.csv").write_text(HEADER + "".join(lines))
    text = task_table("BncConnector", tmp_path)
    assert rows(text)[0][2] == cell
    interval = " (95 %: 1.00–1.00)" if num_seeds == 5 else ""
    assert f"residual RL: KGRL 1.00{interval}." in text


def test_policies_without_learning_are_a_sentence_with_violations():
    columns = "method,seed,after_episodes,eval_set,episodes,success_rate,success_low,success_high,"
    table = pd.read_csv(
        io.StringIO(
            f"{columns}max_commanded_violation,violating_episodes\n"
            "scripted,0,0,fresh,100,0.98,0.93,0.994,-0.1,0\nuniform,0,0,fresh,100,0.5,0.4,0.6,0.0002,7\n"
        )
    ).assign(peak_force=1.0)
    text = methods_table([("scripted policy", table[:1]), ("random", table[1:])])
    assert text == (
        "Without learning: scripted policy 98 (93.0–99.4) of 100; "
        "random 50 (40.0–60.0) of 100, violation 0.20 mm, in 7 episodes."
    )


def test_brief_table_has_success_stops_and_violations(tmp_path):
    (tmp_path / "peers_connector_hard.csv").write_text(
        HEADER
        + "residual,7,60,fresh,100,0.98,0,0,0.0001,3,12.25,60,0.8,15,0.0004,5,31.0,3,1\n"
        + "kgrl,7,60,fresh,100,0.97,0,0,-0.1,0,12.25,60,0.8,15,-0.1,0,31.0,3,0\n"
    )
    text = task_table("BncConnector", tmp_path)
    assert "| method | held-out success [%] | stopped in training [%] | max. commanded violation |" in text
    assert rows(text)[1][1:] == ["98 (one seed)", "7", "0.40 mm, in 8 episodes"]


def test_knowledge_lists_demonstrated_episodes_when_unequal():
    (hard,) = (section for section in SECTIONS["GridClamp"] if section.title == "Grid clamp, hard, 6 s")
    (sentence,) = knowledge(hard, TABLES)
    assert "; 3 demonstrated episodes: RL-SCT, 3 demonstration episodes; none: the other methods." in sentence
    assert "10 demonstrated episodes: RL-SCT by behavior cloning, RL-SCT by RLPD, RL-SCT by DroQ; 3" in sentence
    assert knowledge(SECTIONS["BncConnector"][0], TABLES) == []
    number, failed = knowledge(SECTIONS["NarrowPassage"][0], TABLES)
    assert number == "Demonstrated episodes of every learned method: 10."
    barriers = "residual RL, control barrier function; residual RL, tangent space"
    assert failed.endswith(f"not even a demonstrated one: safe residual RL; {barriers}.")


def test_knowledge_is_stated_when_a_learner_is_imported(monkeypatch):
    monkeypatch.delitem(LEARNERS._entries, "plain_tqc", raising=False)
    monkeypatch.delitem(sys.modules, "research.benchmarks.learner", raising=False)
    learners = [
        Row("here", "connector_learners", "here"),
        Row("Stable-Baselines3", "connector_learners", "sb3_contrib"),
    ]
    assert knowledge(Section("Learners", learners), TABLES) == []
    assert "plain_tqc" in LEARNERS.names()


def test_stopped_episodes_are_a_dash_when_the_column_is_missing(tmp_path):
    line = "kgrl,7,60,fresh,100,0.97,0,0,-0.1,0,12.25,60,0.8,15,-0.1,0,31.0,0\n"
    (tmp_path / "peers_connector_hard.csv").write_text(HEADER.replace(",training_ended_in_collision", "") + line)
    assert rows(hard_tasks_table(tmp_path))[0][4] == "– / –"


def test_training_success_is_marked_when_not_evaluated(tmp_path):
    (tmp_path / "narrow_passage.csv").write_text(
        "method,seed,after_episodes,eval_set,training_episodes,training_success_rate,training_episodes_to_convergence,"
        "training_max_commanded_violation,training_violating_episodes,training_peak_force\n"
        "kgrl,0,60,,60,1.0,0,-0.01,0,0.0\nkgrl,1,60,,60,0.5,3,1e-12,0,0.0\nkgrl,2,60,,60,0.25,,0,0,3.0\n"
    )
    (row,) = rows(task_table("NarrowPassage", tmp_path))
    assert row[1:] == ["58 (25–100) in training"]


def test_results_with_a_constant_offset_are_marked(hard_tasks):
    table = {row[0]: row for row in rows(hard_tasks)}
    assert table["Grid clamp, hard, 6 s"][1:4] == ["RL-SCT 99 (93–100) †", "100 †", "98 / 52"]
    assert table["Grid clamp, hard, 6 s"][6] == "60 (10)"
    assert "†" not in "".join(table["Connector, hard, contact at 10 ms"])
    (clamp,) = (section for section in SECTIONS["GridClamp"] if section.title == "Grid clamp")
    (sentence,) = offsets(clamp, TABLES)
    assert sentence.endswith(
        "held-out episodes: learned methods. A new one in every held-out episode: baseline policies."
    )
    _, sensing, *_ = SECTIONS["GridClamp"]
    assert offsets(sensing, TABLES) == ["One hidden offset for each seed, in training and in held-out episodes."]
    (named,) = offsets(Section("Two studies", [*sensing.rows[-1:], *clamp.rows[:4]]), TABLES)
    assert named.endswith(
        "episodes: scripted policy; RL-SCT; residual RL; RL of 6D velocities. A new one in every held-out "
        "episode: zero action."
    )
    assert offsets(SECTIONS["BncConnector"][0], TABLES) == []


def test_spilled_episodes_count_as_stopped(hard_tasks):
    table = {row[0]: row for row in rows(hard_tasks)}
    assert table["Pouring, hard"][4] == "0 / –"
    assert table["Narrow passage, hard"][4] == "36 (sKGRL), 41 (KGRL) / 63"


def test_replace_table_refuses_a_text_without_markers():
    with pytest.raises(ValueError, match="no place for the table"):
        replace_table("# guiderail\n", "")
