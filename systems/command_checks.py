"""Filter, watchdog and constraint violation of commanded poses."""

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.control.command_filters import CommandLaw
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import Source, input_getter, output_getter
from guiderail.systems.support.last_valid import CommandValidity, LastValidPose


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


class CommandWatchdog(LeafSystem):
    """Output the desired pose while it is valid, otherwise the last valid desired pose.

    This system is for robot controllers without a command timeout. A command is valid while it is finite, not older
    than the timeout, and not more than one period in the future; see `LastValidPose`. While the blend factor is zero,
    the last valid pose is the measured pose. If there is no valid command when control begins, the robot therefore
    stays where it is.

    ``desired_pose``, ``pose`` (measured, read at initialization and while the blend factor is zero) and ``safe_pose``
    are (O,). ``command_time`` is (1,), the time stamp of ``desired_pose`` [s]; if it is not connected, commands never
    time out. ``blend_factor`` is (1,), from a `TorqueSafetyLimiter`, and 1 by default.
    ``command_timed_out`` (1,) is 1 while no valid command is available.

    Args:
        period: Period of the check [s], positive; ideally the period of the commands.
        timeout: Age above which a command is stale [s], positive and finite.
        pose_size: Number of coordinates O, at least 1.

    Raises:
        InputError: If the timeout is out of range; at initialization, if the measured pose is not finite.
    """

    def __init__(self, period: float, timeout: float = 0.1, pose_size: int = 6):
        super().__init__()
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", pose_size)
        self._pose_port = self.DeclareVectorInputPort("pose", pose_size)
        self._command_time_port = self.DeclareVectorInputPort("command_time", 1)
        self._blend_factor_port = self.DeclareVectorInputPort("blend_factor", 1)
        validity = CommandValidity(self._command_time_port, period=period, timeout=timeout)
        followed_pose = LastValidPose(
            self, self._desired_pose_port, validity, self._pose_port.Eval, self._blend_factor_port
        )
        declare.output(self, "safe_pose", pose_size, followed_pose.eval, followed_pose.sources)
        followed_pose.declare_timed_out_output(self)

    get_desired_pose_input_port = input_getter("desired_pose", "commanded pose, (O,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_command_time_input_port = input_getter("command_time", "time stamp of the desired pose, (1,) [s]; optional")
    get_blend_factor_input_port = input_getter("blend_factor", "blend factor, (1,); 0 while the arm is not controlled")
    get_safe_pose_output_port = output_getter("safe_pose", "last valid desired pose, (O,)")
    get_command_timed_out_output_port = output_getter("command_timed_out", "flag that no command is valid, (1,)")


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
