"""Constraints on the commanded pose: joint limits of an arm.

`JointRange` implements `StateConstraints` of `models/control/motion_constraints.py`; a station of an arm makes it.
"""

from functools import lru_cache

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.control.damped_inverse import TOOL_SCALE
from guiderail.models.robots.inverse_kinematics import pose_error

_ITERATIONS = 60  # largest number of iterations of the inverse kinematics
_TOLERANCE = 1e-9  # largest norm of the pose error, as a scaled twist [m]
_MAX_CHANGE = 0.5  # largest change of a joint in one iteration [rad]


class JointRange:
    """Joint positions at a commanded pose [x y z Rz Ry Rx], and constraints on them.

    The joint positions of a pose are those nearest to the posture, because null-space control pulls the arm towards the
    posture. Near a command y, the joint positions of a pose z are q(z) ≈ q(y) + J⁺ (z − y), with the Jacobian J from
    joint positions to the pose. With this approximation, joint limits are linear constraints on the next command z. The
    second-order error of these constraints is not bounded in advance. Therefore `violation` computes the joint
    positions of the command itself, and a command with a violation is not executed (`MotionConstraintFilter`).

    Args:
        plant: Finalized plant with the arm only.
        reference: Frame of poses.
        tool_center: Frame whose pose is commanded.
        posture: Joint positions (n,) [rad] within the limits.
        margin: Distance of the command from the limits [rad], not negative: allowance for the position error of an arm
            under impedance control.

    Raises:
        InputError: If the posture is not within the limits and the margin.
    """

    def __init__(
        self,
        plant: MultibodyPlant,
        reference: Frame,
        tool_center: Frame,
        posture: np.ndarray,
        margin: float = 0.0,
    ):
        self._plant, self._reference, self._tool_center = plant, reference, tool_center
        self._context = plant.CreateDefaultContext()
        self._solve_once = lru_cache(maxsize=8)(self._solve)  # a control step requests the same poses several times
        self._posture = np.array(posture, dtype=float)
        self._lower = plant.GetPositionLowerLimits() + margin
        self._upper = plant.GetPositionUpperLimits() - margin
        if not ((self._lower < self._posture) & (self._posture < self._upper)).all():
            raise InputError(f"the posture is not within the joint limits and a margin of {margin} rad")

    def solve(self, pose: np.ndarray) -> np.ndarray | None:
        """Return the joint positions (n,) [rad] of a pose (6,), nearest to the posture; None if none is found.

        The positions may be beyond the limits. A pose that is not finite has the result None. The array is read-only,
        because results are cached.
        """
        return self._solve_once(np.asarray(pose, dtype=float).tobytes())

    def _solve(self, coordinates: bytes) -> np.ndarray | None:
        pose = np.frombuffer(coordinates)
        if not np.isfinite(pose).all():
            return None
        X = RigidTransform(RollPitchYaw(pose[5], pose[4], pose[3]), pose[:3])
        q = self._posture.copy()
        for _ in range(_ITERATIONS):
            J = self._jacobian(q)
            error = TOOL_SCALE * pose_error(X, self._tool_center.CalcPose(self._context, self._reference))
            U, sigma, WT = np.linalg.svd(J, full_matrices=False)
            rest = self._posture - q
            change = WT.T @ ((U.T @ error) * sigma / (sigma**2 + 1e-8) - WT @ rest) + rest
            change *= min(1.0, _MAX_CHANGE / max(float(np.abs(change).max()), 1e-12))
            q = q + change
            if np.linalg.norm(error) < _TOLERANCE and np.abs(change).max() < 1e-7:
                q.setflags(write=False)
                return q
        return None

    def linearize(self, output: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return rows G (F, 6) of unit norm and c (F,) of constraints G y ≥ c near a pose (6,).

        If the pose cannot be reached, there are no rows.
        """
        q = self.solve(output)
        if q is None:
            return np.zeros((0, POSE_SIZE)), np.zeros(0)
        inverse = np.linalg.pinv(self._jacobian(q)) @ (TOOL_SCALE[:, None] * _twist_of_change(output))
        G, c = np.concatenate([inverse, -inverse]), np.concatenate([self._lower - q, q - self._upper])
        norms = np.linalg.norm(G, axis=1)
        is_used = norms > 1e-9  # a joint that does not move has no constraint
        G = G[is_used] / norms[is_used, None]
        return G, G @ output + c[is_used] / norms[is_used]

    def violation(self, output: np.ndarray) -> float:
        """Return the largest violation [rad] at a pose (6,), negative inside, infinite if the pose is out of reach."""
        q = self.solve(output)
        return np.inf if q is None else float(np.maximum(self._lower - q, q - self._upper).max())

    def _jacobian(self, q: np.ndarray) -> np.ndarray:
        """Set the arm to `q` and return the scaled Jacobian (6, n), rotation first."""
        self._plant.SetPositions(self._context, q)
        J = self._plant.CalcJacobianSpatialVelocity(
            self._context, JacobianWrtVariable.kV, self._tool_center, np.zeros(3), self._reference, self._reference
        )
        return TOOL_SCALE[:, None] * J


def _twist_of_change(pose: np.ndarray) -> np.ndarray:
    """Return the matrix (6, 6) from the rate of change of a pose [x y z Rz Ry Rx] to the twist, rotation first."""
    a, b = pose[3], pose[4]
    matrix = np.zeros((6, 6))
    matrix[3:, :3] = np.eye(3)
    matrix[:3, 3] = [0.0, 0.0, 1.0]
    matrix[:3, 4] = [-np.sin(a), np.cos(a), 0.0]
    matrix[:3, 5] = [np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), -np.sin(b)]
    return matrix
