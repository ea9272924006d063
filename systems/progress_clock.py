"""Clock of a movement primitive, which stops while the robot does not follow the commands."""

from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.laws import StateProgress
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class ProgressClock(LeafSystem):
    """Count the steps of a movement primitive while the robot follows the commands (`StateProgress`).

    ``command`` and ``pose`` (measured) are (O,). ``motion_time`` (1,) is the time of the motion [s], a whole multiple
    of the period; it is a discrete state, and zero at initialization.

    Args:
        rule: Rule that determines the next step of the motion in each control step.
        num_outputs: Number O of outputs.
        period: Control period [s], positive.
    """

    def __init__(self, rule: StateProgress, num_outputs: int, period: float):
        super().__init__()
        self._rule, self._period = rule, period
        self._command_port = self.DeclareVectorInputPort("command", num_outputs)
        self._pose_port = self.DeclareVectorInputPort("pose", num_outputs)
        self._time = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("motion_time", self._time)
        self._start = declare.update_after_start(self, period, self._update, declare.reset_to_default(self))

    get_command_input_port = input_getter("command", "last command, (O,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_motion_time_output_port = output_getter("motion_time", "time of the motion, (1,) [s]")

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        elapsed = round(context.get_time() / self._period) - declare.start_step(context, self._start, self._period)
        step = round(context.get_discrete_state().value(self._time).item() / self._period)
        command, pose = self._command_port.Eval(context), self._pose_port.Eval(context)
        discrete_state.set_value(self._time, [self._period * self._rule.next_step(step, elapsed, command, pose)])
