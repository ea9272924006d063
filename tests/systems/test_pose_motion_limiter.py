"""Limiter of velocity, acceleration and jerk of a desired pose."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.systems import pose_motion_limiter
from guiderail.systems.pose_motion_limiter import PoseMotionLimiter
from oracles.franka import FRANKA_LIMITS

PERIOD = 0.005
START = np.array([0.5, 0.0, 0.5, 0.3, 0.1, 3.0])
LIMITS = FRANKA_LIMITS.scaled(0.2)


class Loop:
    """A limiter that is stepped with constant inputs."""

    def __init__(self, limits=LIMITS, blend_factor=1.0):
        self.system = PoseMotionLimiter(limits, period=PERIOD)
        self.context = self.system.CreateDefaultContext()
        self.set(START, blend_factor)
        self.system.get_pose_input_port().FixValue(self.context, START)
        self.simulator = Simulator(self.system, self.context)
        self.simulator.Initialize()
        self.steps = 0

    def set(self, desired, blend_factor=1.0):
        self.system.get_desired_pose_input_port().FixValue(self.context, desired)
        self.system.get_blend_factor_input_port().FixValue(self.context, [blend_factor])

    def run(self, steps):
        poses = []
        for _ in range(steps):
            poses.append(self.system.get_limited_pose_output_port().Eval(self.context).copy())
            self.steps += 1
            self.simulator.AdvanceTo(self.steps * PERIOD)
        return np.array(poses)


def derivatives(poses):
    """Return the largest norms of velocity, acceleration and jerk, linear and angular, by finite differences."""
    turns = Rotation.from_euler("xyz", poses[:, [5, 4, 3]])
    angular = (turns[1:] * turns[:-1].inv()).as_rotvec() / PERIOD
    linear = np.diff(poses[:, :3], axis=0) / PERIOD
    return [
        [np.linalg.norm(np.diff(rate, order, axis=0), axis=1).max() / PERIOD**order for order in range(3)]
        for rate in (linear, angular)
    ]


def assert_close(pose, expected, atol):
    np.testing.assert_allclose(pose[:3], expected[:3], atol=atol)
    turns = [Rotation.from_euler("xyz", one[[5, 4, 3]]) for one in (pose, expected)]
    assert (turns[0] * turns[1].inv()).magnitude() < atol


def test_motion_stays_within_the_limits_for_adversarial_commands():
    loop, rng, poses = Loop(), np.random.default_rng(0), []
    for k in range(2500):
        if rng.random() < 0.1 or k % 500 < 50:
            loop.set(START + rng.uniform(-1, 1, 6) * rng.choice([1e-4, 1e-2, 0.3, 2.0]))
        poses.append(loop.run(1)[0])
    for reached, limits in zip(derivatives(np.array(poses)), (LIMITS.linear, LIMITS.angular), strict=True):
        assert (np.array(reached) <= np.array(limits) * (1 + 1e-9)).all()
        assert reached[0] > 0.5 * limits[0]  # the limits are used


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("distance", [0.02, -0.2])
def test_each_axis_uses_a_share_of_the_limits(axis, distance):
    """The fastest motion of one axis: its velocity, acceleration and jerk reach 1/√3 of the limits."""
    loop, start = Loop(), np.zeros(6)
    loop.system.get_pose_input_port().FixValue(loop.context, start)
    desired = np.zeros(6)
    desired[axis] = distance
    loop.set(desired)
    loop.simulator.Initialize()
    motion = InputParameter(1)
    motion.target_position = [abs(distance)]
    limits = np.transpose([LIMITS.linear, LIMITS.rotation_vector_limits()])[:, int(axis > 2)] / np.sqrt(3.0)
    motion.max_velocity, motion.max_acceleration, motion.max_jerk = limits[:, None]
    trajectory = Trajectory(1)
    assert Ruckig(1).calculate(motion, trajectory) == Result.Working
    poses = loop.run(100)
    expected = [trajectory.at_time(PERIOD * (k + 1))[0][0] for k in range(100)]
    np.testing.assert_allclose(poses[:, axis], np.sign(distance) * np.array(expected), atol=1e-6)
    np.testing.assert_allclose(np.delete(poses, axis, axis=1), 0.0, atol=1e-9)


@pytest.mark.parametrize(("turn", "is_followed"), [(0.9 * np.pi - 1e-3, True), (0.9 * np.pi + 1e-3, False)])
def test_orientation_far_from_the_start_is_ignored(turn, is_followed):
    loop = Loop(FRANKA_LIMITS)
    loop.system.get_pose_input_port().FixValue(loop.context, np.zeros(6))
    loop.set([0.1, 0.0, 0.0, turn, 0.0, 0.0])
    loop.simulator.Initialize()
    expected = [0.1, 0.0, 0.0, turn, 0.0, 0.0] if is_followed else np.zeros(6)
    assert_close(loop.run(1500)[-1], np.array(expected), 1e-6)


def test_motion_raises_when_no_trajectory_is_found(monkeypatch):
    class Solver(Ruckig):
        def calculate(self, wanted, trajectory):
            return Result.Error

    monkeypatch.setattr(pose_motion_limiter, "Ruckig", Solver)
    with pytest.raises(InputError, match="no trajectory from"):
        Loop().run(1)


def test_motion_reaches_the_desired_pose():
    loop = Loop()
    desired = START + [0.05, -0.03, 0.02, 0.2, -0.1, 0.1]
    loop.set(desired)
    assert_close(loop.run(400)[-1], desired, 1e-9)


@pytest.mark.parametrize("blend_factor", [0.0, np.nan])
def test_motion_starts_at_the_measured_pose(blend_factor):
    loop = Loop(blend_factor=blend_factor)
    loop.set(START + 0.05, blend_factor)
    measured = START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.system.get_pose_input_port().FixValue(loop.context, measured)
    assert_close(loop.run(3)[-1], measured, 1e-12)
    loop.set(START)
    moved = loop.run(2)
    assert_close(moved[0], measured, 1e-4)
    assert derivatives(np.vstack([measured, measured, measured, moved]))[0][2] <= LIMITS.linear[2]


@pytest.mark.parametrize(
    "invalid", [np.full(6, np.nan), np.array([0.5, 0.0, np.inf, 0.3, 0.1, 3.0]), START + [0, 0, 0, np.pi, 0, 0]]
)
def test_last_valid_command_is_followed_when_one_is_invalid(invalid):
    loop = Loop()
    valid = START + [0.02, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.set(valid)
    loop.run(5)
    loop.set(invalid)
    assert_close(loop.run(200)[-1], valid, 1e-9)


# Found by `make motions`: the library cannot synchronize the axes.
UNSYNCHRONIZED = (
    [0.4617475861184548, -0.02562967106966967, 0.4267346873541157, -0.06869591579492204, -0.01050064361349193]
    + [-0.05043545623064285, -0.6400539533795001, -0.4637025342474212, -0.4437238746331603, -0.2864389150115287]
    + [-0.3163092866745019, -0.1879337329288214, 6.52696859147865, 7.505553499465135, 7.505553499465135]
    + [12.62953713852306, -12.62953713852306, 12.62953713852306, 0.2595146508075081, 0.125421340006484]
    + [0.2945301210973416, 0.2061487170500096, -0.1879694357494099, 0.243618726883553, 0.0, 0.0, 0.0, 1.0]
)


@pytest.mark.parametrize("fails", [(), (Synchronization.Time, Synchronization.No)])
def test_motion_continues_when_axes_cannot_be_synchronized(fails, monkeypatch):
    class Solver(Ruckig):
        def calculate(self, wanted, trajectory):
            if wanted.control_interface == ControlInterface.Position and wanted.synchronization in fails:
                raise RuckigError("failed")
            return super().calculate(wanted, trajectory)

    monkeypatch.setattr(pose_motion_limiter, "Ruckig", Solver)
    loop = Loop(FRANKA_LIMITS)
    loop.context.get_mutable_discrete_state_vector().SetFromVector(UNSYNCHRONIZED)
    target = np.array(UNSYNCHRONIZED)
    turn = Rotation.from_rotvec(target[21:24]).as_euler("xyz")
    desired = np.concatenate([target[18:21], turn[::-1]])
    loop.set(desired)
    poses = loop.run(400)
    reached = np.array(derivatives(poses))
    assert (reached <= np.array([FRANKA_LIMITS.linear, FRANKA_LIMITS.angular]) * (1 + 1e-9)).all()
    if fails:
        assert_close(poses[-1], poses[-2], 1e-12)  # at rest
    else:
        assert_close(poses[-1], desired, 1e-9)


@pytest.mark.parametrize("distance", [1e4, -1e6])
def test_motion_is_braked_when_the_desired_pose_is_too_far_away(distance):
    """For example a command in micrometers instead of meters."""
    loop = Loop()
    loop.set(START + [0.1, 0.0, 0.0, 0.2, 0.0, 0.0])
    moving = loop.run(40)
    loop.set(START + [distance, 0.0, 0.0, 0.0, 0.0, 0.0])
    poses = np.vstack([moving, loop.run(200)])
    assert (np.array(derivatives(poses)) <= np.array([LIMITS.linear, LIMITS.angular]) * (1 + 1e-9)).all()
    assert_close(poses[-1], poses[-2], 1e-12)  # at rest
    loop.set(START)
    assert_close(loop.run(400)[-1], START, 1e-9)


def test_orientation_stays_continuous_across_half_a_turn_of_an_angle():
    loop = Loop()
    loop.set(START + [0, 0, 0, 0, 0, 0.4])  # Rx passes π
    assert derivatives(loop.run(300))[1][0] <= LIMITS.angular[0]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_measured_pose_is_ignored_when_it_is_not_finite(number):
    loop, moved = Loop(), START + [0.02, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.set(moved)
    last = loop.run(20)[-1]
    loop.system.get_pose_input_port().FixValue(loop.context, [number, *START[1:]])
    loop.set(moved, blend_factor=0.0)
    kept = loop.run(3)
    assert_close(kept[0], last, atol=2e-3)
    np.testing.assert_array_equal(kept, [kept[0]] * 3)
    loop.context.SetTime(0.0)
    with pytest.raises(InputError, match="measured pose must be finite"):
        loop.simulator.Initialize()
