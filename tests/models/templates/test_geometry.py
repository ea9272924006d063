"""Rotations, tilts and interpolation of poses, compared with SciPy's rotations and trigonometry."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from guiderail.models.common.transforms import RigidTransform, RotationMatrix, axis_angle_rotation
from guiderail.models.templates import parts as g

SEEDS = st.integers(0, 2**32 - 1)
ANGLES = st.floats(-math.pi, math.pi)


def random_pose(rng, spread=0.5):
    return RigidTransform(RotationMatrix(Rotation.random(rng=rng).as_matrix()), spread * rng.standard_normal(3))


@given(st.tuples(*[st.floats(-180, 180)] * 3))
def test_matrix_deg_is_roll_pitch_yaw_about_fixed_axes(rpy):
    expected = Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
    np.testing.assert_allclose(g.matrix_deg(rpy), expected, atol=1e-12)


@given(SEEDS)
def test_with_position_in_inverts_position_in(seed):
    rng = np.random.default_rng(seed)
    X_WE, X_WF = random_pose(rng), random_pose(rng)
    p_FE = g.position_in("f", X_WE, {"f": X_WF})
    np.testing.assert_allclose(X_WF @ p_FE, X_WE.translation(), atol=1e-12)
    np.testing.assert_array_equal(g.position_in(g.WORLD, X_WE, {}), X_WE.translation())
    p = rng.standard_normal(3)
    for frame, frames in (("f", {"f": X_WF}), (g.WORLD, {})):
        X = g.with_position_in(frame, p, X_WE, frames)
        np.testing.assert_allclose(g.position_in(frame, X, frames), p, atol=1e-12)
        np.testing.assert_array_equal(X.rotation().matrix(), X_WE.rotation().matrix())


@given(ANGLES, st.floats(1e-6, 2), st.floats(-1, 1))
def test_tilt_axis_tilts_along_the_bearing(azimuth, radius, z):
    p_FE = np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), z])
    towards = g.bearing(p_FE)
    np.testing.assert_allclose(towards, [-math.cos(azimuth), -math.sin(azimuth), 0], atol=1e-9)
    axis = g.tilt_axis(p_FE)
    assert axis @ towards == pytest.approx(0, abs=1e-12)
    z_axis = axis_angle_rotation(axis, 0.3).matrix() @ np.array([0, 0, 1.0])
    np.testing.assert_allclose(z_axis, math.cos(0.3) * np.eye(3)[2] + math.sin(0.3) * towards, atol=1e-12)


def test_bearing_is_x_near_the_axis():
    for p in ([0, 0, 0.3], [9e-10, 0, 0], [0, -9e-10, 1]):
        np.testing.assert_array_equal(g.bearing(np.array(p)), [1, 0, 0])
    np.testing.assert_allclose(g.bearing(np.array([0, 2e-9, 0])), [0, -1, 0], atol=1e-12)
    np.testing.assert_array_equal(g.tilt_axis(np.zeros(3)), [0, 1, 0])
    np.testing.assert_allclose(g.bearing(np.array([0, g.NEAR_AXIS, 0])), [0, -1, 0], atol=1e-12)
    for vector in (g.bearing(np.zeros(3)), g.tilt_axis(np.zeros(3)), g.tilt_axis(np.ones(3))):
        assert vector.shape == (3,)


@given(SEEDS, st.sampled_from([1e-9, 1e-6, 1e-3, 0.1, 1.0, 3.0, math.pi]))
def test_angle_between_is_accurate_up_to_half_a_turn(seed, angle):
    rng = np.random.default_rng(seed)
    R = Rotation.random(rng=rng)
    axis = rng.standard_normal(3)
    rotated = R * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    result = g.angle_between(RotationMatrix(R.as_matrix()), RotationMatrix(rotated.as_matrix()))
    assert result == pytest.approx(angle, rel=1e-6, abs=1e-15 if angle < 3 else 1e-6)


@given(SEEDS, st.floats(0, 1))
def test_between_interpolates_on_a_line_and_about_an_axis(seed, fraction):
    rng = np.random.default_rng(seed)
    A, B = random_pose(rng), random_pose(rng)
    X = g.between(A, B, fraction)
    p = A.translation() + fraction * (B.translation() - A.translation())
    np.testing.assert_allclose(X.translation(), p, atol=1e-12)
    R_A, R_B = Rotation.from_matrix(A.rotation().matrix()), Rotation.from_matrix(B.rotation().matrix())
    expected = R_A * Rotation.from_rotvec(fraction * (R_A.inv() * R_B).as_rotvec())
    np.testing.assert_allclose(X.rotation().matrix(), expected.as_matrix(), atol=1e-9)


def test_between_returns_its_end_poses_exactly():
    rng = np.random.default_rng(0)
    A, B = random_pose(rng), random_pose(rng)
    np.testing.assert_array_equal(g.between(A, B, 0.0).rotation().matrix(), A.rotation().matrix())
    np.testing.assert_array_equal(g.between(A, B, 0.0).translation(), A.translation())
    np.testing.assert_array_equal(g.between(A, B, 1.0).rotation().matrix(), B.rotation().matrix())
