"""Joint positions for a tool pose."""

from __future__ import annotations

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, JacobianWrtVariable

from guiderail.models.errors import InputError


def solve_inverse_kinematics(
    plant: MultibodyPlant,
    reference: Frame,
    tool_centre: Frame,
    X: RigidTransform,
    guess: np.ndarray,
    tolerance: float = 1e-9,
    max_iterations: int = 200,
) -> np.ndarray:
    """Joint positions (n,) near `guess` with the tool centre at X in the reference frame, by damped Gauss–Newton.

    Raises:
        InputError: if the pose is out of reach, or reached only beyond a joint's limits.
    """
    context = plant.CreateDefaultContext()
    q = np.array(guess, dtype=float)
    for _ in range(max_iterations):
        plant.SetPositions(context, q)
        X_now = tool_centre.CalcPose(context, reference)
        turn = (X.rotation() @ X_now.rotation().inverse()).ToAngleAxis()
        error = np.concatenate([turn.axis() * turn.angle(), X.translation() - X_now.translation()])
        if np.linalg.norm(error) < tolerance:
            break
        J = plant.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, tool_centre, np.zeros(3), reference, reference
        )
        error[:3] *= min(
            1.0, 0.3 / max(float(np.linalg.norm(error[:3])), 1e-12)
        )  # a large turn in one step goes astray
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-8 * np.eye(6), error)
    else:
        raise InputError(f"the arm can't reach {X.translation().round(3)} m: move the workcell nearer")
    if (q < plant.GetPositionLowerLimits()).any() or (q > plant.GetPositionUpperLimits()).any():
        raise InputError(f"the arm reaches {X.translation().round(3)} m only beyond a joint's limit")
    return q
