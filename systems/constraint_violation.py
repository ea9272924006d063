"""By how much a pose violates linear constraints."""

from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiscreteValues,
    EventStatus,
    InputPort,
    LeafSystem,
    OutputPort,
)

from guiderail.models.primitives import LinearConstraints
from guiderail.systems.support.sampling import check_period


class ConstraintViolation(LeafSystem):
    """Measures by how much a pose y violates linear constraints G y ≥ c.

        violation = max over the constraints of c − G y, negative where all are slack

    .. pydrake_system::

        name: ConstraintViolation
        input_ports:
        - pose
        output_ports:
        - violation

    ``pose`` (O,) is commanded or measured; ``violation`` (1,) is in the unit of c, and `UNCONSTRAINED` where there is
    no constraint. It depends on the pose and the control step alone: it judges every guidance alike, whether that
    knows of the constraints or not.
    """

    #: What stands for "no constraint": finite, so that it can be logged.
    UNCONSTRAINED = -1e30

    def __init__(self, constraints: LinearConstraints, period: float):
        """
        Args:
            constraints: on O outputs; where they differ from step to step, the step counts control periods.
            period: between two control steps [s], positive.

        Raises:
            InputError: if the period is not positive.
        """
        super().__init__()
        check_period(period)
        self._constraints, self._period = constraints, period
        self._pose_port = self.DeclareVectorInputPort("pose", constraints.num_outputs)
        prerequisites = {self._pose_port.ticket()}
        self._step = None
        if constraints.num_steps is not None:
            self._step = self.DeclareDiscreteState(1)
            self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._advance)
            prerequisites.add(self.discrete_state_ticket(self._step))
        self._violation_port = self.DeclareVectorOutputPort(
            "violation", 1, self._calc_violation, prerequisites_of_calc=prerequisites
        )

    def get_pose_input_port(self) -> InputPort:
        """The pose to judge, (O,)."""
        return self._pose_port

    def get_violation_output_port(self) -> OutputPort:
        """max(c − G y), (1,)."""
        return self._violation_port

    def _advance(self, context: Context, discrete_state: DiscreteValues) -> EventStatus:
        discrete_state.set_value([round(context.get_time() / self._period)])
        return EventStatus.Succeeded()

    def _calc_violation(self, context: Context, output: BasicVector) -> None:
        step = 0 if self._step is None else int(context.get_discrete_state(self._step).value()[0])
        violation = self._constraints.violation(self._pose_port.Eval(context), step)
        # Not max(UNCONSTRAINED, violation): that would turn a NaN into "no constraint".
        output.SetAtIndex(0, self.UNCONSTRAINED if violation < self.UNCONSTRAINED else violation)
