"""Profile of a training run."""

import contextlib
import inspect

import pytest

from guiderail.systems.wrench_sensors import WrenchSensor
from research.benchmarks.training import PARTS, REST, Profiler, measure, timed_parts


def test_time_counts_for_the_innermost_part(monkeypatch):
    now = iter([0.0, 1.0, 3.0, 6.0, 10.0, 15.0])
    monkeypatch.setattr("time.perf_counter", lambda: next(now))
    profiler = Profiler()
    inner = profiler.timed(lambda: None, "inner")
    profiler.timed(inner, "outer")()
    profiler.stop()
    assert profiler.seconds == {REST: 1.0 + 5.0, "outer": 2.0 + 4.0, "inner": 3.0}
    assert profiler.calls == {REST: 1, "outer": 1, "inner": 1}


def test_timed_parts_restores_all_functions():
    before = [inspect.getattr_static(owner, name) for owner, name, _ in PARTS]
    sample = WrenchSensor._sample
    with contextlib.suppress(ZeroDivisionError), timed_parts():
        assert WrenchSensor._sample is not sample
        _ = 1 / 0
    assert WrenchSensor._sample is sample
    assert [inspect.getattr_static(owner, name) for owner, name, _ in PARTS] == before


def test_parts_add_up_to_the_run():
    result = measure("Bead", {"wall": 0.75}, episodes=6)
    assert result["environment"]["wall"] == 0.75
    parts = {row["part"]: row for row in result["parts"]}
    assert {"forward", "backward", "optimizer", "replay", "acting", "checkpoint", REST} <= set(parts)
    assert sum(row["seconds"] for row in parts.values()) == pytest.approx(result["wall_s"], rel=0.05)
    trainings = parts["replay"]["calls"]
    assert trainings > 0
    assert parts["optimizer"]["calls"] == 3 * 16 * trainings
    assert parts["acting"]["calls"] == result["control_steps"]
