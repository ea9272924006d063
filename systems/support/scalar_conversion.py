"""Systems that Drake can convert to other scalar types, and the derivatives of an impedance."""

import sys
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.math import inv
from pydrake.systems.framework import LeafSystem, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem
from scipy.linalg import solve_continuous_lyapunov

from guiderail.models.common.errors import InputError
from guiderail.models.control.cartesian_impedance import (
    ArmImpedance,
    JointTorques,
    damping_matrix,
    has_regular_inertia,
    regularized,
    spring_wrench,
)

if TYPE_CHECKING:

    class ConvertibleSystem(LeafSystem):
        """System of floats that `ToAutoDiffXd` and `ToSymbolic` convert, alone or as a part of a diagram."""

        def declare_converted(self, system: Any, scalar: type) -> None:
            """Declare the ports, states and parameters of this system in `system`, whose numbers are of type `scalar`.

            Raises:
                InputError: If the system has no law for this type.
            """

else:
    # Without `scope`, Drake reads the source of every calling frame to find this module, which takes half a second.
    @TemplateSystem.define("ConvertibleSystem_", scope=sys.modules[__name__])
    def ConvertibleSystem_(T):
        """Return the class of numbers of type `T`."""

        class Impl(LeafSystem_[T]):
            """System of floats that `ToAutoDiffXd` and `ToSymbolic` convert, alone or as a part of a diagram."""

            def _construct(self, converter=None):
                super().__init__(converter)

            def _construct_copy(self, other, converter=None):
                super().__init__(converter)
                self._original = getattr(other, "_original", other)
                self._original.declare_converted(self, T)

        return Impl

    ConvertibleSystem = ConvertibleSystem_[float]


def values_of(numbers: np.ndarray) -> np.ndarray:
    """Return the values of an array of floats and `AutoDiffXd`, as floats."""
    flat = [number.value() if isinstance(number, AutoDiffXd) else number for number in np.ravel(numbers)]
    return np.array(flat, dtype=float).reshape(np.shape(numbers))


def differentiable_damping(K: np.ndarray, Lambda_inverse: np.ndarray, damping_ratio: Any) -> np.ndarray:
    """Compute the damping matrix D (6, 6) of `damping_matrix` with its derivatives.

    G = D / (2 ζ) is the solution of G Λ⁻¹ G = K, so that its derivative is that of a Lyapunov equation:
    dG Λ⁻¹ G + G Λ⁻¹ dG = dK − G dΛ⁻¹ G.
    """
    K_values, inverse_values = values_of(K), values_of(Lambda_inverse)
    G = damping_matrix(K_values, inverse_values, 0.5)
    dK, d_inverse = _derivatives(K), _derivatives(Lambda_inverse)
    size = max(dK.shape[-1], d_inverse.shape[-1])
    derivatives = np.zeros((6, 6, size))
    for i in range(size):
        change = (dK[..., i] if dK.shape[-1] else 0.0) - (G @ d_inverse[..., i] @ G if d_inverse.shape[-1] else 0.0)
        derivatives[..., i] = solve_continuous_lyapunov(G @ inverse_values, change)
    entries = [[AutoDiffXd(G[i, j], derivatives[i, j]) for j in range(6)] for i in range(6)]
    return 2.0 * damping_ratio * np.array(entries)


def _derivatives(numbers: np.ndarray) -> np.ndarray:
    """Return the derivatives of an array (n, m) as (n, m, d); d is 0 if all numbers are constant."""
    found = [number.derivatives() if isinstance(number, AutoDiffXd) else np.zeros(0) for number in np.ravel(numbers)]
    size = max(map(len, found))
    padded = [derivative if len(derivative) else np.zeros(size) for derivative in found]
    return np.array(padded).reshape(*np.shape(numbers), size)


def differentiable_torques(law: ArmImpedance) -> JointTorques:
    """Compute the joint torques of `impedance_torques` without bound.

    Raises:
        InputError: If the arm is near a singular posture.
    """
    K, J = law.K, law.J
    M_inverse_JT = inv(law.M) @ J.T
    Lambda_inverse = regularized(J @ M_inverse_JT)
    if not has_regular_inertia(values_of(Lambda_inverse)):
        raise InputError("an impedance has derivatives in regular postures only: move the arm away from this posture")
    damping = differentiable_damping(K, Lambda_inverse, law.damping_ratio) @ (J @ law.v)
    unlimited_wrench = spring_wrench(K, law.p_error, law.eta, law.epsilon) - damping
    wrench = np.minimum(np.maximum(unlimited_wrench, -law.wrench_limits), law.wrench_limits)
    is_limited = bool((np.abs(values_of(unlimited_wrench)) >= values_of(law.wrench_limits)).any())
    leak = inv(Lambda_inverse) @ (M_inverse_JT.T @ law.posture_torque)
    unlimited_torque = J.T @ (wrench - leak) + law.posture_torque + law.gravity_torque
    torque = np.minimum(np.maximum(unlimited_torque, -law.torque_limits), law.torque_limits)
    is_clipped = bool((np.abs(values_of(unlimited_torque)) > law.torque_limits).any())
    return JointTorques(torque, wrench, is_limited or is_clipped)
