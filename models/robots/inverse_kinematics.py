"""Joint positions for a tool pose."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.solvers import Solve

from guiderail.models.common.errors import InputError

STARTS = 10
"""From how many postures a search starts before a pose counts as out of reach: the given one, and others around it."""
AT_LIMIT = 1e-6  # [rad]: a joint this near to a limit is held there


def solve_inverse_kinematics(
    plant: MultibodyPlant,
    reference: Frame,
    tool_centre: Frame,
    X: RigidTransform,
    posture: np.ndarray,
    tolerance: float = 1e-9,
) -> np.ndarray:
    """The joint positions (n,) nearest to `posture` with the tool centre at X in the reference frame.

    Minimizes ‖q − posture‖² subject to the pose and to the joints' limits, starting at `posture`: the result is the
    minimum that a descent from there leads to, and the same at every call. Only where that finds none, searches start
    elsewhere, and the nearest of what they find is taken.

    Args:
        plant: finalized; all its joints take part.
        reference: in which X is given.
        tool_centre: that shall be at X.
        X: the pose.
        posture: joint positions (n,).
        tolerance: of the pose, translation [m] and rotation [rad] together.

    Raises:
        InputError: if the pose is out of reach, or reached only beyond a joint's limits.
    """
    problem = _Problem(plant, reference, tool_centre, X, np.asarray(posture, dtype=float), tolerance)
    found = problem.search(within_limits=True)
    if found is not None:
        return found
    where = X.translation().round(3)
    if problem.search(within_limits=False) is not None:
        raise InputError(f"the arm reaches {where} m only beyond a joint's limit")
    raise InputError(f"the arm can't reach {where} m: move the workcell nearer")


class _Problem:
    """One pose that is asked for."""

    def __init__(
        self,
        plant: MultibodyPlant,
        reference: Frame,
        tool_centre: Frame,
        X: RigidTransform,
        posture: np.ndarray,
        tolerance: float,
    ):
        self._plant, self._reference, self._tool_centre = plant, reference, tool_centre
        self._X, self._posture, self._tolerance = X, posture, tolerance
        self._context = plant.CreateDefaultContext()

    def search(self, within_limits: bool) -> np.ndarray | None:
        """The solution that the given posture leads to, else the nearest one that other starts lead to."""
        lower, upper = self._limits(within_limits)
        solution = self._solve(self._posture, lower, upper, within_limits)
        if solution is not None:
            return solution
        # Within half a turn of the posture: a joint that turns several times isn't wound up.
        random = np.random.default_rng(0)
        low, high = np.maximum(lower, self._posture - np.pi), np.minimum(upper, self._posture + np.pi)
        starts = random.uniform(np.minimum(low, high), np.maximum(low, high), (STARTS - 1, len(lower)))
        solutions = [self._solve(start, lower, upper, within_limits) for start in starts]
        found = [q for q in solutions if q is not None]
        return min(found, key=lambda q: float(np.linalg.norm(q - self._posture)), default=None)

    def _limits(self, within_limits: bool) -> tuple[np.ndarray, np.ndarray]:
        lower, upper = self._plant.GetPositionLowerLimits(), self._plant.GetPositionUpperLimits()
        return (lower, upper) if within_limits else (np.full_like(lower, -np.inf), np.full_like(upper, np.inf))

    def _solve(self, start: np.ndarray, lower: np.ndarray, upper: np.ndarray, within_limits: bool) -> np.ndarray | None:
        ik = InverseKinematics(self._plant, with_joint_limits=within_limits)
        self._constrain_pose(ik)
        q = ik.q()
        ik.prog().AddQuadraticErrorCost(np.eye(len(q)), self._posture, q)
        result = Solve(ik.prog(), np.clip(start, lower, upper))
        if not result.is_success():
            return None
        return self._polished(np.clip(result.GetSolution(q), lower, upper), lower, upper)

    def _constrain_pose(self, ik: InverseKinematics) -> None:
        """Six equations whose gradients are independent: the origin, a point of x in y and z, a point of y in z."""
        free = np.inf
        for p_PQ, lower, upper in (
            ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
            ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [free, 0.0, 0.0]),
            ([0.0, 1.0, 0.0], [-free, 0.0, 0.0], [free, free, 0.0]),
        ):
            ik.AddPositionConstraint(
                frameB=self._tool_centre,
                p_BQ=p_PQ,
                frameAbar=self._reference,
                X_AbarA=self._X,
                p_AQ_lower=lower,
                p_AQ_upper=upper,
            )

    def _polished(self, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """The solver's answer, moved by the last bit to the pose itself; a joint at its limit stays there.

        By Levenberg and Marquardt: a damping that goes to zero with the error takes quadratic steps to a pose that is
        regular, and does not leap from one that is singular.
        """
        moves = (q > lower + AT_LIMIT) & (q < upper - AT_LIMIT)
        error, J = self._error_and_jacobian(q)
        for _ in range(20):
            J = J * moves
            step = J.T @ np.linalg.solve(J @ J.T + (error @ error + 1e-16) * np.eye(6), error)
            moved = np.clip(q + step, lower, upper)
            moved_error, J = self._error_and_jacobian(moved)
            if not np.linalg.norm(moved_error) < np.linalg.norm(error):
                break
            q, error = moved, moved_error
        return q if np.linalg.norm(error) < self._tolerance else None

    def _error_and_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """From the pose at `q` to X, a rotation vector and a translation, (6,), and the Jacobian (6, n)."""
        plant, context = self._plant, self._context
        plant.SetPositions(context, q)
        X_now = self._tool_centre.CalcPose(context, self._reference)
        turn = (self._X.rotation() @ X_now.rotation().inverse()).ToAngleAxis()
        J = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, self._tool_centre, np.zeros(3), self._reference, self._reference
        )
        return np.concatenate([turn.axis() * turn.angle(), self._X.translation() - X_now.translation()]), J
