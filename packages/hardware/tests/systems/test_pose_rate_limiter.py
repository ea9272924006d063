import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail_hardware.systems.pose_rate_limiter import PoseRateLimiter

PERIOD, SPEED, ANGULAR_SPEED = 0.125, 0.25, 0.5
STEP, TURN = PERIOD * SPEED, PERIOD * ANGULAR_SPEED  # largest changes in a period [m, rad], exact in binary
MEASURED = np.array([0.1, -0.2, 0.3, 1.0, 0.0, 0.0])


class Rig:
    """Limiter of a robot at the pose `MEASURED`, with fixed inputs."""

    def __init__(self, desired, blend_factor=0.0):
        self.system = PoseRateLimiter(period=PERIOD, speed=SPEED, angular_speed=ANGULAR_SPEED)
        self.simulator = Simulator(self.system)
        context = self.simulator.get_mutable_context()
        self.desired = self.system.get_desired_pose_input_port().FixValue(context, desired)
        self.pose = self.system.get_pose_input_port().FixValue(context, MEASURED)
        self.blend_factor = self.system.get_blend_factor_input_port().FixValue(context, [blend_factor])
        self.simulator.Initialize()

    def advance(self, steps=1):
        """Advance by periods; return the limited pose at the end of each period, before the update, (steps, 6)."""
        poses = []
        for _ in range(steps):
            self.simulator.AdvanceTo(self.simulator.get_context().get_time() + PERIOD)
            poses.append(self.limited_pose)
        return np.array(poses)

    @property
    def limited_pose(self):
        return self.system.get_limited_pose_output_port().Eval(self.simulator.get_context()).copy()

    def start_blending(self):
        """Advance by a period with a blend factor of 0, then set the blend factor to 0.1."""
        self.advance()
        self.blend_factor.GetMutableData().set_value([0.1])
        return self


@pytest.mark.parametrize("blend_factor", [0.0, np.nan])
def test_measured_pose_is_output_while_blend_factor_is_zero(blend_factor):
    rig = Rig(np.zeros(6), blend_factor)
    np.testing.assert_array_equal(rig.advance(3), np.tile(MEASURED, (3, 1)))
    other_pose = MEASURED + 0.05
    rig.pose.GetMutableData().set_value(other_pose)
    np.testing.assert_array_equal(rig.advance()[0], other_pose)


def test_output_starts_at_measured_pose_if_blend_factor_is_one():
    rig = Rig(MEASURED + [10.0, 0.0, 0.0, 0.0, 0.0, 0.0], blend_factor=1.0)
    step = np.array([SPEED * PERIOD, 0.0, 0.0, 0.0, 0.0, 0.0])
    first = rig.limited_pose
    np.testing.assert_allclose(first, MEASURED + step, atol=1e-12)
    np.testing.assert_allclose(np.diff([first, *rig.advance(4)], axis=0), np.tile(step, (4, 1)), atol=1e-12)


def test_initialization_restarts_at_the_measured_pose():
    rig = Rig(MEASURED).start_blending()
    rig.advance(3)
    other_pose = MEASURED + [0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    for port in (rig.pose, rig.desired):
        port.GetMutableData().set_value(other_pose)
    rig.simulator.get_mutable_context().SetTime(0.0)
    rig.simulator.Initialize()
    np.testing.assert_array_equal(rig.advance(2), [other_pose, other_pose])


def test_output_moves_in_a_straight_line_within_speed_limit():
    goal = np.array([0.4, 0.2, 0.3, 0.5, 0.3, 0.0])
    rig = Rig(goal).start_blending()
    first = rig.limited_pose
    assert np.linalg.norm((first - MEASURED)[:3]) <= SPEED * PERIOD + 1e-12
    assert np.abs((first - MEASURED)[3:]).max() <= ANGULAR_SPEED * PERIOD + 1e-12
    poses = rig.advance(30)
    steps = np.diff(poses, axis=0)
    assert np.linalg.norm(steps[:, :3], axis=1).max() <= SPEED * PERIOD + 1e-12
    assert np.abs(steps[:, 3:]).max() <= ANGULAR_SPEED * PERIOD + 1e-12
    np.testing.assert_array_equal(poses[-1], goal)
    deviations = np.cross(poses[:, :3] - MEASURED[:3], (goal - MEASURED)[:3])
    np.testing.assert_allclose(deviations, 0.0, atol=1e-12)


def test_pose_within_the_speed_limits_is_output_unchanged():
    rig = Rig(MEASURED).start_blending()
    rig.advance()
    for step in range(5):
        desired = MEASURED + [0.9 * SPEED * PERIOD * step, 0.0, 0.0, 0.9 * ANGULAR_SPEED * PERIOD * step, 0.0, 0.0]
        rig.desired.GetMutableData().set_value(desired)
        np.testing.assert_array_equal(rig.limited_pose, desired)
        rig.advance()


@pytest.mark.parametrize("linear", [[0, 0, 0], [1, 0, 0], [0, 0, 1], [0.6, 0, 0.75]])
@pytest.mark.parametrize("angular", [[0, 0], [1, 0], [-1, 0], [0, 1], [-1, -1]])
def test_pose_at_the_speed_limits_is_output_unchanged(linear, angular):
    desired = [*STEP * np.array(linear), -3.125, *TURN * np.array(angular)]
    np.testing.assert_array_equal(first_pose(desired), desired)


@pytest.mark.parametrize(
    ("linear", "angular", "limited_linear", "limited_angular"),
    [
        ([0, 0, 1.0005], [0, 0], [0, 0, 1], [0, 0]),
        ([1.2, 0, -1.6], [1, 0.5], [0.6, 0, -0.8], [1, 0.5]),
        ([0, 0, 0], [1.0005, 0], [0, 0, 0], [1, 0]),
        ([0, 0, 0], [-1.0005, 0.5], [0, 0, 0], [-1, 0.5]),
        ([1, 0, 0], [0, -1.0005], [1, 0, 0], [0, -1]),
        ([0, 0, 1], [2, -2], [0, 0, 1], [1, -1]),
    ],
)
def test_change_above_a_speed_limit_is_reduced_to_it(linear, angular, limited_linear, limited_angular):
    pose = first_pose([*STEP * np.array(linear), -3.125, *TURN * np.array(angular)])
    change = 2.0 * np.pi - 6.25  # from 3.125 rad to −3.125 rad in the shorter direction, less than TURN
    expected = [*STEP * np.array(limited_linear), 3.125 + change, *TURN * np.array(limited_angular)]
    np.testing.assert_allclose(pose, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("axis", [3, 4, 5])
def test_each_angle_is_limited_while_the_position_is_constant(axis, sign):
    desired = MEASURED.copy()
    desired[axis] += 1.0005 * sign * TURN
    rig = Rig(desired, blend_factor=1.0)
    expected = MEASURED.copy()
    expected[axis] += sign * TURN
    np.testing.assert_allclose(rig.limited_pose, expected, rtol=0.0, atol=1e-12)


def test_position_within_its_limit_is_output_without_rounding():
    system = PoseRateLimiter(period=PERIOD, speed=100.0, angular_speed=0.01)
    context, rng = system.CreateDefaultContext(), np.random.default_rng(0)
    system.get_blend_factor_input_port().FixValue(context, [1.0])
    system.get_pose_input_port().FixValue(context, MEASURED)
    context.SetDiscreteState(MEASURED)
    for position in rng.uniform(-1e-6, 1e-6, (20, 3)):  # the sum of last position and change would have rounding errors
        desired = np.concatenate([position, MEASURED[3:]])
        system.get_desired_pose_input_port().FixValue(context, desired)
        np.testing.assert_array_equal(system.get_limited_pose_output_port().Eval(context), desired)


def first_pose(desired):
    """Return the first output after a start at the pose [0, 0, 0, 3.125, 0, 0]."""
    rig = Rig(np.array(desired), blend_factor=1.0)
    rig.pose.GetMutableData().set_value([0.0, 0.0, 0.0, 3.125, 0.0, 0.0])
    rig.simulator.Initialize()
    return rig.limited_pose


def test_default_speeds_are_0_25_m_per_s_and_1_5_rad_per_s():
    system = PoseRateLimiter(period=PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_desired_pose_input_port().FixValue(context, [9.0, 0.0, 0.0, 0.0, 3.0, 0.0])
    system.get_pose_input_port().FixValue(context, np.zeros(6))
    system.get_blend_factor_input_port().FixValue(context, [1.0])
    simulator.Initialize()
    first = system.get_limited_pose_output_port().Eval(context)
    np.testing.assert_allclose(first, [0.25 * PERIOD, 0.0, 0.0, 0.0, 1.5 * PERIOD, 0.0], rtol=1e-12)


@pytest.mark.parametrize(
    "arguments",
    [
        *({"period": value} for value in (0.0, None)),
        *({name: value} for name in ("speed", "angular_speed") for value in (0.0, np.inf)),
    ],
)
def test_constructor_refuses_arguments_out_of_range(arguments):
    with pytest.raises(InputError):
        PoseRateLimiter(**({"period": PERIOD} | arguments))


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_measured_pose_is_ignored_when_it_is_not_finite(number):
    rig = Rig(MEASURED)
    rig.advance()
    rig.pose.GetMutableData().set_value([number, *MEASURED[1:]])
    np.testing.assert_array_equal(rig.advance(2), [MEASURED] * 2)
    np.testing.assert_array_equal(rig.start_blending().advance(), [MEASURED])
    rig.simulator.get_mutable_context().SetTime(0.0)
    with pytest.raises(InputError, match="measured pose must be finite"):
        rig.simulator.Initialize()


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_desired_pose_is_ignored_when_it_is_not_finite(number):
    rig = Rig(MEASURED + 0.01).start_blending()
    before = rig.advance(4)[-1]
    rig.desired.GetMutableData().set_value([number, *MEASURED[1:]])
    np.testing.assert_array_equal(rig.advance(2)[-1], before)
    rig.desired.GetMutableData().set_value(MEASURED)
    np.testing.assert_allclose(rig.advance(4)[-1], MEASURED)
