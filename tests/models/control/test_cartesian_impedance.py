"""Mechanical properties of the impedance law: passivity, damping ratio, limits, null space."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.linalg import eigh
from scipy.spatial.transform import Rotation

from guiderail.models.control import cartesian_impedance as module
from guiderail.models.control.cartesian_impedance import (
    HEAVY,
    LEVER,
    LIGHT,
    ArmImpedance,
    damping_matrix,
    impedance_torques,
    reachable_inertia,
    spring_wrench,
)
from guiderail.models.control.wrench import MovingInertia, WrenchBound, bounded_wrench

SEEDS = st.integers(0, 2**32 - 1)
UNLIMITED = np.full(6, 1e9)


def positive(rng, size, scale=1.0):
    A = rng.standard_normal((size, size))
    return scale * (A @ A.T + 0.3 * np.eye(size))


def quaternion(R):
    x, y, z, w = R.as_quat()
    return (w, np.array([x, y, z])) if w >= 0 else (-w, -np.array([x, y, z]))


def arm(seed, joints=7, **changes):
    """Return arguments of an arm in a random posture with a pose error and without limits."""
    rng = np.random.default_rng(seed)
    eta, epsilon = quaternion(Rotation.random(rng=rng) ** 0.3)
    return {
        "K": np.diag([1500.0, 1000, 800, 40, 30, 20]) + positive(rng, 6),
        "damping_ratio": 0.7,
        "wrench_limits": UNLIMITED,
        "p_error": 0.02 * rng.standard_normal(3),
        "eta": eta,
        "epsilon": epsilon,
        "J": rng.standard_normal((6, joints)),
        "M": positive(rng, joints),
        "v": 0.3 * rng.standard_normal(joints),
        "posture_torque": rng.standard_normal(joints),
        "gravity_torque": 10 * rng.standard_normal(joints),
        "torque_limits": np.full(joints, 1e9),
        **changes,
    }


def torques(bound=None, **arguments):
    return impedance_torques(ArmImpedance(**arguments), bound)


@given(SEEDS)
def test_spring_wrench_is_the_gradient_of_its_potential(seed):
    """The work of a small motion equals the change of the potential ½ eᵀKe with e = [p, 2ε]."""
    rng = np.random.default_rng(seed)
    K = positive(rng, 6, 100.0)
    p, R_error = 0.1 * rng.standard_normal(3), Rotation.random(rng=rng) ** 0.6
    motion = rng.standard_normal(6)

    def potential(s):
        # A tool displacement s·motion reduces the position error, and its rotation is removed from R_desired Rᵀ.
        _, epsilon = quaternion(R_error * Rotation.from_rotvec(-s * motion[3:]))
        e = np.concatenate([p - s * motion[:3], 2 * epsilon])
        return 0.5 * e @ K @ e

    eta, epsilon = quaternion(R_error)
    wrench = spring_wrench(K, p, eta, epsilon)
    h = 1e-5
    slope = (potential(h) - potential(-h)) / (2 * h)
    assert wrench @ motion == pytest.approx(-slope, rel=1e-5, abs=1e-5)


def test_spring_wrench_is_linear_for_small_rotations():
    K = np.diag([1.0, 2, 3, 40, 50, 60])
    turn = np.array([1e-4, -2e-4, 3e-4])
    eta, epsilon = quaternion(Rotation.from_rotvec(turn))
    wrench = spring_wrench(K, np.array([0.1, 0.2, 0.3]), eta, epsilon)
    np.testing.assert_allclose(wrench, [0.1, 0.4, 0.9, 4e-3, -1e-2, 1.8e-2], rtol=1e-3)


@given(SEEDS, st.floats(0.1, 1.5), st.sampled_from([1e-2, 100.0]))
def test_every_mode_has_the_damping_ratio(seed, ratio, scale):
    """The modes of Λ ẍ + D ẋ + K x = 0 decouple, each with damping ratio ζ."""
    rng = np.random.default_rng(seed)
    K, Lambda = positive(rng, 6, scale), positive(rng, 6)
    D = damping_matrix(K, np.linalg.inv(Lambda), ratio)
    np.testing.assert_allclose(D, D.T, atol=1e-9 * np.abs(D).max())
    squared, modes = eigh(K, Lambda)
    in_modes = modes.T @ D @ modes
    np.testing.assert_allclose(in_modes, np.diag(2 * ratio * np.sqrt(squared)), atol=1e-6 * np.sqrt(squared.max()))


@given(SEEDS)
def test_torques_are_the_wrench_and_gravity_in_joint_space(seed):
    arguments = arm(seed, posture_torque=np.zeros(7))
    result = torques(**arguments)
    Lambda_inverse = arguments["J"] @ np.linalg.solve(arguments["M"], arguments["J"].T)
    spring = spring_wrench(arguments["K"], arguments["p_error"], arguments["eta"], arguments["epsilon"])
    wrench = spring - damping_matrix(arguments["K"], Lambda_inverse, 0.7) @ (arguments["J"] @ arguments["v"])
    np.testing.assert_allclose(result.wrench, wrench, rtol=1e-5, atol=1e-5 * np.abs(wrench).max())
    np.testing.assert_allclose(result.torque, arguments["J"].T @ result.wrench + arguments["gravity_torque"], atol=1e-9)
    assert not result.is_saturated


@given(SEEDS)
def test_posture_torque_does_not_accelerate_the_tool(seed):
    arguments = arm(seed)
    Lambda_inverse = arguments["J"] @ np.linalg.solve(arguments["M"], arguments["J"].T)
    # Near a singular posture a part of the posture torque accelerates the tool, so that the arm leaves the posture.
    assume(np.allclose(reachable_inertia(Lambda_inverse) @ Lambda_inverse, np.eye(6)))
    with_posture = torques(**arguments)
    without = torques(**arm(seed, posture_torque=np.zeros(7)))
    np.testing.assert_array_equal(with_posture.wrench, without.wrench)
    added = with_posture.torque - without.torque
    acceleration = arguments["J"] @ np.linalg.solve(arguments["M"], added)
    assert np.abs(acceleration).max() < 1e-6 * np.abs(arguments["posture_torque"]).max() * 100
    # The posture torque acts on the joints: seven joints have one direction that does not move the tool.
    assert np.abs(added).max() > 1e-6


@given(SEEDS, st.floats(0.01, 3.0))
def test_wrench_is_clipped_per_axis(seed, share):
    """Spring and damper are clipped together, and each axis separately."""
    unlimited = torques(**arm(seed))
    limits = share * np.abs(unlimited.wrench).max() * np.linspace(0.2, 1, 6)
    result = torques(**arm(seed, wrench_limits=limits))
    np.testing.assert_allclose(result.wrench, np.clip(unlimited.wrench, -limits, limits), rtol=1e-12)
    assert result.is_saturated == bool((np.abs(unlimited.wrench) >= limits).any())


@given(SEEDS, st.floats(0.01, 3.0))
def test_torques_are_clipped_to_the_motor_limits(seed, share):
    unlimited = torques(**arm(seed))
    limits = share * np.abs(unlimited.torque).max() * np.linspace(0.2, 1, 7)
    result = torques(**arm(seed, torque_limits=limits))
    np.testing.assert_allclose(result.torque, np.clip(unlimited.torque, -limits, limits), rtol=1e-12)
    assert result.is_saturated == bool((np.abs(unlimited.torque) > limits).any())


STIFF = {"contact_stiffness": 2.5e4, "contact_lever": 0.05}
BOUNDS = {
    "wide": WrenchBound(np.full(6, 1e6), 1e6, 1e6),
    "narrow": WrenchBound(np.array([4.0, 5.0, 6.0, 0.4, 0.5, 0.6]), 6.0, 0.7),
    "approach": WrenchBound(np.full(6, 1e6), 30.0, 1e6, **STIFF),
}


@pytest.mark.parametrize("name", BOUNDS)
@given(seed=SEEDS)
def test_bound_limits_spring_and_damper_along_the_axes(name, seed):
    arguments, bound = arm(seed), BOUNDS[name]
    Lambda_inverse = arguments["J"] @ np.linalg.solve(arguments["M"], arguments["J"].T) + 1e-9 * np.eye(6)
    V, K = arguments["J"] @ arguments["v"], arguments["K"]
    spring = spring_wrench(K, arguments["p_error"], arguments["eta"], arguments["epsilon"])
    damping = damping_matrix(K, Lambda_inverse, 0.7) @ V
    along = [(V[i] @ V[i]) / (V[i] @ Lambda_inverse[i, i] @ V[i]) for i in (slice(0, 3), slice(3, 6))]
    expected = bounded_wrench(spring, damping, V, MovingInertia(*along), bound)
    result = torques(**arguments | {"bound": bound})
    np.testing.assert_allclose(result.wrench, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert result.is_saturated == (np.abs(expected - (spring - damping)).max() > 1e-6)
    if name == "wide":
        assert not result.is_saturated


@pytest.mark.parametrize(("force", "is_saturated"), [(1e-9, False), (1.0005e-9, True)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_rounding_by_a_bound_is_no_saturation(sign, force, is_saturated):
    """At rest, a clipped force counts as saturation above 1e-9 N."""
    K, error = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), np.array([0.0, 0.5 * sign * force, 0.0])
    arguments = arm(0, K=K, v=np.zeros(7), p_error=error, eta=1.0, epsilon=np.zeros(3))
    axes = np.array([1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    result = torques(**arguments | {"bound": WrenchBound(axes, np.inf, np.inf, **STIFF)})
    assert result.is_saturated == is_saturated


@pytest.mark.parametrize(("speed", "stretch"), [(0.3, 0.01), (1e-3, 0.01), (0.0, 0.01), (0.0, 0.0)])
def test_bound_uses_the_inertia_along_the_motion_or_at_rest_along_the_spring(speed, stretch, monkeypatch):
    """Translation along x and rotation about y; at rest, translation along y and rotation about z."""
    inertias = []
    monkeypatch.setattr(module, "bounded_wrench", lambda spring, *others: inertias.append(others[2]) or spring)
    M, turn = positive(np.random.default_rng(0), 6), Rotation.from_rotvec([0.0, 0.0, stretch])
    eta, epsilon = quaternion(turn)
    changed = {"K": np.diag([1500.0, 1000, 800, 40, 30, 20]), "J": np.eye(6), "M": M}
    motion = {"v": speed * np.eye(6)[0] + speed * np.eye(6)[4], "p_error": np.array([0.0, stretch, 0.0])}
    torques(WrenchBound(UNLIMITED, 1e9, 1e9), **arm(0, 6, eta=eta, epsilon=epsilon, **changed, **motion))
    inverse = np.linalg.inv(M)
    expected = [1.0 / inverse[i, i] for i in ((0, 4) if speed else (1, 5))] if speed or stretch else [1.0, 1.0]
    np.testing.assert_allclose([inertias[0].mass, inertias[0].moment], expected, rtol=1e-4)


def test_thresholds_have_their_documented_values():
    assert (module.LIGHT, module.HEAVY, module.LEVER) == (300.0, 3000.0, 0.25)
    np.testing.assert_array_equal(module._REGULARIZATION, 1e-9 * np.eye(6))
    np.testing.assert_array_equal(module._SCALE, [1.0, 1.0, 1.0, 0.25, 0.25, 0.25])


@pytest.mark.parametrize("number", range(6))
@pytest.mark.parametrize("size", [1.0, 1.0005])
def test_wrench_at_its_limit_is_saturated(number, size):
    K = np.diag([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])
    error = 1.0 * (np.arange(6) == number)
    errors = {"p_error": error[:3], "eta": 0.0, "epsilon": error[3:]}
    arguments = arm(0, K=K, v=np.zeros(7), wrench_limits=np.full(6, size), **errors)
    assert torques(**arguments).is_saturated == (size == 1.0 and number < 3)


def test_law_refuses_an_inertia_that_is_not_positive():
    with pytest.raises(np.linalg.LinAlgError, match="tool"):
        damping_matrix(np.eye(6), -np.eye(6), 1.0)


def test_law_refuses_a_stiffness_that_is_not_finite():
    with pytest.raises(np.linalg.LinAlgError, match="modes"):
        damping_matrix(np.full((6, 6), np.nan), np.eye(6), 1.0)


def test_singular_arm_gets_finite_torques():
    J = np.zeros((6, 7))
    J[:5, :5] = np.eye(5)
    result = torques(**arm(0, J=J))
    assert np.isfinite(result.torque).all()
    assert np.isfinite(result.wrench).all()


SCALE = np.array([1.0] * 3 + [LEVER] * 3)


def inertia_inverse(masses, rng):
    """Return Λ⁻¹ of six masses [kg] along random directions; a moment of inertia is that of a mass at LEVER."""
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
    """The mass is the geometric mean of LIGHT and HEAVY; a moment of inertia is that of the mass at LEVER."""
    masses = np.ones(6)
    masses[axis] = np.sqrt(LIGHT * HEAVY)
    inertia = reachable_inertia(np.diag(1.0 / (masses * SCALE**2)))
    np.testing.assert_allclose(np.diag(inertia)[axis], 0.5 * masses[axis] * SCALE[axis] ** 2, rtol=1e-6)


def torques_at_rest(J, posture_torque, M=None):
    """Return the torques of an arm at rest without a pose error."""
    n = J.shape[1]
    return torques(
        K=np.diag([1500.0] * 3 + [30.0] * 3),
        damping_ratio=1.0,
        wrench_limits=np.full(6, 40.0),
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
        np.testing.assert_allclose(torques_at_rest(J, rng.standard_normal(6)), 0.0, atol=1e-6)


def test_posture_torque_acts_in_the_singular_direction():
    rng = np.random.default_rng(3)
    U, W = (np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in range(2))
    J = (U * [1.0, 0.8, 0.6, 0.4, 0.3, 0.0]) @ W.T / SCALE[:, None]
    singular = W[:, 5]
    torque = torques_at_rest(J, 3.0 * singular + W[:, 0])
    np.testing.assert_allclose(torque, 3.0 * singular, atol=1e-6)


def test_posture_torque_acts_on_a_heavy_rotation():
    M = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, HEAVY * LEVER**2])
    np.testing.assert_allclose(torques_at_rest(np.eye(6), np.ones(6), M), [0.0, 0.0, 0.0, 0.0, 0.0, 1.0], atol=1e-6)


def test_posture_torque_acts_before_the_arm_is_singular():
    rng = np.random.default_rng(3)
    U, W = (np.linalg.qr(rng.standard_normal((6, 6)))[0] for _ in range(2))
    J = (U * [1.0, 0.8, 0.6, 0.4, 0.3, (2.0 * HEAVY) ** -0.5]) @ W.T / SCALE[:, None]
    torque = torques_at_rest(J, 3.0 * W[:, 5] + W[:, 0])
    np.testing.assert_allclose(torque, 3.0 * W[:, 5], atol=1e-6)


def test_impedance_torques_refuse_an_invalid_mass_matrix():
    with pytest.raises(np.linalg.LinAlgError, match="mass matrix"):
        torques_at_rest(np.eye(6), np.zeros(6), M=np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1.0]))
