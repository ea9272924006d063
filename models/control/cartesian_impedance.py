"""Cartesian impedance law: a spring to the desired pose, and a damper designed from the spring and the inertia.

Vectors of six are [translational, rotational], and all quantities are expressed in one frame.
`systems/support/scalar_conversion.py` has the same law for AutoDiffXd.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import lapack

from guiderail.models.common.arrays import cross
from guiderail.models.control.damped_inverse import LEVER
from guiderail.models.control.wrench import MovingInertia, WrenchBound, bounded_wrench

_REGULARIZATION = 1e-9 * np.eye(6)  # added to Λ⁻¹, so that the inertia of a singular arm is finite

# Near a singular posture, the effective mass at the tool, usually 1 to 50 kg, grows in the lost direction. Up to
# LIGHT [kg], only the impedance acts in this direction; above HEAVY [kg], only the posture's torque.
LIGHT, HEAVY = 300.0, 3000.0
_ROUNDING = 1e-9  # a wrench that a bound changes by more than this is saturated [N, Nm]
_SCALE = np.repeat([1.0, LEVER], 3)


class ArmImpedance(NamedTuple):
    """Arm and impedance at an instant, the arguments of the law: floats or, for derivatives, `AutoDiffXd`."""

    K: np.ndarray  # stiffness (6, 6) [N/m, Nm/rad]
    damping_ratio: Any  # damping ratio ζ of every mode
    wrench_limits: np.ndarray  # limits (6,) along the axes [N, Nm]
    p_error: np.ndarray  # position error (3,) [m], as in `spring_wrench`
    eta: Any  # scalar part of the orientation error, as in `spring_wrench`
    epsilon: np.ndarray  # vector part (3,) of the orientation error, as in `spring_wrench`
    J: np.ndarray  # geometric Jacobian of the tool center (6, n)
    M: np.ndarray  # mass matrix (n, n), including the reflected rotor inertia
    v: np.ndarray  # joint velocities (n,) [rad/s]
    posture_torque: np.ndarray  # torque (n,) that pulls the joints to their preferred posture [Nm]
    gravity_torque: np.ndarray  # gravity compensation (n,) [Nm]
    torque_limits: np.ndarray  # torque limits (n,) [Nm]


@dataclass(frozen=True)
class JointTorques:
    """Result of the impedance law."""

    torque: np.ndarray  # joint torques to command (n,) [Nm]
    wrench: np.ndarray  # limited wrench of the impedance (6,) [N, Nm]
    is_saturated: bool  # True if the wrench or a torque is limited


def spring_wrench(K: np.ndarray, p_error: np.ndarray, eta: float, epsilon: np.ndarray) -> np.ndarray:
    """Compute the wrench (6,) of the potential ½ eᵀ K e with e = [p_error, 2ε].

    The rotational part is E(η, ε)ᵀ times the rotational part of K e, with E = η I + [ε]× (Caccavale, Natale, Siciliano,
    Villani 1999). The wrench is the gradient of the potential, so that the spring is passive. For small errors, 2ε is
    the rotation vector and the wrench is K e.

    Args:
        K: Stiffness (6, 6) [N/m, Nm/rad], symmetric, positive definite.
        p_error: Desired minus actual position (3,) [m].
        eta: Scalar part of the quaternion of R_desired Rᵀ.
        epsilon: Vector part (3,) of that quaternion.
    """
    generalized = K @ np.concatenate([p_error, 2.0 * epsilon])
    torque = generalized[3:]
    return np.concatenate([generalized[:3], eta * torque - cross(epsilon, torque)])


def damping_matrix(K: np.ndarray, Lambda_inverse: np.ndarray, damping_ratio: float) -> np.ndarray:
    """Compute D = 2 ζ L (L⁻¹ K L⁻ᵀ)^½ Lᵀ with Λ = L Lᵀ, which gives every mode of (K, Λ) the damping ratio ζ.

    K is the stiffness (6, 6), symmetric and positive definite, and Λ⁻¹ = J M⁻¹ Jᵀ (6, 6) the inverse inertia. D is
    (6, 6).

    Raises:
        LinAlgError: If Λ⁻¹ is not positive definite.
    """
    L_modes, eigenvalues = _modes(K, _root_of_inverse(Lambda_inverse))
    return (L_modes * _dampings(eigenvalues, damping_ratio)) @ L_modes.T


def _root_of_inverse(Lambda_inverse: np.ndarray) -> np.ndarray:
    """Compute R⁻¹ (6, 6) of the lower triangular factor R with Λ⁻¹ = R Rᵀ; then Λ = R⁻ᵀ R⁻¹."""
    # LAPACK is called directly: NumPy's overhead exceeds the computation for matrices of six rows.
    R, failed = lapack.dpotrf(Lambda_inverse, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the inertia at the tool is not positive definite")
    return lapack.dtrtri(R, lower=1)[0]


def _modes(K: np.ndarray, R_inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute L U with L = R⁻ᵀ, Λ = L Lᵀ, and the eigenvectors U and eigenvalues (6,) of L⁻¹ K L⁻ᵀ."""
    R = lapack.dtrtri(R_inverse, lower=1)[0]
    eigenvalues, modes, failed = lapack.dsyevd(R.T @ K @ R, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the modes of the stiffness did not converge")
    return R_inverse.T @ modes, eigenvalues


def _dampings(eigenvalues: np.ndarray, damping_ratio: float) -> np.ndarray:
    return 2.0 * damping_ratio * np.sqrt(np.maximum(eigenvalues, 0.0))


def reachable_inertia(Lambda_inverse: np.ndarray) -> np.ndarray:
    """Compute Λ (6, 6) without the directions that a singular arm has lost.

    With rotations scaled by `LEVER`, each eigenvalue is a mass m [kg]. It is multiplied by a factor that falls smoothly
    with log m, from 1 at `LIGHT` to 0 at `HEAVY`. For a regular arm the result equals Λ. With this inertia, the
    posture's torque moves the tool in lost directions. The argument is Λ⁻¹ = J M⁻¹ Jᵀ (6, 6), positive definite.
    """
    eigenvalues, directions = np.linalg.eigh(_SCALE[:, None] * Lambda_inverse * _SCALE)
    masses = 1.0 / eigenvalues
    x = np.clip(np.log(masses / LIGHT) / np.log(HEAVY / LIGHT), 0.0, 1.0)
    scaled = _SCALE[:, None] * directions
    return (scaled * (masses * (1.0 - x * x * (3.0 - 2.0 * x)))) @ scaled.T


def impedance_torques(law: ArmImpedance, bound: WrenchBound | None = None) -> JointTorques:
    """Compute τ = Jᵀ clip(K e − D J v) + N (posture torque) + gravity compensation, clipped to the torque limits.

    Without a bound, the sum of spring and damper is clipped per axis. The tool never pushes beyond the limits, but can
    follow a fast command, for which spring and damper cancel. With a bound, `bounded_wrench` limits the sum.
    N = I − Jᵀ Λ J M⁻¹ removes the part of the posture's torque that accelerates the tool.

    Raises:
        LinAlgError: If the mass matrix or the inertia at the tool is not positive definite.
    """
    K, J = law.K, law.J
    _, M_inverse_JT, failed = lapack.dposv(law.M, J.T, lower=1)
    if failed:
        raise np.linalg.LinAlgError("the arm's mass matrix is not positive definite")
    Lambda_inverse = regularized(J @ M_inverse_JT)
    R_inverse = _root_of_inverse(Lambda_inverse)
    L_modes, eigenvalues = _modes(K, R_inverse)
    velocity = J @ law.v
    damping = L_modes @ (_dampings(eigenvalues, law.damping_ratio) * (L_modes.T @ velocity))
    spring = spring_wrench(K, law.p_error, law.eta, law.epsilon)
    unlimited_wrench = spring - damping
    if bound is None:
        wrench = _clipped(unlimited_wrench, law.wrench_limits)
        is_limited = bool((np.abs(unlimited_wrench) >= law.wrench_limits).any())
    else:
        inertia = MovingInertia(
            _inertia_along(velocity[:3], spring[:3], Lambda_inverse[:3, :3]),
            _inertia_along(velocity[3:], spring[3:], Lambda_inverse[3:, 3:]),
        )
        wrench = bounded_wrench(spring, damping, velocity, inertia, bound)
        is_limited = bool(np.abs(wrench - unlimited_wrench).max() > _ROUNDING)
    tool_acceleration = M_inverse_JT.T @ law.posture_torque
    if _is_regular(R_inverse):
        leak = R_inverse.T @ (R_inverse @ tool_acceleration)  # tool wrench of the posture's torque
    else:
        leak = reachable_inertia(Lambda_inverse) @ tool_acceleration
    unlimited_torque = J.T @ (wrench - leak) + law.posture_torque + law.gravity_torque
    torque = _clipped(unlimited_torque, law.torque_limits)
    return JointTorques(torque, wrench, is_limited or bool((torque != unlimited_torque).any()))


def regularized(Lambda_inverse: np.ndarray) -> np.ndarray:
    """Return an inverse inertia (6, 6) that is positive definite also for a singular arm."""
    return Lambda_inverse + _REGULARIZATION


def has_regular_inertia(Lambda_inverse: np.ndarray) -> bool:
    """Return True if the inertia Λ (6, 6) at the tool is that of a regular arm, in which no direction is lost."""
    return _is_regular(_root_of_inverse(Lambda_inverse))


def _inertia_along(velocity: np.ndarray, spring: np.ndarray, Lambda_inverse: np.ndarray) -> float:
    """Return the inertia of the tool in the direction of its translational or rotational velocity (3,).

    It is the mass [kg] of the tool, free to rotate, or the moment of inertia [kg m²] of the tool, free to translate.
    `Lambda_inverse` (3, 3) is the block of this motion. At rest the direction is that of the spring's force or torque.
    """
    direction = velocity if velocity.any() else spring
    square = float(direction @ direction)
    return square / float(direction @ Lambda_inverse @ direction) if square > 0.0 else 1.0


def _is_regular(R_inverse: np.ndarray) -> bool:
    """Return True if the trace of the scaled inertia, an upper bound of its eigenvalues, is less than `LIGHT`."""
    scaled = R_inverse / _SCALE
    return float(np.vdot(scaled, scaled)) < LIGHT


def _clipped(values: np.ndarray, limits: np.ndarray) -> np.ndarray:
    # Twice as fast as np.clip for a few numbers; this function runs at every step of a plant.
    return np.minimum(np.maximum(values, -limits), limits)
