"""The option `control_period`: period of guidance, station and task; refused periods."""

import gymnasium
import numpy as np
import pytest

from guiderail import make_env
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.stations.plane import PlaneStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD, PLANT_PERIOD, command_timeout, tare_steps
from guiderail.diagrams.tasks.bnc_connector import reference_trajectory
from guiderail.diagrams.tasks.registry import TASKS, environment_id, register_task
from guiderail.diagrams.tasks.task import Task
from guiderail.models.common.errors import InputError
from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.models.primitives import ReferenceTrajectory


def configure(name, **options):
    return EnvConfig.resolve(name, options)


@pytest.mark.parametrize("name", ["NarrowPassage", "BncConnector", "GridClamp", "Pouring"])
def test_episode_duration_is_equal_when_the_period_is_longer(name):
    standard, slow = configure(name), configure(name, control_period=0.1)
    assert slow.period == pytest.approx(0.1, rel=1e-9)
    assert slow.num_steps * slow.period == pytest.approx(standard.num_steps * standard.period, rel=1e-6)


def test_shipped_reference_is_used_at_the_default_period():
    assert configure("BncConnector").reference() is reference_trajectory("insert")
    assert configure("BncConnector", control_period=0.02).reference() is reference_trajectory("insert")


def test_step_and_reference_have_the_given_control_period():
    env = make_env("NarrowPassage", guidance="skgrl", control_period=0.1, action_repeat=1)
    env.reset(seed=0)
    for number in range(3):
        env.step(np.array([1.0, -1.0]))
        assert env.simulator.get_context().get_time() == (number + 1) * env.diagram.control_period
    primitive = make_prior_knowledge("NarrowPassage", control_period=0.1).primitive
    np.testing.assert_allclose(np.diff(primitive.reference.times), primitive.control_period, rtol=1e-9)
    assert primitive.control_period == env.diagram.control_period == 50 * env.diagram.config.station_kind.time_unit


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("BncConnector", {"control_period": 0.0123}, "whole multiple of 0.005 s"),
        ("NarrowPassage", {"control_period": 0.011}, "whole multiple of 0.002 s"),
        ("BncConnector", {"control_period": 0.004}, "at least 0.005"),
        ("BncConnector", {"control_period": 0.6}, "at most 0.5"),
        ("GridClamp", {"control_period": 0.015, "station": "gantry"}, "whole multiple of 0.01 s"),
        ("GridClamp", {"control_period": 0.015, "station": "arm"}, "whole multiple of 0.01 s"),
    ],
)
def test_control_period_is_refused_when_out_of_range(task, options, message):
    with pytest.raises(InputError, match=message):
        make_env(task, **options)


def test_period_is_accepted_when_a_multiple_of_the_plants():
    assert make_env("GridClamp", control_period=3 * PLANT_PERIOD).diagram.control_period == 3 * PLANT_PERIOD


@pytest.mark.parametrize(
    ("station", "milliseconds"), [*(("gantry", step) for step in (0.5, 2.0, 2.5, 4.0, 20 / 3)), ("arm", 20 / 3)]
)
def test_plant_has_equal_numbers_of_steps_in_all_control_periods(station, milliseconds):
    env = make_env("GridClamp", guidance="sct", station=station, time_step=1e-3 * milliseconds, action_repeat=1)
    env.reset(seed=0)
    inner = env.diagram.diagram.GetSubsystemByName("station")
    count, times = round(20 / milliseconds), []
    env.simulator.set_monitor(lambda context: times.append(context.get_time()))
    assert env.diagram.control_period == count * inner.plant.time_step() == pytest.approx(0.02, abs=1e-9)
    for _ in range(7):
        env.step(np.zeros(3))
    assert times == [index * inner.plant.time_step() for index in range(1, 7 * count + 1)]


@pytest.mark.parametrize(("control_period", "time_step"), [(0.03, 0.003), (0.05, 0.002)])
def test_control_period_is_a_multiple_of_any_time_step(control_period, time_step):
    env = make_env("BncConnector", guidance="kgrl", control_period=control_period, time_step=time_step)
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape))
    assert env.simulator.get_context().get_time() == env.action_repeat * env.diagram.control_period


@pytest.mark.parametrize(
    ("time_step", "message"),
    [
        (0.003, r"whole multiple of 0\.003 s, not 0\.02 s"),
        (0.04, r"whole multiple of 0\.04 s"),
        (1e-5, r"at least 0\.00016 s"),
    ],
)
def test_time_step_is_refused_when_it_does_not_divide_the_period(time_step, message):
    with pytest.raises(InputError, match=message):
        make_env("GridClamp", guidance="sct", time_step=time_step)


class Lane(Task):
    """Straight motion in a plane."""

    station, duration = PlaneStation, 0.4

    def workcell(self):
        return PassageGeometry()

    def prior(self):
        means = np.column_stack([np.full(41, 0.35), np.linspace(0.1, 0.5, 41)])
        return Prior(ReferenceTrajectory(0.02 * np.arange(41), means, np.tile(1e-3 * np.eye(2), (41, 1, 1))))

    def rewards(self):
        return {"none": lambda: 0.0}

    def done(self):
        return {"success": lambda pose: False}


@pytest.fixture
def own_task():
    """Register lab/Lane; remove it after the test."""
    register_task("lab/Lane")(Lane)
    yield
    TASKS._entries.pop("lab/Lane")
    gymnasium.registry.pop(environment_id("lab/Lane"))


@pytest.mark.parametrize("period", [None, 0.012, 0.04, 0.05])
def test_own_task_has_the_given_control_period(own_task, period):
    env = make_env("lab/Lane", guidance="kmp", action_repeat=1, control_period=period)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(2))
    assert env.diagram.config.period == env.diagram.control_period == pytest.approx(period or 0.02, rel=1e-9)
    # The demonstrated speed is 0.5 m/s at every control period.
    assert env.trace.commanded[4, 1] - env.trace.commanded[3, 1] == pytest.approx(0.5 * (period or 0.02), rel=0.1)


def test_timeout_and_tare_follow_the_period():
    assert (command_timeout(0.02), command_timeout(0.05), command_timeout(0.1)) == (0.1, 0.1, 0.2)
    assert tare_steps(CONTROL_PERIOD) == (3, 5)
    assert tare_steps(5 * CONTROL_PERIOD) == (1, 1)
