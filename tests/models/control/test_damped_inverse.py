import numpy as np
import pytest

from guiderail.models.control.damped_inverse import LEVER, REGULAR, damped_joint_velocities, is_following

SCALE = np.array([LEVER] * 3 + [1.0] * 3)


def jacobian(singular_values, num_joints, rng):
    """Return a random Jacobian (6, n) with the given singular values once its rotations are multiplied by LEVER."""
    U, _ = np.linalg.qr(rng.standard_normal((6, 6)))
    W, _ = np.linalg.qr(rng.standard_normal((num_joints, num_joints)))
    return (U * singular_values) @ W[:, :6].T / SCALE[:, None]


@pytest.mark.parametrize("num_joints", [6, 7])
def test_regular_posture_uses_the_pseudoinverse(num_joints):
    rng = np.random.default_rng(0)
    for _ in range(20):
        J = jacobian(rng.uniform(REGULAR, 1.0, 6), num_joints, rng)
        V, preferred = rng.standard_normal(6), rng.standard_normal(num_joints)
        v, is_regular = damped_joint_velocities(J, V, preferred)
        assert is_regular
        np.testing.assert_allclose(J @ v, V, atol=1e-9)
        null_space = np.eye(num_joints) - np.linalg.pinv(J) @ J
        np.testing.assert_allclose(null_space @ (v - preferred), 0.0, atol=1e-9)


def test_joint_velocities_stay_bounded_near_a_singularity():
    """In any posture, a unit tool speed needs a joint speed of at most 1/σ₀, with σ₀ = REGULAR."""
    rng = np.random.default_rng(1)
    for smallest in (0.05, 0.02, 0.01, 1e-4, 1e-9, 0.0):
        J = jacobian(np.array([1.0, 0.9, 0.5, 0.3, 0.2, smallest]), 6, rng)
        V = rng.standard_normal(6)
        V /= np.linalg.norm(SCALE * V)
        v, is_regular = damped_joint_velocities(J, V, np.zeros(6))
        assert np.linalg.norm(v) <= 1.0 / REGULAR + 1e-6
        assert is_regular == (smallest >= REGULAR)


def test_velocities_are_continuous_where_damping_begins():
    rng = np.random.default_rng(2)
    U, W = (np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in range(2))
    V, preferred = rng.standard_normal((2, 6))
    velocities = []
    for smallest in (REGULAR * (1 - 1e-9), REGULAR * (1 + 1e-9)):
        J = (U * [1.0, 0.9, 0.5, 0.3, 0.2, smallest]) @ W.T / SCALE[:, None]
        velocities.append(damped_joint_velocities(J, V, preferred)[0])
    np.testing.assert_allclose(*velocities, rtol=1e-5)


def test_singular_direction_follows_the_preferred_velocities():
    rng = np.random.default_rng(3)
    J = jacobian(np.array([1.0, 0.9, 0.5, 0.3, 0.2, 0.0]), 6, rng)
    singular = np.linalg.svd(J)[2][-1]
    v, _ = damped_joint_velocities(J, rng.standard_normal(6), 0.7 * singular)
    assert v @ singular == pytest.approx(0.7)


def test_is_following_requires_motion_along_the_velocity():
    J = np.eye(6)
    V = np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0])
    assert is_following(J, V, V)
    assert is_following(J, 0.05 * V, V)
    assert not is_following(J, 0.001 * V, V)
    assert not is_following(J, -V, V)
    assert not is_following(J, V + [0, 0, 0, 0, 0.05, 0], V)
    assert is_following(J, np.zeros(6), 1e-3 * V)
