"""Limits of the velocity, acceleration and jerk of a desired pose."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Synchronization, Trajectory
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail_hardware.systems import pose_motion_limiter
from guiderail_hardware.systems.pose_motion_limiter import PoseMotionLimiter
from oracles.franka import FRANKA_LIMITS
from oracles.prerequisites import changed_outputs

PERIOD = 0.005
START = np.array([0.5, 0.0, 0.5, 0.3, 0.1, 3.0])
LIMITS = FRANKA_LIMITS.scaled(0.2)


class Loop:
    """Limiter in a simulator, with fixed inputs."""

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
        """Run control steps; return the limited pose of each step, (steps, 6)."""
        poses = []
        for _ in range(steps):
            poses.append(self.system.get_limited_pose_output_port().Eval(self.context).copy())
            self.steps += 1
            self.simulator.AdvanceTo(self.steps * PERIOD)
        return np.array(poses)


def derivatives(poses):
    """Return the largest norms of velocity, acceleration and jerk by finite differences, (2, 3), linear first."""
    rotations = Rotation.from_euler("xyz", poses[:, [5, 4, 3]])
    angular = (rotations[1:] * rotations[:-1].inv()).as_rotvec() / PERIOD
    linear = np.diff(poses[:, :3], axis=0) / PERIOD
    return np.array(
        [
            [np.linalg.norm(np.diff(rate, order, axis=0), axis=1).max() / PERIOD**order for order in range(3)]
            for rate in (linear, angular)
        ]
    )


def assert_within(poses, limits):
    """Assert that the motion through the poses (n, 6) is within the limits."""
    assert (derivatives(poses) <= np.array([limits.linear, limits.angular]) * (1 + 1e-9)).all()


def assert_close(pose, expected, atol):
    """Assert that two poses differ by at most `atol` [m, rad]."""
    np.testing.assert_allclose(pose[:3], expected[:3], atol=atol)
    actual, desired = (Rotation.from_euler("xyz", angles) for angles in (pose[[5, 4, 3]], expected[[5, 4, 3]]))
    assert (actual * desired.inv()).magnitude() < atol


def test_motion_is_within_the_limits_for_random_commands():
    loop, rng, poses = Loop(), np.random.default_rng(0), []
    for k in range(2500):
        if rng.random() < 0.1 or k % 500 < 50:
            loop.set(START + rng.uniform(-1, 1, 6) * rng.choice([1e-4, 1e-2, 0.3, 2.0]))
        poses.append(loop.run(1)[0])
    assert_within(np.array(poses), LIMITS)
    speeds = derivatives(np.array(poses))[:, 0]
    assert (speeds > 0.5 * np.array([LIMITS.linear[0], LIMITS.angular[0]])).all()


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("distance", [0.02, -0.2])
def test_motion_of_one_axis_is_the_fastest_within_its_share(axis, distance):
    """The limits of velocity, acceleration and jerk of each axis are 1/√3 of the limits of the norm."""
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


@pytest.mark.parametrize(("angle", "is_followed"), [(0.9 * np.pi - 1e-3, True), (0.9 * np.pi + 1e-3, False)])
def test_pose_is_ignored_when_rotated_far_from_the_start(angle, is_followed):
    loop = Loop(FRANKA_LIMITS)
    loop.system.get_pose_input_port().FixValue(loop.context, np.zeros(6))
    loop.set([0.1, 0.0, 0.0, angle, 0.0, 0.0])
    loop.simulator.Initialize()
    expected = [0.1, 0.0, 0.0, angle, 0.0, 0.0] if is_followed else np.zeros(6)
    assert_close(loop.run(1500)[-1], np.array(expected), 1e-6)


def test_limiter_raises_when_no_trajectory_is_found(monkeypatch):
    class Solver(Ruckig):
        def calculate(self, motion, trajectory):
            return Result.Error

    monkeypatch.setattr(pose_motion_limiter, "Ruckig", Solver)
    with pytest.raises(InputError, match="no trajectory from"):
        Loop().run(1)


@pytest.mark.parametrize("blend_factor", [0.0, np.nan])
def test_motion_starts_at_the_measured_pose(blend_factor):
    loop = Loop(blend_factor=blend_factor)
    loop.set(START + 0.05, blend_factor)
    measured = START + [0.01, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.system.get_pose_input_port().FixValue(loop.context, measured)
    assert_close(loop.run(3)[-1], measured, 1e-12)
    loop.set(START)
    poses = loop.run(2)
    assert_close(poses[0], measured, 1e-4)
    assert derivatives(np.vstack([measured, measured, measured, poses]))[0][2] <= LIMITS.linear[2]


@pytest.mark.parametrize(
    "invalid", [np.full(6, np.nan), np.array([0.5, 0.0, np.inf, 0.3, 0.1, 3.0]), START + [0, 0, 0, np.pi, 0, 0]]
)
def test_last_valid_command_is_followed_after_an_invalid_command(invalid):
    loop = Loop()
    valid = START + [0.02, -0.03, 0.02, 0.2, -0.1, 0.1]
    loop.set(valid)
    loop.run(5)
    loop.set(invalid)
    assert_close(loop.run(300)[-1], valid, 1e-9)


# State of the limiter from `make motions` for which Ruckig cannot synchronize the axes.
UNSYNCHRONIZED = (
    [0.4617475861184548, -0.02562967106966967, 0.4267346873541157, -0.06869591579492204, -0.01050064361349193]
    + [-0.05043545623064285, -0.6400539533795001, -0.4637025342474212, -0.4437238746331603, -0.2864389150115287]
    + [-0.3163092866745019, -0.1879337329288214, 6.52696859147865, 7.505553499465135, 7.505553499465135]
    + [12.62953713852306, -12.62953713852306, 12.62953713852306, 0.2595146508075081, 0.125421340006484]
    + [0.2945301210973416, 0.2061487170500096, -0.1879694357494099, 0.243618726883553, 0.0, 0.0, 0.0, 1.0]
)


@pytest.mark.parametrize("failing_modes", [(), (Synchronization.Time, Synchronization.No)])
def test_motion_continues_when_axes_cannot_be_synchronized(failing_modes, monkeypatch):
    class Solver(Ruckig):
        def calculate(self, motion, trajectory):
            if motion.control_interface == ControlInterface.Position and motion.synchronization in failing_modes:
                raise RuckigError("failed")
            return super().calculate(motion, trajectory)

    monkeypatch.setattr(pose_motion_limiter, "Ruckig", Solver)
    loop = Loop(FRANKA_LIMITS)
    loop.context.get_mutable_discrete_state_vector().SetFromVector(UNSYNCHRONIZED)
    target = np.array(UNSYNCHRONIZED)
    angles = Rotation.from_rotvec(target[21:24]).as_euler("xyz")
    desired = np.concatenate([target[18:21], angles[::-1]])
    loop.set(desired)
    poses = loop.run(400)
    assert_within(poses, FRANKA_LIMITS)
    if failing_modes:
        assert_close(poses[-1], poses[-2], 1e-12)  # at rest
    else:
        assert_close(poses[-1], desired, 1e-9)


@pytest.mark.parametrize("distance", [1e4, -1e6])
def test_motion_is_braked_when_the_desired_pose_is_too_far_away(distance):
    """A command in micrometers instead of meters is an example."""
    loop = Loop()
    loop.set(START + [0.1, 0.0, 0.0, 0.2, 0.0, 0.0])
    poses = loop.run(40)
    loop.set(START + [distance, 0.0, 0.0, 0.0, 0.0, 0.0])
    poses = np.vstack([poses, loop.run(200)])
    assert_within(poses, LIMITS)
    assert_close(poses[-1], poses[-2], 1e-12)  # at rest
    loop.set(START)
    assert_close(loop.run(400)[-1], START, 1e-9)


def test_orientation_is_continuous_when_an_angle_exceeds_pi():
    loop = Loop()
    loop.set(START + [0, 0, 0, 0, 0, 0.4])  # Rx exceeds π
    assert derivatives(loop.run(300))[1][0] <= LIMITS.angular[0]


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_measured_pose_is_ignored_when_it_is_not_finite(number):
    loop, desired = Loop(), START + [0.02, 0.0, 0.0, 0.0, 0.0, 0.0]
    loop.set(desired)
    last = loop.run(20)[-1]
    loop.system.get_pose_input_port().FixValue(loop.context, [number, *START[1:]])
    loop.set(desired, blend_factor=0.0)
    poses = loop.run(3)
    assert_close(poses[0], last, atol=2e-3)
    np.testing.assert_array_equal(poses, [poses[0]] * 3)
    loop.context.SetTime(0.0)
    with pytest.raises(InputError, match="measured pose must be finite"):
        loop.simulator.Initialize()


def test_output_follows_every_source():
    stale, effects = changed_outputs(PoseMotionLimiter(FRANKA_LIMITS, period=PERIOD))
    assert not stale
    assert ("blend_factor", "limited_pose") in effects
