"""Rigid transforms without Drake agree with Drake's to the last bit."""

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

same = np.testing.assert_array_equal


def pairs():
    """Yield roll, pitch and yaw of two rotations: far apart, close together, equal, half a turn apart, singular."""
    rng = np.random.default_rng(0)
    for k in range(200):
        a = rng.uniform(-3.0, 3.0, 3)
        yield a, a + rng.normal(size=3) * (1.0 if k % 2 else 10.0 ** -rng.integers(0, 12))
    yield np.zeros(3), np.zeros(3)
    yield np.zeros(3), np.array([np.pi, 0.0, 0.0])
    yield np.zeros(3), np.array([0.3, np.pi / 2, 0.2])


def test_rotations_equal_drakes_bit_by_bit():
    for a, b in pairs():
        R_WA, R_WB = DrakeRotation(RollPitchYaw(*a)), DrakeRotation(RollPitchYaw(*b))
        own = rpy_rotation(*a).inverse() @ rpy_rotation(*b)
        R_AB = R_WA.InvertAndCompose(R_WB)
        same(own.matrix(), R_AB.matrix())
        same(rpy_angles(own), RollPitchYaw(R_AB).vector())
        same(quaternion(own), R_AB.ToQuaternion().wxyz())
        drake, (axis, angle) = R_AB.ToAngleAxis(), axis_angle(own)
        same([*axis, angle], [*drake.axis(), drake.angle()])
        same(axis_angle_rotation(axis, 0.3 * angle).matrix(), DrakeRotation(AngleAxis(0.3 * angle, axis)).matrix())


def test_poses_equal_drakes_bit_by_bit():
    for a, b in pairs():
        pose = np.concatenate([b, a])
        same(
            transforms.pose_to_transform(pose).GetAsMatrix34(), drake_multibody.pose_to_transform(pose).GetAsMatrix34()
        )
        X = drake_multibody.pose_to_transform(pose)
        same(transforms.transform_to_pose(X), drake_multibody.transform_to_pose(X))


def test_transforms_compose_and_invert_as_drakes():
    for a, b in pairs():
        X, Y = (RigidTransform(rpy_rotation(*r), p) for r, p in ((a, b), (b, a)))
        D, E = (DrakeTransform(RollPitchYaw(*r), p) for r, p in ((a, b), (b, a)))
        np.testing.assert_allclose((X @ Y).GetAsMatrix4(), (D @ E).GetAsMatrix4(), atol=1e-14)
        np.testing.assert_allclose(X.inverse().GetAsMatrix34(), D.inverse().GetAsMatrix34(), atol=1e-14)
        np.testing.assert_allclose(X @ np.array([a, b]).T, D @ np.array([a, b]).T, atol=1e-14)
        same(X.rotation().col(1), D.rotation().col(1))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_rotation_is_nan_for_angles_that_are_not_finite(bad):
    assert np.isnan(rpy_rotation(bad, 0.0, 0.0).matrix()).any()
    assert np.isnan(axis_angle_rotation([1.0, 0.0, 0.0], bad).matrix()).any()
    assert np.isnan(rpy_angles(RotationMatrix(np.full((3, 3), np.nan)))).any()


def test_translation_is_a_copy():
    p = np.array([1.0, 2.0, 3.0])
    X = RigidTransform(p)
    p[0] = 5.0
    same(X.translation(), [1.0, 2.0, 3.0])
