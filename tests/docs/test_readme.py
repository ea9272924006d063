"""The README's table says what the tables of finished studies say."""

import shutil
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


@pytest.fixture(scope="module")
def maker():
    """The module that writes it, which is no part of the package."""
    sys.path.insert(0, str(DOCS))
    try:
        import make_readme_table
    finally:
        sys.path.remove(str(DOCS))
    return make_readme_table


def rows(text):
    """Of each line its cells, without head and ruler."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]


def test_the_table_is_of_today(maker):
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert maker.written(readme, maker.table()) == readme, "the README is stale: python docs/make_readme_table.py"


def test_every_study_and_method_that_it_asks_for_is_shipped(maker):
    from guiderail.tools.experiments.declaration import load_study
    from research.studies import study_path

    for row in (row for task in maker.TASKS.values() for row in task):
        study = load_study(study_path(row.study))
        assert row.method in study.methods, f"{row.study} has no {row.method}"
        assert row.judged is None or row.judged in [one.name for one in study.eval_set]
        assert row.judged is not None or len(study.eval_set) < 2, f"{row.study} judges on several kinds of episodes"


def test_a_study_that_is_not_there_is_left_out(maker, tmp_path):
    shutil.copy(ROOT / "research" / "results" / "connector_hard_nulls.csv", tmp_path)
    found = rows(maker.table(tmp_path))
    assert {row[0] for row in found} == {"**connector, hard**", ""}
    assert [row[1] for row in found] == list(maker.NULLS)
    assert rows(maker.table(tmp_path / "nowhere")) == []


HEAD = (
    "method,seed,after_episodes,eval_set,episodes,success_rate,success_low,success_high,max_commanded_violation,violating_episodes,"
    "peak_force,training_episodes,training_success_rate,training_episodes_to_convergence,training_max_commanded_violation,"
    "training_violating_episodes,training_peak_force\n"
)


def test_each_seed_is_told_after_its_last_episode_with_the_worst_that_it_did(maker, tmp_path):
    (tmp_path / "connector_hard.csv").write_text(
        HEAD
        + "residual,7,20,fresh,100,0.1,0,0,0,0,1.0,20,0.1,,0,0,2.0\n"
        + "residual,7,60,fresh,100,0.98,0,0,0.0001,3,12.25,60,0.8,15,0.0004,5,31.0\n"
        + "residual,8,60,fresh,100,1.0,0,0,-0.1,0,14.5,60,0.8,,0.0,0,20.0\n"
    )
    (row,) = rows(maker.table(tmp_path))
    assert row[1:] == [
        "residual RL",
        "60 (7, 8)",
        "98, 100",
        "15, never",
        "in 8 episodes, 0.40 mm at most",
        "14.5 (31.0)",
    ]


def test_what_was_never_judged_is_said_to_be_of_training(maker, tmp_path):
    (tmp_path / "narrow_passage.csv").write_text(
        "method,seed,after_episodes,eval_set,training_episodes,training_success_rate,training_episodes_to_convergence,"
        "training_max_commanded_violation,training_violating_episodes,training_peak_force\n"
        "kgrl,0,60,,60,1.0,0,-0.01,0,0.0\nkgrl,1,60,,60,0.5,3,1e-12,0,0.0\nkgrl,2,60,,60,0.25,,0,0,3.0\n"
    )
    (row,) = rows(maker.table(tmp_path))
    assert row[1:] == ["KGRL", "60 (0–2)", "100, 50, 25 in training", "0, 3, never", "never", "(3.0)"]


def test_a_readme_without_a_place_for_it_is_refused(maker):
    with pytest.raises(ValueError, match="no place for the table"):
        maker.written("# guiderail\n", "")
