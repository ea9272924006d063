import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.transforms import RigidTransform, axis_angle_rotation, pose_to_transform, transform_to_pose
from guiderail.models.laws.primitive import StateProgress
from guiderail.systems.movement_primitive import ProgressClock

PERIOD = 0.125
RULE = StateProgress((0.01, 0.1), 4)


def steps(rule, poses, command=(0.0, 0.0)):
    """Return the step after each control step with these measured poses."""
    step, result = 0, []
    for k, pose in enumerate(poses):
        step = rule.next_step(step, k + 1, np.array(command), np.array(pose))
        result.append(step)
    return result


def test_progress_follows_the_clock_while_the_robot_is_near():
    assert steps(RULE, [[0.0099, 0.0]] * 5) == [1, 2, 3, 4, 5]
    assert steps(StateProgress((0.01, 0.1), 0), [[1.0, 0.0]] * 5) == [1, 2, 3, 4, 5]


def test_progress_waits_up_to_the_largest_lag_if_robot_is_far():
    far, near = [0.0101, 0.0], [0.0, 0.0]
    assert steps(RULE, [near, far, far, near, far]) == [1, 1, 1, 2, 2]
    assert steps(RULE, [far] * 8) == [0, 0, 0, 0, 1, 2, 3, 4]  # the lag is at most four steps
    assert steps(RULE, [[np.nan, 0.0]] * 3) == [0, 0, 0]


@pytest.mark.parametrize(("angle", "is_waiting"), [(0.099, False), (0.101, True)])
def test_angles_of_a_pose_have_a_separate_tolerance(angle, is_waiting):
    command, pose = np.zeros(6), np.array([0.0, 0.009, 0.0, 2.0 * np.pi, angle, 0.0])
    assert (RULE.next_step(3, 4, command, pose) == 3) == is_waiting
    assert RULE.next_step(3, 4, command, np.array([0.0, 0.0101, 0.0, 0.0, 0.0, 0.0])) == 3


@pytest.mark.parametrize("seed", range(50))
def test_progress_depends_on_the_rotation_and_not_on_its_numbers(seed):
    """Full turns and the other angles of an orientation count as the same; also at the singular Ry = 90°."""
    rng = np.random.default_rng(seed)
    command = np.r_[np.zeros(3), rng.uniform(-4.0, 4.0, 3)]
    if seed % 5 == 0:
        command[4] = np.pi / 2 + 1e-6 * rng.standard_normal()
    near, far = (
        transform_to_pose(pose_to_transform(command) @ RigidTransform(axis_angle_rotation(axis, angle), np.zeros(3)))
        for axis, angle in zip(rng.standard_normal((2, 3)), (0.09, 0.11), strict=True)
    )
    turns = 2 * np.pi * np.r_[np.zeros(3), rng.integers(-1, 2, 3)]
    assert RULE.next_step(3, 4, command, near + turns) == 4
    assert RULE.next_step(3, 4, command, far + turns) == 3


@pytest.mark.parametrize("pose", [[np.nan] * 6, [0, 0, 0, np.inf, 0, 0]])
def test_pose_that_is_not_finite_is_not_near(pose):
    assert RULE.next_step(3, 4, np.zeros(6), np.array(pose)) == 3


def test_motion_time_is_zero_at_each_initialization():
    system = ProgressClock(RULE, 2, PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_command_input_port().FixValue(context, [0.0, 0.0])
    pose = system.get_pose_input_port().FixValue(context, [0.0, 0.0])
    times = []
    for _ in range(2):
        context.SetTime(0.0)
        pose.GetMutableData().set_value([0.0, 0.0])
        simulator.Initialize()
        for k in range(8):
            simulator.AdvanceTo((k + 0.5) * PERIOD)
            times.append(system.get_motion_time_output_port().Eval(context)[0] / PERIOD)
            pose.GetMutableData().set_value([0.02, 0.0] if 1 < k < 5 else [0.0, 0.0])
    assert times == [0, 1, 2, 2, 2, 2, 3, 4] * 2


@pytest.mark.parametrize(("pose", "lag"), [([0.0, 0.0], 0), ([1.0, 0.0], 4)])
def test_steps_are_exact_when_the_period_is_inexact_in_binary(pose, lag):
    period = 0.02  # in floating point, 29 * period / period < 29
    system = ProgressClock(RULE, 2, period)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_command_input_port().FixValue(context, [0.0, 0.0])
    system.get_pose_input_port().FixValue(context, pose)
    for k in range(31):
        simulator.AdvanceTo((k + 0.5) * period)
        assert system.get_motion_time_output_port().Eval(context)[0] == period * max(k - lag, 0)
