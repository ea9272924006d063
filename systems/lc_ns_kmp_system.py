"""Linearly constrained null-space movement primitive as a system (thesis, equations 4.21 and 5.1)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.laws.law import checked_vector
from guiderail.models.laws.primitive import output_or_nearest, predict
from guiderail.models.primitives import LcNsKmp
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


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
