"""Benchmark of parallel environments."""

import pytest

from research.benchmarks import many_envs


def test_rate_is_extrapolated_from_the_serial_part(monkeypatch, capsys):
    times = {1: {"seconds": 0.010, "own_seconds": 0.001}, 2: {"seconds": 0.012, "own_seconds": 0.002}}
    monkeypatch.setattr(many_envs, "_measured", lambda count, steps: times[count])
    result = many_envs.measure(counts=(1, 2))
    assert result["control_steps_per_second"] == pytest.approx({1: 500.0, 2: 10.0 / 0.012})
    assert result["extrapolated_control_steps_per_second"] == pytest.approx(16 * 5 / (0.010 + 15 * 0.001))
    many_envs.show(result)
    assert "extrapolated" in capsys.readouterr().out


def test_vector_environment_is_timed(forkserver):
    row = many_envs._measured(1, steps=2)
    assert 0.0 < row["own_seconds"] < row["seconds"]
