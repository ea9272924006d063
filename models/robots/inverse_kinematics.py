"""Inverse kinematics: joint positions for a tool pose."""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.inverse_kinematics import InverseKinematics
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable
from pydrake.solvers import Solve

from guiderail.models.common.errors import InputError

STARTS = 10  # number of start postures of a search: the given posture, then random postures around it
TOLERANCE = 1e-9  # largest norm of the pose error, translation [m] and rotation [rad] together
AT_LIMIT = 1e-6  # distance from a limit within which a joint is fixed [rad]


def solve_inverse_kinematics(
    plant: MultibodyPlant, reference: Frame, tool_center: Frame, X: RigidTransform, posture: np.ndarray
) -> np.ndarray:
    """Return joint positions (n,) [rad] near `posture` at which the tool center has the pose X in the reference frame.

    A local search starts at `posture` and minimizes ‖q − posture‖² subject to the pose and the joint limits. If it
    finds no solution, further searches start at random postures, and the solution nearest to `posture` is returned. The
    random postures have a fixed seed, so that the result is deterministic.

    Args:
        plant: Finalized plant; the solution may move all of its joints.
        reference: Frame in which X is expressed.
        tool_center: Frame to place at X.
        X: Pose of the tool center in the reference frame.
        posture: Joint positions (n,) [rad].

    Raises:
        InputError: If no solution is found: the pose is out of reach, or can only be reached beyond the joint limits.
    """
    problem = _Problem(plant, reference, tool_center, X, np.asarray(posture, dtype=float))
    solution = problem.search(within_limits=True)
    if solution is not None:
        return solution
    position = X.translation().round(3)
    if problem.search(within_limits=False) is not None:
        raise InputError(f"the arm reaches {position} m only beyond a joint's limit")
    raise InputError(f"the arm can't reach {position} m: move the workcell nearer")


class _Problem:
    """Inverse kinematics of one pose."""

    def __init__(
        self, plant: MultibodyPlant, reference: Frame, tool_center: Frame, X: RigidTransform, posture: np.ndarray
    ):
        self._plant, self._reference, self._tool_center = plant, reference, tool_center
        self._X, self._posture = X, posture
        self._context = plant.CreateDefaultContext()

    def search(self, within_limits: bool) -> np.ndarray | None:
        """Return the solution of the search from the posture, else the nearest solution from random starts, or None."""
        lower, upper = self._plant.GetPositionLowerLimits(), self._plant.GetPositionUpperLimits()
        if not within_limits:
            lower, upper = np.full_like(lower, -np.inf), np.full_like(upper, np.inf)
        solution = self._solve(self._posture, lower, upper, within_limits)
        if solution is not None:
            return solution
        # Starts within half a turn of the posture, so that a joint with a range of several turns does not turn farther.
        random = np.random.default_rng(0)
        low, high = np.maximum(lower, self._posture - np.pi), np.minimum(upper, self._posture + np.pi)
        starts = random.uniform(np.minimum(low, high), np.maximum(low, high), (STARTS - 1, len(lower)))
        solutions = [self._solve(start, lower, upper, within_limits) for start in starts]
        valid = [q for q in solutions if q is not None]
        return min(valid, key=lambda q: float(np.linalg.norm(q - self._posture)), default=None)

    def _solve(self, start: np.ndarray, lower: np.ndarray, upper: np.ndarray, within_limits: bool) -> np.ndarray | None:
        ik = InverseKinematics(self._plant, with_joint_limits=within_limits)
        self._constrain_pose(ik)
        q = ik.q()
        ik.prog().AddQuadraticErrorCost(np.eye(len(q)), self._posture, q)
        result = Solve(ik.prog(), np.clip(start, lower, upper))
        if not result.is_success():
            return None
        return self._refine(np.clip(result.GetSolution(q), lower, upper), lower, upper)

    def _constrain_pose(self, ik: InverseKinematics) -> None:
        """Add six independent equations: the origin, y and z of a point on the x axis, z of a point on the y axis."""
        free = np.inf
        for p_PQ, lower, upper in (
            ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
            ([1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [free, 0.0, 0.0]),
            ([0.0, 1.0, 0.0], [-free, 0.0, 0.0], [free, free, 0.0]),
        ):
            ik.AddPositionConstraint(
                frameB=self._tool_center,
                p_BQ=p_PQ,
                frameAbar=self._reference,
                X_AbarA=self._X,
                p_AQ_lower=lower,
                p_AQ_upper=upper,
            )

    def _refine(self, q: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> np.ndarray | None:
        """Refine the solver's solution to the exact pose, with joints at their limits fixed; None if it fails.

        The method is Levenberg-Marquardt, damped by the squared norm of the error. It converges quadratically at a
        regular posture, and its steps are small at a singular posture.
        """
        is_free = (q > lower + AT_LIMIT) & (q < upper - AT_LIMIT)
        error, J = self._error_and_jacobian(q)
        for _ in range(20):
            J = J * is_free
            step = J.T @ np.linalg.solve(J @ J.T + (error @ error + 1e-16) * np.eye(6), error)
            moved = np.clip(q + step, lower, upper)
            moved_error, J = self._error_and_jacobian(moved)
            if not np.linalg.norm(moved_error) < np.linalg.norm(error):
                break
            q, error = moved, moved_error
        return q if np.linalg.norm(error) < TOLERANCE else None

    def _error_and_jacobian(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the error from the pose at `q` to X, (6,) rotation first, and the Jacobian (6, n)."""
        plant, context = self._plant, self._context
        plant.SetPositions(context, q)
        error = pose_error(self._X, self._tool_center.CalcPose(context, self._reference))
        J = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, self._tool_center, np.zeros(3), self._reference, self._reference
        )
        return error, J


def pose_error(X_desired: RigidTransform, X: RigidTransform) -> np.ndarray:
    """Return the twist (6,) that leads from a pose to the desired pose in unit time, rotation first [rad, m]."""
    turn = (X_desired.rotation() @ X.rotation().inverse()).ToAngleAxis()
    return np.concatenate([turn.axis() * turn.angle(), X_desired.translation() - X.translation()])
