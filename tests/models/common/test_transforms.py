"""Rigid transforms computed without Drake, compared with those of Drake."""

import numpy as np
import pytest
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.math import RigidTransform as DrakeTransform
from pydrake.math import RollPitchYaw
from pydrake.math import RotationMatrix as DrakeRotation

from guiderail.models.common import transforms
from guiderail.models.common.transforms import (
    RigidTransform,
    RotationMatrix,
    axis_angle,
    axis_angle_rotation,
    quaternion,
    rpy_angles,
    rpy_rotation,
)
from guiderail.systems.support import drake_multibody

assert_equal = np.testing.assert_array_equal


def angle_pairs():
    """Yield roll, pitch and yaw of two rotations: far apart, close together, equal, half a turn apart, or singular."""
    rng = np.random.default_rng(0)
    for k in range(200):
        a = rng.uniform(-3.0, 3.0, 3)
        yield a, a + rng.normal(size=3) * (1.0 if k % 2 else 10.0 ** -rng.integers(0, 12))
    yield np.zeros(3), np.zeros(3)
    yield np.zeros(3), np.array([np.pi, 0.0, 0.0])
    yield np.zeros(3), np.array([0.3, np.pi / 2, 0.2])


def test_rotations_equal_those_of_drake_bit_by_bit():
    for a, b in angle_pairs():
        R_WA, R_WB = DrakeRotation(RollPitchYaw(*a)), DrakeRotation(RollPitchYaw(*b))
        R = rpy_rotation(*a).inverse() @ rpy_rotation(*b)
        R_AB = R_WA.InvertAndCompose(R_WB)
        assert_equal(R.matrix(), R_AB.matrix())
        assert_equal(rpy_angles(R), RollPitchYaw(R_AB).vector())
        assert_equal(quaternion(R), R_AB.ToQuaternion().wxyz())
        drake, (axis, angle) = R_AB.ToAngleAxis(), axis_angle(R)
        assert_equal([*axis, angle], [*drake.axis(), drake.angle()])
        assert_equal(
            axis_angle_rotation(axis, 0.3 * angle).matrix(), DrakeRotation(AngleAxis(0.3 * angle, axis)).matrix()
        )


def test_poses_equal_those_of_drake_bit_by_bit():
    for a, b in angle_pairs():
        pose = np.concatenate([b, a])
        assert_equal(
            transforms.pose_to_transform(pose).GetAsMatrix34(), drake_multibody.pose_to_transform(pose).GetAsMatrix34()
        )
        X = drake_multibody.pose_to_transform(pose)
        assert_equal(transforms.transform_to_pose(X), drake_multibody.transform_to_pose(X))


def test_transforms_compose_and_invert_as_in_drake():
    for a, b in angle_pairs():
        X, Y = (RigidTransform(rpy_rotation(*r), p) for r, p in ((a, b), (b, a)))
        D, E = (DrakeTransform(RollPitchYaw(*r), p) for r, p in ((a, b), (b, a)))
        np.testing.assert_allclose((X @ Y).GetAsMatrix4(), (D @ E).GetAsMatrix4(), atol=1e-14)
        np.testing.assert_allclose(X.inverse().GetAsMatrix34(), D.inverse().GetAsMatrix34(), atol=1e-14)
        np.testing.assert_allclose(X @ np.array([a, b]).T, D @ np.array([a, b]).T, atol=1e-14)
        assert_equal(X.rotation().col(1), D.rotation().col(1))


@pytest.mark.parametrize("angle", [np.nan, np.inf])
def test_rotation_is_nan_when_an_angle_is_not_finite(angle):
    assert np.isnan(rpy_rotation(angle, 0.0, 0.0).matrix()).any()
    assert np.isnan(axis_angle_rotation([1.0, 0.0, 0.0], angle).matrix()).any()
    assert np.isnan(rpy_angles(RotationMatrix(np.full((3, 3), np.nan)))).any()


def test_translation_is_a_copy_of_the_argument():
    p = np.array([1.0, 2.0, 3.0])
    X = RigidTransform(p)
    p[0] = 5.0
    assert_equal(X.translation(), [1.0, 2.0, 3.0])
