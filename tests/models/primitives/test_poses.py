import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import pose_demonstrations, pose_outputs, pose_rotation


def rotating_poses(total, n=60, axis=(0.0, 0.0, 1.0)):
    """Return positions (n, 3) and quaternions (n, 4) of a rotation by `total` [rad], some with the opposite sign."""
    rotations = Rotation.from_rotvec(np.outer(np.linspace(0, total, n), axis))
    quaternions = rotations.as_quat(scalar_first=True)
    quaternions[::7] *= -1
    return np.column_stack([np.linspace(0, 1, n)] * 3), quaternions


@pytest.mark.parametrize("orientation", ["euler_zyx", "rotation_vector"])
@pytest.mark.parametrize("total", [np.pi / 2, 1.2 * np.pi, 3.5 * np.pi])
def test_outputs_are_continuous_and_equal_the_rotation(orientation, total):
    positions, quaternions = rotating_poses(total)
    outputs = pose_outputs(positions, quaternions, np.zeros(3), [1, 0, 0, 0], orientation)
    assert np.abs(np.diff(outputs[:, 3:], axis=0)).max() < 2 * total / 59
    difference = pose_rotation(outputs[:, 3:], orientation).inv() * Rotation.from_quat(quaternions, scalar_first=True)
    assert difference.magnitude().max() < 1e-9


def test_outputs_are_relative_to_the_target_frame():
    """The outputs of the target are zero; a point 1 m along the target's x axis has the outputs (1, 0, 0)."""
    R_WT = Rotation.from_euler("z", 90, degrees=True)
    q = R_WT.as_quat(scalar_first=True)
    p_WT = np.array([1.0, 2.0, 3.0])
    outputs = pose_outputs(np.array([p_WT, p_WT + [0, 1, 0]]), np.array([q, q]), p_WT, q)
    np.testing.assert_allclose(outputs, [[0] * 6, [1, 0, 0, 0, 0, 0]], atol=1e-12)


def test_demonstrations_share_a_branch():
    """Of two recordings of a motion, one starts before a half turn and one starts beyond."""
    n = 40
    position = np.zeros((n, 3))
    first = Rotation.from_rotvec(np.outer(np.linspace(3.10, 2.0, n), [0, 0, 1])).as_quat(scalar_first=True)
    second = Rotation.from_rotvec(np.outer(np.linspace(3.18, 2.0, n), [0, 0, 1])).as_quat(scalar_first=True)
    for orientation, column in (("rotation_vector", 5), ("euler_zyx", 3)):
        d = pose_demonstrations(
            [np.arange(n)] * 2, [position] * 2, [first, second], np.zeros(3), [1, 0, 0, 0], orientation
        )
        assert abs(d.outputs[0][0, column] - d.outputs[1][0, column]) < 0.1


def test_branch_is_the_full_turn_nearest_to_the_given_angles():
    """The outputs start at the number of full turns that is nearest to `near`."""
    position, quaternions = rotating_poses(0.4)
    for turns in (-2, -1, 0, 1, 3):
        near = np.array([2 * np.pi * turns + 2.0, 0.0, 0.0])
        outputs = pose_outputs(position, quaternions, np.zeros(3), [1, 0, 0, 0], near=near)
        np.testing.assert_allclose(outputs[0, 3:], [2 * np.pi * turns, 0, 0], atol=1e-12)


def test_first_demonstration_determines_the_branch():
    """The starts are about a sixth of a turn apart; the fourth is more than half a turn from the first."""
    n, starts = 5, np.deg2rad([170.0, 110.0, 50.0])
    quaternions = [
        Rotation.from_rotvec(np.outer(np.linspace(start, start - 0.1, n), [0, 0, 1])).as_quat(scalar_first=True)
        for start in (*starts, np.deg2rad(-15.0))
    ]
    d = pose_demonstrations([np.arange(n)] * 4, [np.zeros((n, 3))] * 4, quaternions, np.zeros(3), [1, 0, 0, 0])
    assert [round(np.rad2deg(y[0, 3])) for y in d.outputs] == [170, 110, 50, 345]


def test_pose_outputs_accept_lists():
    positions, quaternions = rotating_poses(1.0)
    from_arrays = pose_outputs(positions, quaternions, np.zeros(3), [1, 0, 0, 0])
    from_lists = pose_outputs(positions.tolist(), quaternions.tolist(), [0, 0, 0], [1, 0, 0, 0])
    np.testing.assert_array_equal(from_lists, from_arrays)


def test_target_is_the_last_pose_by_default():
    positions, quaternions = rotating_poses(1.0)
    d = pose_demonstrations([np.arange(60)], [positions], [quaternions])
    np.testing.assert_allclose(d.outputs[0][-1], 0, atol=1e-12)


def test_pose_outputs_refuse_invalid_poses():
    positions, quaternions = rotating_poses(1.0)
    with pytest.raises(InputError, match="singular"):
        pose_outputs(*rotating_poses(np.pi / 2, axis=(0, 1, 0)), np.zeros(3), [1, 0, 0, 0])
    with pytest.raises(InputError, match="length zero"):
        pose_outputs(positions, 0 * quaternions, np.zeros(3), [1, 0, 0, 0])
    with pytest.raises(InputError, match="choose"):
        pose_outputs(positions, quaternions, np.zeros(3), [1, 0, 0, 0], "quaternion")
    with pytest.raises(InputError, match="choose euler_zyx or rotation_vector"):
        pose_rotation(np.zeros(3), "quaternion")
    for array in (positions, quaternions):
        poses = [positions.copy(), quaternions.copy()]
        poses[0 if array is positions else 1][3, 1] = np.nan
        with pytest.raises(InputError, match="NaN"):
            pose_outputs(*poses, np.zeros(3), [1, 0, 0, 0])
    for target in ([0.0, np.nan, 0.0], [1, 0, 0, 0]), (np.zeros(3), [np.nan, 0, 0, 0]):
        with pytest.raises(InputError, match="NaN"):
            pose_outputs(positions, quaternions, *target)
    with pytest.raises(InputError, match="length zero"):
        pose_outputs(positions, quaternions, np.zeros(3), [1e-7, 0, 0, 0])
    pose_outputs(positions, quaternions, np.zeros(3), [1e-5, 0, 0, 0])
