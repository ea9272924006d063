import pytest

from guiderail.systems.wrench_sensor import WrenchSensor
from guiderail.tools.benchmarks import simulation as bench_simulation
from guiderail.tools.benchmarks.simulation import CALLBACKS, real_time_factor, timed_callbacks


def test_systems_are_left_as_they_were():
    before = [getattr(system, name) for system, name in CALLBACKS]
    with timed_callbacks():
        assert WrenchSensor._sample is not before[0]
    assert [getattr(system, name) for system, name in CALLBACKS] == before


@pytest.mark.parametrize(("task", "contact"), [("BncConnector", "CONTACT"), ("GridClamp", "CLAMP_CONTACT")])
def test_pythons_share_is_a_part_of_the_whole(monkeypatch, task, contact):
    monkeypatch.setattr("guiderail.tools.benchmarks.simulation.REPEATS", 1)
    first, _ = getattr(bench_simulation, contact)
    monkeypatch.setattr(f"guiderail.tools.benchmarks.simulation.{contact}", (first, first + 0.8))
    result = real_time_factor("rails", task)
    assert result["real_time_factor"] > 0.0
    assert 0.0 < result["python_share"] < 1.0
