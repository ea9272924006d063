import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.pose_rate_limiter import PoseRateLimiter

PERIOD, SPEED, ANGULAR_SPEED = 0.125, 0.2, 0.4
MEASURED = np.array([0.1, -0.2, 0.3, 1.0, 0.0, 0.0])


class Ramped:
    def __init__(self, desired, blend_factor=0.0):
        self.system = PoseRateLimiter(period=PERIOD, speed=SPEED, angular_speed=ANGULAR_SPEED)
        self.simulator = Simulator(self.system)
        context = self.simulator.get_mutable_context()
        self.desired = self.system.get_desired_pose_input_port().FixValue(context, desired)
        self.pose = self.system.get_pose_input_port().FixValue(context, MEASURED)
        self.blend_factor = self.system.get_blend_factor_input_port().FixValue(context, [blend_factor])
        self.simulator.Initialize()

    def go(self, steps=1):
        """The poses just before each of the next instants."""
        poses = []
        for _ in range(steps):
            self.simulator.AdvanceTo(self.simulator.get_context().get_time() + PERIOD)
            poses.append(self.system.get_limited_pose_output_port().Eval(self.simulator.get_context()).copy())
        return np.array(poses)

    def copy_state_from(self):
        self.go()
        self.blend_factor.GetMutableData().set_value([0.1])
        return self


def test_stays_where_the_robot_is_while_it_stands_by():
    ramped = Ramped(np.zeros(6))
    np.testing.assert_array_equal(ramped.go(3), np.tile(MEASURED, (3, 1)))
    pushed = MEASURED + 0.05
    ramped.pose.GetMutableData().set_value(pushed)
    np.testing.assert_array_equal(ramped.go()[0], pushed)


def test_where_there_is_authority_from_the_beginning_it_starts_where_the_robot_is():
    ramped = Ramped(MEASURED + [10.0, 0.0, 0.0, 0.0, 0.0, 0.0], blend_factor=1.0)
    step = np.array([SPEED * PERIOD, 0.0, 0.0, 0.0, 0.0, 0.0])
    first = ramped.system.get_limited_pose_output_port().Eval(ramped.simulator.get_context()).copy()
    np.testing.assert_allclose(first, MEASURED + step, atol=1e-12)
    np.testing.assert_allclose(np.diff([first, *ramped.go(4)], axis=0), np.tile(step, (4, 1)), atol=1e-12)


def test_an_initialization_starts_where_the_robot_is_then():
    ramped = Ramped(MEASURED).copy_state_from()
    ramped.go(3)
    elsewhere = MEASURED + [0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
    for port in (ramped.pose, ramped.desired):
        port.GetMutableData().set_value(elsewhere)
    ramped.simulator.get_mutable_context().SetTime(0.0)
    ramped.simulator.Initialize()
    np.testing.assert_array_equal(ramped.go(2), [elsewhere, elsewhere])


def test_goes_from_there_along_a_straight_line_never_faster_than_it_may():
    goal = np.array([0.4, 0.2, 0.3, 0.5, 0.3, 0.0])
    ramped = Ramped(goal).copy_state_from()
    first = ramped.system.get_limited_pose_output_port().Eval(ramped.simulator.get_context())
    assert np.linalg.norm((first - MEASURED)[:3]) <= SPEED * PERIOD + 1e-12
    assert np.abs((first - MEASURED)[3:]).max() <= ANGULAR_SPEED * PERIOD + 1e-12
    poses = ramped.go(30)
    steps = np.diff(poses, axis=0)
    assert np.linalg.norm(steps[:, :3], axis=1).max() <= SPEED * PERIOD + 1e-12
    assert np.abs(steps[:, 3:]).max() <= ANGULAR_SPEED * PERIOD + 1e-12
    np.testing.assert_array_equal(poses[-1], goal)
    across = np.cross(poses[:, :3] - MEASURED[:3], (goal - MEASURED)[:3])
    np.testing.assert_allclose(across, 0.0, atol=1e-12)


def test_turns_the_shorter_way():
    ramped = Ramped(np.array([*MEASURED[:3], -3.1, 0.0, 0.0]))
    ramped.pose.GetMutableData().set_value([*MEASURED[:3], 3.1, 0.0, 0.0])
    poses = ramped.copy_state_from().go(4)
    np.testing.assert_array_equal(poses[-1][3:], [-3.1, 0.0, 0.0])


def test_what_keeps_to_the_speed_is_passed_on_as_it_is():
    ramped = Ramped(MEASURED).copy_state_from()
    ramped.go()
    for step in range(5):
        desired = MEASURED + [0.9 * SPEED * PERIOD * step, 0.0, 0.0, 0.9 * ANGULAR_SPEED * PERIOD * step, 0.0, 0.0]
        ramped.desired.GetMutableData().set_value(desired)
        now = ramped.system.get_limited_pose_output_port().Eval(ramped.simulator.get_context())
        np.testing.assert_array_equal(now, desired)
        ramped.go()


@pytest.mark.parametrize("wrong", [{"period": 0.0}, {"speed": 0.0}, {"angular_speed": np.inf}])
def test_refuses_what_makes_no_sense(wrong):
    with pytest.raises(InputError):
        PoseRateLimiter(**({"period": PERIOD} | wrong))


def test_a_pose_that_is_no_number_is_not_remembered():
    ramped = Ramped(MEASURED + 0.01).copy_state_from()
    before = ramped.go(4)[-1]
    ramped.desired.GetMutableData().set_value([np.nan, *MEASURED[1:]])
    np.testing.assert_array_equal(ramped.go(2)[-1], before)
    ramped.desired.GetMutableData().set_value(MEASURED)
    np.testing.assert_allclose(ramped.go(4)[-1], MEASURED)
