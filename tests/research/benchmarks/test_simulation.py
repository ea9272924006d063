"""Benchmark of contact simulation."""

import pytest

from guiderail.systems.wrench_sensors import WrenchSensor
from research.benchmarks import simulation
from research.benchmarks.simulation import CALLBACKS, real_time_factor, timed_callbacks


def test_timed_callbacks_restores_the_systems():
    before = [getattr(system, name) for system, name in CALLBACKS]
    with timed_callbacks():
        assert WrenchSensor._sample is not before[0]
    assert [getattr(system, name) for system, name in CALLBACKS] == before


@pytest.mark.parametrize(("name", "contact"), [("gantry", "CONTACT"), ("pouring", "POUR_CONTACT")])
def test_python_share_is_between_0_and_1(monkeypatch, name, contact):
    monkeypatch.setattr(simulation, "REPEATS", 1)
    start, _ = getattr(simulation, contact)
    monkeypatch.setattr(simulation, contact, (start, start + 0.2))  # 0.2 s of contact
    result = real_time_factor(name)
    assert result["real_time_factor"] > 0.0
    assert 0.0 < result["python_share"] < 1.0
