from guiderail.systems.wrench_sensor import WrenchSensor
from guiderail.tools.bench_simulation import CALLBACKS, real_time_factor, timed_callbacks


def test_systems_are_left_as_they_were():
    before = [getattr(system, name) for system, name in CALLBACKS]
    with timed_callbacks():
        assert WrenchSensor._sample is not before[0]
    assert [getattr(system, name) for system, name in CALLBACKS] == before


def test_pythons_share_is_a_part_of_the_whole(monkeypatch):
    monkeypatch.setattr("guiderail.tools.bench_simulation.REPEATS", 1)
    monkeypatch.setattr("guiderail.tools.bench_simulation.CONTACT", (3.8, 4.6))
    result = real_time_factor("rails")
    assert result["real_time_factor"] > 0.0
    assert 0.0 < result["python_share"] < 1.0
