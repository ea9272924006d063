import numpy as np
import pytest

from guiderail.models.control.cartesian_impedance import HEAVY, LEVER, LIGHT, impedance_torques, reachable_inertia

SCALE = np.array([1.0] * 3 + [LEVER] * 3)


def inertia_inverse(masses, rng):
    """Return Λ⁻¹ of the given masses, rotational ones at the lever."""
    U, _ = np.linalg.qr(rng.standard_normal((6, 6)))
    return (U / masses) @ U.T / np.outer(SCALE, SCALE)


def test_reachable_inertia_of_a_regular_arm_is_unchanged():
    rng = np.random.default_rng(0)
    Lambda_inverse = inertia_inverse(rng.uniform(1.0, LIGHT, 6), rng)
    np.testing.assert_allclose(reachable_inertia(Lambda_inverse) @ Lambda_inverse, np.eye(6), atol=1e-9)


def test_reachable_inertia_drops_only_the_heavy_direction():
    masses = np.array([1.0, 2.0, 5.0, 10.0, 20.0, HEAVY])
    Lambda_inverse = inertia_inverse(masses, np.random.default_rng(1))
    eigenvalues = np.sort(np.linalg.eigvals(reachable_inertia(Lambda_inverse) @ Lambda_inverse).real)
    np.testing.assert_allclose(eigenvalues, [0, 1, 1, 1, 1, 1], atol=1e-9)


def test_reachable_inertia_falls_smoothly_with_the_mass():
    shares = []
    for mass in np.geomspace(0.5 * LIGHT, 2.0 * HEAVY, 200):
        Lambda_inverse = np.diag([1.0, 1.0, 1.0 / mass, 1.0, 1.0, 1.0])
        shares.append(reachable_inertia(Lambda_inverse)[2, 2] / mass)
    assert shares[0] == pytest.approx(1.0)
    assert shares[-1] == 0.0
    assert (np.diff(shares) <= 1e-12).all()
    assert np.abs(np.diff(shares)).max() < 0.03


@pytest.mark.parametrize("axis", range(6))
def test_reachable_inertia_halves_a_mass_in_the_middle(axis):
    """In the middle between both masses on a logarithmic scale; rotational ones are converted by the lever."""
    masses = np.ones(6)
    masses[axis] = np.sqrt(LIGHT * HEAVY)
    inertia = reachable_inertia(np.diag(1.0 / (masses * SCALE**2)))
    np.testing.assert_allclose(np.diag(inertia)[axis], 0.5 * masses[axis] * SCALE[axis] ** 2, rtol=1e-6)


def law(J, posture_torque, M=None):
    n = J.shape[1]
    return impedance_torques(
        K=np.diag([1500.0] * 3 + [30.0] * 3),
        damping_ratio=1.0,
        wrench_limits=np.full(6, 40.0),
        R_axes=None,
        p_error=np.zeros(3),
        eta=1.0,
        epsilon=np.zeros(3),
        J=J,
        M=np.eye(n) if M is None else M,
        v=np.zeros(n),
        posture_torque=posture_torque,
        gravity_torque=np.zeros(n),
        torque_limits=np.full(n, 100.0),
    ).torque


def test_posture_torque_has_no_effect_with_six_joints():
    rng = np.random.default_rng(2)
    for _ in range(10):
        U, W = (np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in range(2))
        J = (U * rng.uniform(0.2, 1.0, 6)) @ W.T / SCALE[:, None]
        np.testing.assert_allclose(law(J, rng.standard_normal(6)), 0.0, atol=1e-6)


def test_posture_torque_acts_in_the_singular_direction():
    rng = np.random.default_rng(3)
    U, W = (np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in range(2))
    J = (U * [1.0, 0.8, 0.6, 0.4, 0.3, 0.0]) @ W.T / SCALE[:, None]
    lost = W[:, 5]
    torque = law(J, 3.0 * lost + W[:, 0])
    np.testing.assert_allclose(torque, 3.0 * lost, atol=1e-6)


def test_posture_torque_acts_on_a_heavy_rotation():
    M = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, HEAVY * LEVER**2])
    np.testing.assert_allclose(law(np.eye(6), np.ones(6), M), [0.0, 0.0, 0.0, 0.0, 0.0, 1.0], atol=1e-6)


def test_posture_torque_acts_before_the_arm_is_singular():
    rng = np.random.default_rng(3)
    U, W = (np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in range(2))
    J = (U * [1.0, 0.8, 0.6, 0.4, 0.3, (2.0 * HEAVY) ** -0.5]) @ W.T / SCALE[:, None]
    torque = law(J, 3.0 * W[:, 5] + W[:, 0])
    np.testing.assert_allclose(torque, 3.0 * W[:, 5], atol=1e-6)


def test_impedance_torques_refuse_an_invalid_mass_matrix():
    with pytest.raises(np.linalg.LinAlgError, match="mass matrix"):
        law(np.eye(6), np.zeros(6), M=np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0]))
