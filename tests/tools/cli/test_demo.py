import numpy as np
import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import demo
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.visualization import figures


def test_demo_prints_its_results_and_can_be_removed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "HELD_OUT", 1)
    monkeypatch.setattr(figures, "LAYOUT", "constrained")  # default layout, which the tests' fixture omits
    out = tmp_path / "demo"
    demo.run_demo(out, episodes=2, seed=0)
    printed = capsys.readouterr().out
    for name in ("picture.png", "replay.html", "episodes.csv", "learning_curve.png"):
        assert (out / name).stat().st_size > 0
        assert name in printed
    assert "2 of 2 training episodes reached the goal, 0 violated the constraint, 0 touched a wall" in printed
    assert "The demonstrations alone" in printed
    (out / "left_over.txt").write_text("file of another demo")
    demo._clear(out)
    assert not out.exists()


def test_demo_refuses_a_run_with_the_same_settings(tmp_path):
    out = tmp_path / "run"
    out.mkdir()
    (out / "config.yaml").write_text("task: NarrowPassage\npreset: tqc_cheap_correlated\n")
    with pytest.raises(InputError, match="already exists"):
        demo.run_demo(out, episodes=2, seed=0)
    assert (out / "config.yaml").exists()


def test_demo_replaces_a_demo_killed_before_its_first_episode(tmp_path):
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / demo.MARK).touch()
    RunFolder(tmp_path / "demo").refuse_existing()
    demo._clear(tmp_path / "demo")
    assert not (tmp_path / "demo").exists()


def test_episode_counts_as_violating_when_a_violation_is_nan():
    columns = {"max_commanded_violation": [-1.0, np.nan, 1.0], "max_measured_violation": [-1.0, -1.0, -1.0]}
    assert demo._count_violations(pd.DataFrame(columns)) == 2
