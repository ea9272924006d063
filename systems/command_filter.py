"""Filter of commanded positions that depends on the last command."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.control.command_filters import CommandLaw
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class CommandFilter(LeafSystem):
    """Compute a safe command from the last command and the desired pose, once per control step.

        safe_pose = law(last safe_pose, desired_pose)

    The law is a `KeepOutFilter`, which projects the line from the measured pose to the desired one, a `BarrierFilter`,
    a `TangentSpaceFilter`, or a `MotionConstraintFilter`, which uses the last two commands. At initialization, the last
    command is the measured pose. The measured pose is sampled at control steps. If the desired pose is not finite, a
    `MotionConstraintFilter` brakes, and the other laws repeat the last command. If the result of a law is not finite,
    the last command is repeated.

    ``desired_pose``, ``pose`` (measured) and ``safe_pose`` are (O,). ``intervention`` (1,) is 1
    if the law intervened (see the class of the law) or the last command is repeated.

    Args:
        law: Law of the filter.
        period: Control period [s], positive.

    Raises:
        InputError: At initialization, if the measured pose is not finite.
    """

    def __init__(self, law: CommandLaw, period: float):
        super().__init__()
        self._law, outputs = law, law.num_outputs
        size = len(law.start(np.zeros(outputs)))
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", outputs)
        self._pose_port = self.DeclareVectorInputPort("pose", outputs)
        self._last = declare.unset_state(self, size)  # state of the law, which begins with the last command
        self._measured = declare.sample(self, self._pose_port, period)
        sources = [self._desired_pose_port, self._last, self._measured]
        self._command = declare.cache_entry(self, "command", self._calc_command, sources)
        declare.part_output(self, "safe_pose", self._command, lambda command: command[:outputs], outputs)
        declare.part_output(self, "intervention", self._command, lambda command: command[-1])
        declare.update_after_start(self, period, self._update, self._reset)

    get_desired_pose_input_port = input_getter("desired_pose", "desired pose, (O,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_safe_pose_output_port = output_getter("safe_pose", "safe command, (O,)")
    get_intervention_output_port = output_getter("intervention", "flag that the law intervened, (1,)")

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._last, self._law.start(declare.start_pose(self._pose_port.Eval(context))))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._last, self._command.Eval(context)[:-1])

    def _calc_command(self, context: Context, value: AbstractValue) -> None:
        """Compute the next state, which begins with the safe command, and the intervention flag."""
        last = declare.initialized(self, context, self._last)
        measured = context.get_discrete_state().value(self._measured)
        state, is_changed = self._law.apply(last, self._desired_pose_port.Eval(context), measured)
        if not is_finite(state):  # NaN would remain in the state
            state, is_changed = last, True
        value.set_value(np.append(state, float(is_changed)))
