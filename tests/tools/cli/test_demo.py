import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.cli import demo
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.visualization import replay, style


def test_the_demo_says_what_it_left_and_replaces_itself(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(demo, "HELD_OUT", 1)
    monkeypatch.setattr(replay, "EPISODES", 1)
    monkeypatch.setattr(style, "LAYOUT", "constrained")  # pictures as people get them
    out = tmp_path / "demo"
    demo.run_demo(out, episodes=2, seed=0)
    said = capsys.readouterr().out
    for name in ("picture.png", "replay.html", "episodes.csv", "learning_curve.png"):
        assert (out / name).stat().st_size > 0
        assert name in said
    assert "2 of 2 training episodes reached the goal, 0 violated the constraint, 0 touched a wall" in said
    assert "The demonstrations alone" in said
    (out / "left_over.txt").write_text("of the last demo")
    demo._clear(out)
    assert not out.exists()


def test_a_run_like_a_demo_that_is_none_is_left_alone(tmp_path):
    out = tmp_path / "mine"
    out.mkdir()
    (out / "config.yaml").write_text("task: NarrowPassage\npreset: steady\n")
    with pytest.raises(InputError, match="already exists"):
        demo.run_demo(out, episodes=2, seed=0)
    assert (out / "config.yaml").exists()


def test_a_demo_that_was_killed_at_its_start_is_replaced(tmp_path):
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / demo.MARK).touch()
    RunFolder(tmp_path / "demo").refuse_existing()
    demo._clear(tmp_path / "demo")
    assert not (tmp_path / "demo").exists()
