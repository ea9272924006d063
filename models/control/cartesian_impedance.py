"""The law of a Cartesian impedance: a spring to a desired pose, and a damper that suits the spring and the inertia.

Every vector of six here is [translational, rotational], and everything is in the axes of one frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from guiderail.models.common.arrays import cross

_REGULARIZATION = 1e-9 * np.eye(6)  # keeps the inertia of a singular arm finite

# Towards a singular posture the arm gets ever heavier at the tool, in the direction that it loses. Up to the first mass
# [kg] a direction is the impedance's alone, from the second on the posture's; usual ones weigh 1 to 50 kg.
LIGHT, HEAVY = 300.0, 3000.0
# The distance from the tool centre at which a turning tool counts as a mass [m].
LEVER = 0.25
_SCALE = np.array([1.0, 1.0, 1.0, LEVER, LEVER, LEVER])


@dataclass(frozen=True)
class JointTorques:
    """What a step of the law leads to; `wrench` (6,) is the impedance's, `torque` (n,) what is sent."""

    torque: np.ndarray
    wrench: np.ndarray
    is_saturated: bool


def spring_wrench(K: np.ndarray, p_error: np.ndarray, eta: float, epsilon: np.ndarray) -> np.ndarray:
    """The wrench of the potential ½ eᵀ K e, e = [p_error, 2ε], at an orientation error of quaternion (η, ε).

    Its rotational part is E(η, ε)ᵀ times that of K e, E = η I + [ε]× (Caccavale, Natale, Siciliano, Villani 1999):
    exactly the potential's gradient, so that a spring never gives back more than it was given. For small errors it is
    K times the rotation vector.

    Args:
        K: stiffness (6, 6), symmetric, positive definite.
        p_error: desired minus actual position, (3,).
        eta, epsilon: of R_desired Rᵀ.
    """
    generalized = K @ np.concatenate([p_error, 2.0 * epsilon])
    torque = generalized[3:]
    return np.concatenate([generalized[:3], eta * torque - cross(epsilon, torque)])


def damping_matrix(K: np.ndarray, Lambda_inverse: np.ndarray, damping_ratio: float) -> np.ndarray:
    """D = 2 ζ L (L⁻¹ K L⁻ᵀ)^½ Lᵀ with Λ = L Lᵀ: every mode of the pair (K, Λ) has the damping ratio ζ.

    Args:
        K: stiffness (6, 6), symmetric, positive definite.
        Lambda_inverse: Λ⁻¹ = J M⁻¹ Jᵀ, the inertia at the tool, inverted.
        damping_ratio: ζ.
    """
    L_modes, eigenvalues = _modes(K, _root_of_inverse(Lambda_inverse))
    return (L_modes * _dampings(eigenvalues, damping_ratio)) @ L_modes.T


def _root_of_inverse(Lambda_inverse: np.ndarray) -> np.ndarray:
    """R⁻¹, (6, 6), lower triangular, of Λ⁻¹ = R Rᵀ: Λ = R⁻ᵀ R⁻¹, and nothing else has to be inverted."""
    # LAPACK itself: what NumPy does around six numbers takes longer than they do.
    R, failed = lapack.dpotrf(Lambda_inverse, lower=1, clean=1)
    if failed:
        raise np.linalg.LinAlgError("the inertia at the tool is not positive definite")
    return lapack.dtrtri(R, lower=1)[0]


def _modes(K: np.ndarray, R_inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """L U with L = R⁻ᵀ, Λ = L Lᵀ and (L U)ᵀ Λ⁻¹ L U = 1, U the eigenvectors of L⁻¹ K L⁻ᵀ, and its eigenvalues, (6,)."""
    R = lapack.dtrtri(R_inverse, lower=1)[0]
    eigenvalues, modes, failed = lapack.dsyevd(R.T @ K @ R, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the modes of the stiffness did not converge")
    return R_inverse.T @ modes, eigenvalues


def _dampings(eigenvalues: np.ndarray, damping_ratio: float) -> np.ndarray:
    return 2.0 * damping_ratio * np.sqrt(np.maximum(eigenvalues, 0.0))


def reachable_inertia(Lambda_inverse: np.ndarray) -> np.ndarray:
    """Λ without the directions that a singular arm has lost: each eigenvalue, a mass m, times its share of [0, 1].

    The share falls smoothly with log m, from 1 at `LIGHT` to 0 at `HEAVY`: a damped inverse of Λ⁻¹ that damps nothing
    where the arm is regular. It is what makes the posture's torque act where the tool's wrench can't.

    Args:
        Lambda_inverse: Λ⁻¹ = J M⁻¹ Jᵀ, (6, 6), positive definite, [translational, rotational].
    """
    eigenvalues, directions = np.linalg.eigh(_SCALE[:, None] * Lambda_inverse * _SCALE)
    masses = 1.0 / eigenvalues
    x = np.clip(np.log(masses / LIGHT) / np.log(HEAVY / LIGHT), 0.0, 1.0)
    scaled = _SCALE[:, None] * directions
    return (scaled * (masses * (1.0 - x * x * (3.0 - 2.0 * x)))) @ scaled.T


def impedance_torques(
    *,
    K: np.ndarray,
    damping_ratio: float,
    wrench_limits: np.ndarray,
    R_axes: np.ndarray | None,
    p_error: np.ndarray,
    eta: float,
    epsilon: np.ndarray,
    J: np.ndarray,
    M: np.ndarray,
    v: np.ndarray,
    posture_torque: np.ndarray,
    gravity_torque: np.ndarray,
    torque_limits: np.ndarray,
) -> JointTorques:
    """τ = Jᵀ clip(K e − D J v) + N (posture torque) + gravity compensation, clipped to what the motors can.

    The wrench is clipped per axis, spring and damper together: whatever happens, the tool pushes with no more, and it
    still follows a fast command, where the two cancel. N = I − Jᵀ Λ J M⁻¹ leaves of the posture's torque what
    accelerates no part of the tool's pose.

    Args:
        K: stiffness (6, 6) in the axes of the stiffness frame.
        damping_ratio: ζ of every mode.
        wrench_limits: (6,) along the axes of the stiffness frame [N, Nm].
        R_axes: from the stiffness frame's axes to those of everything else, (3, 3); None where they are the same.
        p_error, eta, epsilon: see `spring_wrench`.
        J: geometric Jacobian of the tool centre, (6, n).
        M: mass matrix with the rotors' reflected inertia, (n, n).
        v: joint velocities (n,).
        posture_torque: what would pull the joints to their posture, (n,).
        gravity_torque: what holds the arm's weight, (n,).
        torque_limits: (n,) [Nm].
    """
    if R_axes is not None:
        R = np.zeros((6, 6))
        R[:3, :3] = R[3:, 3:] = R_axes
        K = R @ K @ R.T

    _, M_inverse_JT, failed = lapack.dposv(M, J.T, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the arm's mass matrix is not positive definite")
    Lambda_inverse = J @ M_inverse_JT + _REGULARIZATION
    R_inverse = _root_of_inverse(Lambda_inverse)
    L_modes, eigenvalues = _modes(K, R_inverse)
    damping = L_modes @ (_dampings(eigenvalues, damping_ratio) * (L_modes.T @ (J @ v)))
    wanted_wrench = spring_wrench(K, p_error, eta, epsilon) - damping
    along_axes = wanted_wrench if R_axes is None else R.T @ wanted_wrench
    wrench = _clipped(along_axes, wrench_limits)
    if R_axes is not None:
        wrench = R @ wrench
    tool_acceleration = M_inverse_JT.T @ posture_torque
    if _is_regular(R_inverse):
        leak = R_inverse.T @ (R_inverse @ tool_acceleration)  # the tool wrench of the posture's torque
    else:
        leak = reachable_inertia(Lambda_inverse) @ tool_acceleration
    wanted_torque = J.T @ (wrench - leak) + posture_torque + gravity_torque
    torque = _clipped(wanted_torque, torque_limits)
    is_saturated = bool((np.abs(along_axes) >= wrench_limits).any() or (torque != wanted_torque).any())
    return JointTorques(torque, wrench, is_saturated)


def _is_regular(R_inverse: np.ndarray) -> bool:
    """Whether no direction weighs more than `LIGHT`, for certain: all six together don't."""
    scaled = R_inverse / _SCALE
    return float(np.vdot(scaled, scaled)) < LIGHT


def _clipped(values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    # Twice as fast as np.clip on a handful of numbers; this runs at every step of a plant.
    return np.minimum(np.maximum(values, -limits), limits)
