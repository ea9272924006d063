"""Recorded poses in the frame of a target."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail_data.formats.recorded import poses_in_target


@pytest.mark.parametrize("target", [[1.0, 2.0, 3.0], [0.0, 0.0, 0.0, np.nan, 0.0, 0.0], 1.0, ["a"] * 6])
def test_target_is_refused_when_not_a_pose(target):
    with pytest.raises(InputError, match=r"^target "):
        poses_in_target(np.zeros((2, 3)), Rotation.identity(2), target)


def test_singular_angles_are_refused_without_a_turned_target():
    rotations = Rotation.from_euler("y", np.linspace(80.0, 100.0, 21)[:, None], degrees=True)
    with pytest.raises(InputError, match="Ry comes near ±90°"):
        poses_in_target(np.zeros((21, 3)), rotations, None)
    poses = poses_in_target(np.zeros((21, 3)), rotations, [0.0, 0.0, 0.0, 0.0, 90.0, 0.0])
    np.testing.assert_allclose(
        np.rad2deg(poses[:, 3:]), np.column_stack([np.zeros(21), np.arange(-10, 11), np.zeros(21)]), atol=1e-9
    )
