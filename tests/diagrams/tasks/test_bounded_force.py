"""Option `bounded_force`: the impedance limits the contact force below the force limit of the task."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.stations.disturbances import Disturbances, disturbed
from guiderail.diagrams.stations.station import Impedance
from guiderail.models.common.errors import InputError

# The action of `push` ends these episodes by collision if `bounded_force` is false.
PUSHES = [
    ("BncConnector", {"guidance": "kgrl"}, "gantry"),
    ("BncConnector", {"guidance": "residual", "action_dims": (0, 1, 2), "action_scale": 5.0}, "arm"),
    ("BncConnector", {"guidance": "skgrl"}, "mujoco"),
    ("GridClamp", {"guidance": "sct"}, "gantry"),
    ("GridClamp", {"guidance": "none", "active_constraints": False}, "arm"),
]


def push(task, **options):
    """Press for 4 s on a fixture with an offset of 2.5 mm; return ending, peak force [N] and force limit [N].

    The action is 1 in all directions except z, where it is −1.
    """
    env = make_env(task, difficulty="hard", **options)
    env.reset(seed=0, options={"offset": (0.0025, 0.0)})
    action, over = np.ones(env.action_space.shape), False
    action[2:3] = -1.0
    while not over and len(env.trace) < 200:
        *_, terminated, truncated, info = env.step(action)
        over = terminated or truncated
    force = env.trace.force.max()
    env.close()
    return info["termination"], force, env.diagram.task.force_limit


@pytest.mark.parametrize(("task", "options", "station"), PUSHES)
def test_push_is_no_collision_when_force_is_bounded(task, options, station):
    termination, force, limit = push(task, station=station, **options)
    assert termination != "collision"
    assert 0.5 * limit < force < limit


@pytest.mark.parametrize(("task", "options", "station"), [PUSHES[0], PUSHES[4]])
def test_push_is_a_collision_when_force_is_not_bounded(task, options, station):
    termination, force, limit = push(task, station=station, bounded_force=False, **options)
    assert termination == "collision"
    assert force > limit


def test_force_limits_are_within_the_ball_and_never_raised():
    for force in (8.0, 20.0, 35.0):
        limits = np.array(Impedance().with_max_force(force).limits)
        assert 0.95 * force < np.linalg.norm(limits[:3]) < force
        assert limits[3:].tolist() == list(Impedance().limits[3:])
    assert Impedance().with_max_force(1e3).limits == Impedance().limits


@pytest.mark.parametrize("limit", [12.0, 30.0])
def test_impedance_depends_on_the_force_limit_of_the_task(limit):
    task = EnvConfig.resolve("GridClamp", {"force_limit": limit}).declared
    expected = Impedance().with_max_force(limit)
    np.testing.assert_array_equal(task.impedance().bound.numbers, expected.bound.numbers)
    assert task.impedance().limits == expected.limits
    assert EnvConfig.resolve("GridClamp", {"bounded_force": False}).declared.impedance() is None


@pytest.mark.parametrize(("station", "seeds"), [("gantry", (5, 1)), ("arm", (5,)), ("mujoco", (1,))])
def test_sampled_limit_is_observed_and_bounds_the_force(station, seeds):
    """Random corner actions; the station's own impedance is bounded only for the largest limit of the range."""
    env = make_env("BncConnector", difficulty="hard", guidance="kgrl", station=station, force_limit_range=(8.0, 25.0))
    rng, limits = np.random.default_rng(0), []
    for seed in seeds:
        observation, info = env.reset(seed=seed)
        limits.append(info["force_limit"])
        assert observation[-1] == pytest.approx((limits[-1] - 20.0) / 10.0, abs=1e-6)
        over = seed != seeds[0]  # the episode of the first seed
        while not over and len(env.trace) < 200:  # 4 s
            action = rng.choice([-1.0, 1.0], 2)
            *_, terminated, truncated, info = env.step(action)
            over = terminated or truncated
        if seed == seeds[0]:
            assert info["termination"] != "collision"
            assert 0.5 * limits[-1] < env.trace.force.max() < limits[-1]
    env.close()
    assert min(limits) >= 8.0
    assert len(seeds) == 1 or max(limits) - min(limits) > 3.0


def test_symmetry_leaves_the_observed_force_limit_unchanged():
    env = make_env("BncConnector", difficulty="hard", guidance="kgrl", force_limit_range=(8.0, 25.0))
    size = env.observation_space.shape[0]
    for symmetry in (env.diagram.symmetry, env.diagram.near_symmetry):
        for matrix in symmetry.observations:
            np.testing.assert_array_equal(matrix[-1], np.eye(size)[-1])
            np.testing.assert_array_equal(matrix[:, -1], np.eye(size)[-1])


def test_station_is_refused_without_an_impedance():
    def build():
        raise AssertionError("must not be built")

    with pytest.raises(InputError, match="station='bench' takes no impedance"):
        disturbed(build, Disturbances(), True, "bench", Impedance())
