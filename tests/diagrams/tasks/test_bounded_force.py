"""No action ends an episode by force: the impedance is limited below the force limit."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.stations.disturbances import Disturbances, disturbed
from guiderail.diagrams.stations.station import Impedance
from guiderail.models.common.errors import InputError

# Pushing down and sideways ends these by force if the impedance is not bounded.
PUSHED = [
    ("BncConnector", {"guidance": "kgrl"}, "gantry"),
    ("BncConnector", {"guidance": "residual", "action_dims": (0, 1, 2), "action_scale": 5.0}, "arm"),
    ("BncConnector", {"guidance": "skgrl"}, "mujoco"),
    ("GridClamp", {"guidance": "sct"}, "gantry"),
    ("GridClamp", {"guidance": "none", "active_constraints": False}, "arm"),
]


def push(task, **options):
    """Press with the action (1, …, 1, −1) on a fixture that is 2.5 mm off, until the episode ends."""
    env = make_env(task, difficulty="hard", **options)
    env.reset(seed=0, options={"offset": (0.0025, 0.0)})
    action, over = np.ones(env.action_space.shape), False
    action[2:3] = -1.0
    while not over:
        *_, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    force = env.trace.force.max()
    env.close()
    return info["termination"], force, env.task.declaration.options.force_limit


@pytest.mark.parametrize(("task", "options", "station"), PUSHED)
def test_push_ends_no_episode_when_force_is_bounded(task, options, station):
    termination, force, limit = push(task, station=station, **options)
    assert termination != "collision"
    assert 0.5 * limit < force < limit


@pytest.mark.parametrize(("task", "options", "station"), [PUSHED[0], PUSHED[4]])
def test_push_ends_episode_when_force_is_not_bounded(task, options, station):
    termination, force, limit = push(task, station=station, bounded_force=False, **options)
    assert termination == "collision"
    assert force > limit


def test_limits_lie_inside_ball_and_are_never_raised():
    for force in (8.0, 20.0, 35.0):
        limits = np.array(Impedance().with_max_force(force).limits)
        assert 0.95 * force < np.linalg.norm(limits[:3]) < force
        assert limits[3:].tolist() == list(Impedance().limits[3:])
    assert Impedance().with_max_force(1e3).limits == Impedance().limits


@pytest.mark.parametrize("limit", [12.0, 30.0])
def test_impedance_follows_force_limit(limit):
    task = EnvConfig.resolve("GridClamp", {"force_limit": limit}).make_task()
    expected = Impedance().with_max_force(limit)
    np.testing.assert_array_equal(task.impedance().bound.numbers, expected.bound.numbers)
    assert task.impedance().limits == expected.limits
    assert EnvConfig.resolve("GridClamp", {"bounded_force": False}).make_task().impedance() is None


def test_station_raises_when_it_takes_no_impedance():
    def build():
        raise AssertionError("must not be built")

    with pytest.raises(InputError, match="station='bench' takes no impedance"):
        disturbed(build, Disturbances(), True, "bench", Impedance())
