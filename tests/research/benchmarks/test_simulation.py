"""Benchmark of contact simulation."""

import numpy as np
import pytest

from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.stations.pouring import PouringStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.systems.wrench_sensors import WrenchSensor
from research.benchmarks import simulation
from research.benchmarks.simulation import CALLBACKS, real_time_factor, scripted_motion, timed_callbacks


def test_timed_callbacks_restores_the_systems():
    before = [getattr(system, name) for system, name in CALLBACKS]
    with timed_callbacks():
        assert WrenchSensor._sample is not before[0]
    assert [getattr(system, name) for system, name in CALLBACKS] == before


@pytest.mark.parametrize(
    ("name", "contact"), [("gantry", "CONTACT"), ("grid_clamp", "CLAMP_CONTACT"), ("pouring", "POUR_CONTACT")]
)
def test_python_share_is_between_0_and_1(monkeypatch, name, contact):
    monkeypatch.setattr(simulation, "REPEATS", 1)
    start, _ = getattr(simulation, contact)
    monkeypatch.setattr(simulation, contact, (start, start + 0.8))  # 0.8 s of contact
    result = real_time_factor(name)
    assert result["real_time_factor"] > 0.0
    assert 0.0 < result["python_share"] < 1.0


def test_scripted_pour_empties_the_thermos():
    config, times, poses, _ = scripted_motion("Pouring")
    station = PouringStation(config)
    driven = DrivenStation(station, linear_motion(times, poses), num_samples=round(times[-1] / CONTROL_PERIOD))
    driven.start(poses[0])
    driven.run()
    balls = station.GetOutputPort("balls_in_mug").Eval(station.GetMyContextFromRoot(driven.context)).reshape(-1, 6)
    assert (balls[:, 2] < 0.0).all()
    assert (np.hypot(balls[:, 0], balls[:, 1]) < config.mug.inner_diameter / 2).all()
