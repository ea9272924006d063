"""Constraint violation of a pose."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import Source, input_getter, output_getter


class ConstraintViolation(LeafSystem):
    """Largest violation of linear constraints G y ≥ c, or of motion constraints, by a pose y.

        violation = max(c − G y), negative if all constraints are slack

    ``pose`` is (O,), commanded or measured. ``violation`` is (1,), in the unit of c, or as in
    `MotionConstraints.violation`; it is `UNCONSTRAINED` if there is no constraint. The violation depends only on the
    pose and the control step, so that all guidance is evaluated in the same way.

    Args:
        constraints: Linear constraints (constant, or one set per control step) or motion constraints, on O outputs.
        period: Control period [s], positive.
    """

    #: Violation if there is no constraint: finite, so that it can be logged.
    UNCONSTRAINED = -1e30

    def __init__(self, constraints: LinearConstraints | MotionConstraints, period: float):
        super().__init__()
        self._constraints, self._period = constraints, period
        self._pose_port = self.DeclareVectorInputPort("pose", constraints.num_outputs)
        sources: list[Source] = [self._pose_port]
        self._step = None
        if constraints.num_steps is not None:
            self._step = self.DeclareDiscreteState(1)
            declare.update(self, period, self._advance)
            sources.append(self._step)
        declare.scalar_output(self, "violation", self._violation, sources)

    get_pose_input_port = input_getter("pose", "pose, (O,)")
    get_violation_output_port = output_getter("violation", "violation max(c − G y), (1,)")

    def _advance(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value([round(context.get_time() / self._period)])

    def _violation(self, context: Context) -> float:
        step = 0 if self._step is None else int(context.get_discrete_state().value(self._step).item())
        violation = self._constraints.violation(self._pose_port.Eval(context), step)
        return float(np.maximum(violation, self.UNCONSTRAINED))  # NaN stays NaN
