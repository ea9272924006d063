"""Benchmark of the plant's time step."""

import pytest

from guiderail.models.common.errors import InputError
from research.benchmarks import run_benchmark, time_step


@pytest.fixture(scope="module")
def results():
    """Return the results of the motion of the clamp with three time steps."""
    patch = pytest.MonkeyPatch()
    patch.setattr(time_step, "HALVINGS", (0, 1, 2))
    patch.setattr(time_step, "MOTIONS", {"clamp": time_step.MOTIONS["clamp"]})
    yield time_step.measure()
    patch.undo()


def test_error_grows_with_the_time_step(results):
    rows = results["rows"]
    assert [row["time_step"] for row in rows] == sorted(row["time_step"] for row in rows)
    assert rows[0]["force_rms"] == 0.0 < rows[1]["force_rms"] < rows[2]["force_rms"]
    assert results["default"] in [row["time_step"] for row in rows]


def test_show_prints_and_draw_writes_results(results, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(time_step, "MOTIONS", {"clamp": time_step.MOTIONS["clamp"]})
    time_step.show(results)
    assert "clamp" in capsys.readouterr().out
    assert time_step.draw(results, tmp_path / "steps.png").stat().st_size > 10_000


def test_picture_is_refused_when_benchmark_has_none(tmp_path):
    with pytest.raises(InputError, match="leave --picture out"):
        run_benchmark("learner", picture=tmp_path / "learner.png")


def test_picture_is_refused_before_measuring(monkeypatch, tmp_path):
    monkeypatch.setattr(time_step, "measure", lambda: pytest.fail("the benchmark was started"))
    with pytest.raises(InputError, match=r"\.txt"):
        run_benchmark("time_step", picture=tmp_path / "errors.txt")
