"""Filter of commanded positions that depends on the last command."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, DiscreteValues, LeafSystem

from guiderail.models.control.command_filters import CommandLaw
from guiderail.systems.support.declarations import check_period, declare_cache, input_getter, output_getter


class CommandFilter(LeafSystem):
    """Compute a safe command from the last command and the desired pose, once per control step.

        safe_pose = law(last safe_pose, desired_pose)

    See `BarrierFilter`, `TangentSpaceFilter` and `MotionConstraintFilter`, which uses the last two commands. At
    initialization, the last command is the measured pose.

    .. pydrake_system::

        name: CommandFilter
        input_ports:
        - desired_pose
        - pose
        output_ports:
        - safe_pose
        - intervention

    ``desired_pose``, ``pose`` (measured, read at initialization) and ``safe_pose`` are (O,). ``intervention`` (1,) is 1
    if the law had to change the command.

    Args:
        law: Law of the filter.
        period: Control period [s], positive.

    Raises:
        InputError: If the period is not positive.
    """

    def __init__(self, law: CommandLaw, period: float):
        super().__init__()
        check_period(period)
        self._law, outputs = law, law.num_outputs
        size = len(law.start(np.zeros(outputs)))
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", outputs)
        self._pose_port = self.DeclareVectorInputPort("pose", outputs)
        self._last = self.DeclareDiscreteState(size)  # state of the law, which begins with the last command
        self._command = declare_cache(
            self,
            "command",
            self._calc_command,
            prerequisites_of_calc={self._desired_pose_port.ticket(), self.discrete_state_ticket(self._last)},
        )
        command = {self._command.ticket()}
        self._safe_pose_port = self.DeclareVectorOutputPort(
            "safe_pose", outputs, self._calc_safe_pose, prerequisites_of_calc=command
        )
        self._intervention_port = self.DeclareVectorOutputPort(
            "intervention", 1, self._calc_intervention, prerequisites_of_calc=command
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._reset)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self._update)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose, (O,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_safe_pose_output_port = output_getter("safe_pose", "safe command, (O,)")
    get_intervention_output_port = output_getter("intervention", "flag that the law changed the command, (1,)")

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._law.start(self._pose_port.Eval(context)))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        # No command has been executed at time zero.
        if context.get_time() > 0:
            discrete_state.set_value(self._command.Eval(context)[:-1])

    def _calc_command(self, context: Context) -> np.ndarray:
        """Return the next state, which begins with the safe command, and the intervention flag."""
        last = context.get_discrete_state(self._last).value()
        state, is_changed = self._law.apply(last, self._desired_pose_port.Eval(context))
        return np.append(state, float(is_changed))

    def _calc_safe_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._command.Eval(context)[: self._law.num_outputs])

    def _calc_intervention(self, context: Context, output: BasicVector) -> None:
        output.SetAtIndex(0, self._command.Eval(context)[-1])
