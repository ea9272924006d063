"""Movement primitive with its history and clock, and residual of a policy (thesis, sections 4.3, 4.4.1 and 5.3)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, nearest_pose
from guiderail.models.laws import StateProgress
from guiderail.models.laws.law import checked_vector
from guiderail.models.laws.primitive import appended, output_or_nearest, predict
from guiderail.models.primitives import LcNsKmp
from guiderail.systems.command_checks import ConstraintViolation
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.scalar_conversion import ConvertibleSystem


@dataclass(frozen=True, slots=True)
class _Prediction:
    step: int
    output: np.ndarray
    fallback: bool


class LcNsKmpSystem(LeafSystem):
    """Predict the command of a linearly constrained null-space primitive (`LcNsKmp`) at every control step.

        command = LC-NS-KMP(step, gain · null_space_action)             KGRL, equation 4.21
        command = LC-NS-KMP(step, gain · null_space_action, history)    sKGRL, equation 5.1

    ``null_space_action`` is (O,), the policy's action in [−1, 1], which is not clipped here, constant during a control
    step. ``history`` is (P*O,), row-major, oldest output first (`HistoryBuffer`). ``history_length`` (1,) selects the
    primitive by the length of its history (`HistoryLengthSchedule`). Each primitive uses the newest part of
    ``history``, so that its command starts at the end of the previous command. ``reference_window`` is ((H+1)(O + O²),)
    for the horizon H of `primitive`: means and covariances, the current step first. If this port is connected, they
    replace those of the reference trajectory, and all primitives must have the horizon H. ``command`` is (O,).
    ``constraint_violation`` (1,) is max(c − G y) of the command y: negative if all constraints are slack, and
    `ConstraintViolation.UNCONSTRAINED` if there is no constraint. ``fallback`` (1,) is 1 if no window within the
    constraints was found. The command is then the point within the constraints of the current step that is nearest to
    the last command.

    The step is a discrete state that counts control periods since time zero. If ``motion_time`` (1,) [s] is connected
    (`ProgressClock`), it determines the step instead. The command is a pure function of step, action and history. It is
    computed once per control step (see docs/concepts/rates.md).

    Args:
        primitive: Primitive with O outputs and a history of P outputs.
        gain: Raw null-space action per unit of the policy's action (`models.primitives.gains`), (O,); None: ones.
        period: Control period [s], positive. It is not checked against the period of the reference trajectory. If the
            two differ, the motion is faster or slower than the demonstrations (`ReferenceTrajectory.resampled`).
        shorter: Pairs of a primitive with a history of 1 to P − 1 outputs and its gain (O,). Motion and constraints of
            these primitives are the same as those of `primitive`.

    Attributes:
        primitive: Primitive with the longest history.

    Raises:
        InputError: If the gain is not finite, or a primitive in `shorter` has other constraints. At an evaluation, if
            the action, the history or the time is not finite, no primitive has the selected history length, or the
            history of a pose (O = 6) starts more than half a turn from the reference.
    """

    def __init__(
        self,
        primitive: LcNsKmp,
        gain: np.ndarray | None,
        period: float,
        shorter: Sequence[tuple[LcNsKmp, np.ndarray]] = (),
    ):
        super().__init__()
        outputs = primitive.num_outputs
        for other, _ in shorter:
            first, second = primitive.constraints, other.constraints
            if not (np.array_equal(first.G, second.G) and np.array_equal(first.c, second.c)):
                raise InputError(f"the primitive with a history of {other.history} outputs has other constraints")
        self.primitive, self._period = primitive, period
        self._by_history_length = {
            other.history: (other, checked_vector(own_gain, "the gain", outputs))
            for other, own_gain in [(primitive, np.ones(outputs) if gain is None else gain), *shorter]
        }

        self._null_space_action_port = self.DeclareVectorInputPort("null_space_action", outputs)
        self._history_port = (
            self.DeclareVectorInputPort("history", primitive.history * outputs) if primitive.history else None
        )
        self._history_length_port = self.DeclareVectorInputPort("history_length", 1) if shorter else None
        self._motion_time_port = self.DeclareVectorInputPort("motion_time", 1)
        window_size = (primitive.horizon + 1) * (outputs + outputs**2)
        self._reference_window_port = self.DeclareVectorInputPort("reference_window", window_size)
        self._step = self.DeclareDiscreteState(1)
        self._initial_command = primitive.constraints.nearest(primitive.reference.means[0])
        self._last_command = self.DeclareDiscreteState(self._initial_command)
        declare.update(self, period, self._advance, self._reset)

        optional = [port for port in (self._history_port, self._history_length_port) if port is not None]
        ports = [self._null_space_action_port, self._motion_time_port, self._reference_window_port, *optional]
        self._prediction = declare.cache_entry(
            self, "prediction", self._predict, [*ports, self._step, self._last_command]
        )
        declare.part_output(self, "command", self._prediction, lambda prediction: prediction.output, outputs)
        declare.part_output(self, "constraint_violation", self._prediction, self._violation)
        declare.part_output(self, "fallback", self._prediction, lambda prediction: prediction.fallback)

    @property
    def gain(self) -> np.ndarray:
        """Raw null-space action per unit of the policy's action, (O,)."""
        return self._by_history_length[self.primitive.history][1].copy()

    get_null_space_action_input_port = input_getter("null_space_action", "policy's action in [−1, 1], (O,)")
    get_history_input_port = input_getter("history", "last outputs, (P*O,), oldest first, if P > 0")
    get_history_length_input_port = input_getter(
        "history_length", "history length, (1,), if there are primitives with shorter histories"
    )
    get_motion_time_input_port = input_getter("motion_time", "time of the motion, (1,) [s]; optional")
    get_reference_window_input_port = input_getter(
        "reference_window", "means and covariances of the window, ((H+1)(O + O²),); optional"
    )
    get_command_output_port = output_getter("command", "command, (O,)")
    get_constraint_violation_output_port = output_getter("constraint_violation", "violation of the command, (1,)")
    get_fallback_output_port = output_getter("fallback", "flag that the command is a fallback, (1,)")

    def _reset(self, context: Context, discrete_state: DiscreteValues) -> None:
        step = round(context.get_time() / self._period)
        discrete_state.set_value(self._step, [step])
        if step == 0:  # after a later initialization, a fallback still uses the last command
            discrete_state.set_value(self._last_command, self._initial_command)

    def _advance(self, context: Context, discrete_state: DiscreteValues) -> None:
        step = round(context.get_time() / self._period)
        if step > 0:
            discrete_state.set_value(self._last_command, self._prediction.Eval(context).output)
        discrete_state.set_value(self._step, [step])

    def _predict(self, context: Context, value: AbstractValue) -> None:
        step = int(context.get_discrete_state().value(self._step).item())
        if self._motion_time_port.HasValue(context):
            time = self._motion_time_port.Eval(context)[0]
            if not math.isfinite(time):
                raise InputError(f"motion_time must be finite, not {time} s")
            step = round(time / self._period)
        length = self.primitive.history
        if self._history_length_port is not None:
            length = self._history_length_port.Eval(context)[0]
            if length not in self._by_history_length:
                known = ", ".join(map(str, sorted(self._by_history_length)))
                raise InputError(f"there is no primitive with a history of {length:g} outputs, only with {known}")
            length = int(length)
        primitive, gain = self._by_history_length[length]
        action = gain * self._null_space_action_port.Eval(context)
        history = None
        if self._history_port is not None:
            history = self._history_port.Eval(context).reshape(-1, primitive.num_outputs)[-length:]
        window = self._reference_window_port.Eval(context) if self._reference_window_port.HasValue(context) else None
        if step == 0 and history is not None and window is None and primitive.num_outputs == POSE_SIZE:
            angles = np.abs(history[-1, 3:] - primitive.reference.means[0, 3:]).max()
            if angles > math.pi + 1e-6:  # a command between the two would be far from both
                raise InputError(
                    f"the history starts {angles:.2f} rad from the reference, more than half a turn: give the "
                    "HistoryBuffer `near`, the first mean of the reference"
                )
        output = predict(primitive, step, action, history, window)
        last_command = context.get_discrete_state().value(self._last_command)
        value.set_value(_Prediction(step, *output_or_nearest(primitive.constraints, step, output, last_command)))

    def _violation(self, prediction: _Prediction) -> float:
        violation = self.primitive.constraints.violation(prediction.output, prediction.step)
        return max(violation, ConstraintViolation.UNCONSTRAINED)


class HistoryBuffer(LeafSystem):
    """Buffer of the last P outputs, the via-points of sKGRL's movement primitive.

        history = [y_{t−P} … y_{t−1}]    (T_p of equation 5.3)

    At every control step, the newest output replaces the oldest. An initialization fills all P entries with
    ``initial_output``, the measured pose if ``output`` is a command. A history of measured outputs has the same signal
    at both ports.

    ``output`` and ``initial_output`` are (O,), ``history`` is (P*O,), row-major, oldest first, in the units of
    ``output``. ``history`` is a discrete state without direct feedthrough, so that the feedback loop with the primitive
    is not algebraic.

    Args:
        num_outputs: Size O of an output, at least 1.
        length: Number P of stored outputs, at least 1.
        period: Control period [s], positive.
        near: Pose (6,), [x y z Rz Ry Rx], such as the first mean of the reference; None: outputs are stored unchanged.
            With it, the angles of the first output are those of its orientation nearest to `near`, and the angles of
            each output those nearest to the output before (`nearest_pose`), so that the history has no jumps. Without
            it, `LcNsKmpSystem` refuses a start more than half a turn from its reference.

    Raises:
        InputError: At initialization, if ``initial_output`` is not finite.
    """

    def __init__(self, num_outputs: int, length: int, period: float, near: np.ndarray | None = None):
        super().__init__()
        self._shape = (length, num_outputs)
        self._near = near
        self._output_port = self.DeclareVectorInputPort("output", num_outputs)
        self._initial_output_port = self.DeclareVectorInputPort("initial_output", num_outputs)
        self._state = declare.unset_state(self, length * num_outputs)
        declare.output(self, "history", length * num_outputs, self._history, [self._state])
        declare.update_after_start(self, period, self._shift, self._fill)

    get_output_input_port = input_getter("output", "output to store, (O,)")
    get_initial_output_input_port = input_getter("initial_output", "output that fills the history, (O,)")
    get_history_output_port = output_getter("history", "last P outputs, (P*O,), oldest first")

    def _history(self, context: Context) -> np.ndarray:
        return declare.initialized(self, context, self._state)

    def _fill(self, context: Context, discrete_state: DiscreteValues) -> None:
        initial = declare.start_pose(self._initial_output_port.Eval(context))
        first = initial if self._near is None else nearest_pose(initial, self._near)
        discrete_state.set_value(self._state, np.tile(first, self._shape[0]))

    def _shift(self, context: Context, discrete_state: DiscreteValues) -> None:
        stored = self._history(context).reshape(self._shape)
        history = appended(stored, self._output_port.Eval(context), is_pose=self._near is not None)
        discrete_state.set_value(self._state, history.ravel())


class HistoryLengthSchedule(LeafSystem):
    """Shorten the history of sKGRL in contact and lengthen it again in free space.

    In contact, the length changes to the next shorter of `lengths` at every control step. In free space, it changes to
    the next longer of `lengths` after every `dwell_steps` control steps. Contact is detected with hysteresis: it begins
    when the measured force exceeds `contact_threshold` and ends when the force is at most `release_threshold`. A force
    of NaN counts as contact.

    ``wrench`` is (W,), measured; its first three entries, or all entries if W is less than 3, are a force [N].
    ``history_length`` is (1,), the number P of stored outputs; it is discrete state, initially the longest length.

    Args:
        lengths: History lengths in any order, whole numbers of at least 1, at least one. 0 is refused, because without
            a history a command would not start at the end of the previous command.
        period: Control period [s], positive.
        contact_threshold: Force above which contact begins [N], finite.
        release_threshold: Force at or below which contact ends [N], from 0 to `contact_threshold`.
        dwell_steps: Number of control steps in free space before the next longer length, at least 1.
        wrench_size: Size W of the wrench, at least 1.

    Raises:
        InputError: If an argument is out of range.
    """

    def __init__(
        self,
        lengths: Sequence[int],
        period: float,
        *,
        contact_threshold: float = 2.0,
        release_threshold: float = 1.0,
        dwell_steps: int = 10,
        wrench_size: int = 6,
    ):
        super().__init__()
        if not len(lengths) or not all(length >= 1 and float(length).is_integer() for length in lengths):
            raise InputError(f"history lengths are whole numbers from 1, at least one of them, not {list(lengths)}")
        if not 0.0 <= release_threshold <= contact_threshold < np.inf:
            raise InputError(f"a contact begins above {contact_threshold} N: let it end at 0 to this force")
        self._lengths = sorted({int(length) for length in lengths}, reverse=True)
        self._contact_threshold, self._release_threshold = contact_threshold, release_threshold
        self._dwell_steps = dwell_steps
        self._wrench_port = self.DeclareVectorInputPort("wrench", wrench_size)
        # [index into `_lengths`, longest first; 1 in contact, else 0; steps in free space since contact or an increase]
        self._state = self.DeclareDiscreteState(3)
        declare.scalar_output(
            self,
            "history_length",
            lambda context: self._lengths[int(context.get_discrete_state().value(self._state)[0])],
            [self._state],
        )
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_wrench_input_port = input_getter("wrench", "measured wrench, (W,), force first")
    get_history_length_output_port = output_getter("history_length", "history length P, (1,)")

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        index, in_contact, num_free_steps = context.get_discrete_state().value(self._state)
        force = float(np.linalg.norm(self._wrench_port.Eval(context)[:3]))
        # `not force <=` instead of `force >`, so that NaN counts as contact.
        in_contact = not force <= (self._release_threshold if in_contact else self._contact_threshold)
        if in_contact:
            index, num_free_steps = min(index + 1, len(self._lengths) - 1), 0
        else:
            num_free_steps += 1
            if num_free_steps >= self._dwell_steps:
                index, num_free_steps = max(index - 1, 0), 0
        discrete_state.set_value(self._state, [index, in_contact, num_free_steps])


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


class Residual(ConvertibleSystem):
    """Add the residual of a policy to a reference (thesis, section 4.4.1).

        desired_pose = reference + K action

    All ports are (O,); ``action`` is in [−1, 1]. Drake's `Adder` is not used, because its output counts as
    time-dependent: downstream outputs would be computed again at every plant step. `ToAutoDiffXd` and `ToSymbolic`
    convert the system.

    Args:
        gain: Diagonal of K, (O,), in units of the reference per unit of action.
    """

    def __init__(self, gain: np.ndarray):
        super().__init__()
        self._gain = as_numbers(gain, "gain")
        self.declare_converted(self, float)

    get_reference_input_port = input_getter("reference", "reference, (O,)")
    get_action_input_port = input_getter("action", "policy's action, (O,)")
    get_desired_pose_output_port = output_getter("desired_pose", "desired pose, (O,)")

    def declare_converted(self, system: Any, scalar: type) -> None:
        """Declare the ports of this system in `system`; the law is that of every scalar type."""
        gain = self._gain
        reference = system.DeclareVectorInputPort("reference", gain.size)
        action = system.DeclareVectorInputPort("action", gain.size)

        def desired_pose(context: Context) -> np.ndarray:
            with np.errstate(invalid="ignore"):  # NumPy warns about formulas
                return reference.Eval(context) + gain * action.Eval(context)

        declare.output(system, "desired_pose", gain.size, desired_pose, [reference, action])
