import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.transforms import (
    angle_between,
    axis_angle_rotation,
    nearest_pose,
    pose_to_transform,
    rpy_angles,
    transform_to_pose,
)
from guiderail.systems.poses import ContinuousPose

PERIOD = 0.02
STEPS = 60


def measure(poses, near):
    """Return the outputs (N, 6) for measured poses (N, 6), one per period."""
    system = ContinuousPose(near, PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    value = system.get_pose_input_port().FixValue(context, poses[0])
    simulator.Initialize()
    outputs = []
    for step, pose in enumerate(poses):
        value.GetMutableData().set_value(pose)
        simulator.AdvanceTo((step + 0.5) * PERIOD)
        outputs.append(system.get_continuous_pose_output_port().Eval(context).copy())
    return np.array(outputs)


@pytest.mark.parametrize("seed", range(20))
def test_turns_in_random_frames_have_no_jumps(seed):
    """Two full turns about a random axis of a random frame; only Ry = ±90° itself is no single orientation."""
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    frame = axis_angle_rotation(rng.standard_normal(3), rng.uniform(0.0, np.pi))
    turns = np.linspace(0.0, 4 * np.pi, 2000)
    poses = []
    for angle in turns:
        R = frame @ axis_angle_rotation(axis, angle)
        poses.append(np.r_[0.1 * angle, -0.2, 0.3, rpy_angles(R)[::-1]])
    poses = np.array(poses)
    near = poses[0] + np.r_[0, 0, 0, 2 * np.pi * rng.integers(-2, 3, 3)]
    last, outputs = near, []
    for pose in poses:
        last = nearest_pose(pose, last)
        outputs.append(last)
    outputs = np.array(outputs)
    np.testing.assert_allclose(outputs[0], near, atol=1e-9)
    for output, pose in zip(outputs[::97], poses[::97], strict=True):
        assert angle_between(output, pose) < 1e-6
    # The speed of Euler angles is at most the angular speed divided by |cos Ry|.
    steps, singular = np.abs(np.diff(outputs[:, 3:], axis=0)), np.abs(np.cos(poses[:, 4]))
    largest = (turns[1] - turns[0]) / np.minimum(singular[1:], singular[:-1]) + 1e-9
    assert (steps.max(axis=1) <= np.maximum(2.0 * largest, 1e-6)).all()


def test_output_continues_beyond_half_a_turn():
    angles = np.linspace(3.0, 3.6, STEPS)
    poses = [np.r_[0.0, 0.0, 0.0, (angle + np.pi) % (2 * np.pi) - np.pi, 0.0, -angle] for angle in angles]
    poses = np.array([transform_to_pose(pose_to_transform(pose)) for pose in poses])
    outputs = measure(poses, poses[0])
    np.testing.assert_allclose(outputs[:, 3], angles, atol=1e-9)
    np.testing.assert_allclose(outputs[:, 5], -angles, atol=1e-9)


def test_output_continues_beyond_the_singular_angle():
    pitches = np.linspace(1.4, 1.8, STEPS)
    poses = np.array([transform_to_pose(pose_to_transform(np.r_[0, 0, 0, 0.2, p, 0.1])) for p in pitches])
    assert np.abs(np.diff(poses[:, 3])).max() > 3.0
    expected = np.column_stack([np.full(STEPS, 0.2), pitches, np.full(STEPS, 0.1)])
    np.testing.assert_allclose(measure(poses, poses[0])[:, 3:], expected, atol=1e-9)


def test_first_output_is_nearest_to_the_given_pose():
    near = np.array([0.0, 0.0, 0.0, 3.1, 0.0, -3.1])
    (output,) = measure(np.array([[0.1, 0.2, 0.3, -3.1, 0.0, 3.1]]), near)
    np.testing.assert_allclose(output, [0.1, 0.2, 0.3, 2 * np.pi - 3.1, 0.0, 3.1 - 2 * np.pi])


def test_pose_that_is_not_finite_is_not_stored():
    turned = np.r_[np.zeros(3), 3.1, 0.0, 0.0]
    poses = np.array([turned, np.full(6, np.nan), -turned])
    outputs = measure(poses, turned)
    assert np.isnan(outputs[1]).all()
    assert outputs[2][3] == pytest.approx(2 * np.pi - 3.1)


def test_each_initialization_begins_at_the_given_pose():
    system = ContinuousPose(np.zeros(6), PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    value = system.get_pose_input_port().FixValue(context, np.zeros(6))
    for step in range(20):
        value.GetMutableData().set_value(np.r_[0, 0, 0, (0.5 * step + np.pi) % (2 * np.pi) - np.pi, 0, 0])
        simulator.AdvanceTo((step + 0.5) * PERIOD)
    assert system.get_continuous_pose_output_port().Eval(context)[3] == pytest.approx(9.5)
    context.SetTime(0.0)
    simulator.Initialize()
    assert system.get_continuous_pose_output_port().Eval(context)[3] == pytest.approx(9.5 - 4 * np.pi)
