"""State machine of a shared control template (thesis, section 2.3)."""

from collections.abc import Mapping

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import pose_to_transform
from guiderail.models.control.wrench import MAX_WRENCH_SIZE
from guiderail.models.templates.template import SharedControlTemplate
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.required_output import ReadFlag
from guiderail.systems.support.template_frames import TemplateFrames


class SctStateMachine(LeafSystem):
    """Finite state machine of a shared control template.

        q → q' if d_q < threshold of the transition to q',  q' → q if d_q > threshold + hysteresis

    q is the state and d_q its transition distance. At every control step, the conditions are evaluated with the pose
    just before the step, and at most one transition is taken (see `SharedControlTemplate.next_state`). A transition is
    postponed until a command can satisfy the active constraints of the next state within one period. An episode begins
    in the state of the initial pose (`SharedControlTemplate.state_at`).

    ``pose`` and ``initial_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians. ``initial_pose`` is the measured
    pose. It replaces ``pose`` at initialization, because a commanded ``pose`` may not be initialized yet. ``state`` is
    (1,), the number of the state, without direct feedthrough. ``transition_distance`` is (1,), d_q of the current state
    in meters or radians. ``progress`` is (1,), the progress in the whole task, accumulated over the states. Its
    increase in a step is the decrease d_{t−1} − d_t of the transition distance (equation 3.2) times the weight of the
    state.

    ``max_wrench`` is (8,), the limits of force and torque of the state (`SharedControlTemplate.max_wrench`), without
    direct feedthrough; infinite without limits. If a state has limits, connect it to the input ``max_wrench`` of the
    controller or the station. A `PhaseWrenchLimit` between them bounds its rate of change; it also connects a
    controller that does not evaluate the limit at its initialization.

    Args:
        template: Shared control template.
        frames: Poses of the template's object frames by name, in the reference frame of the poses at the ports.
        period: Control period [s], positive.

    Raises:
        InputError: If a frame is missing or not finite. At initialization, if ``initial_pose`` is not finite, or a
            state limits force or torque and nothing reads ``max_wrench``.

    Attributes:
        frames: Poses of the template's object frames, parameters that a reset can set. While ``frame_poses`` (6·k,) is
            connected, the poses of the k frames that it has replace them, for objects that move (`TemplateFrames`).
    """

    def __init__(self, template: SharedControlTemplate, frames: Mapping[str, RigidTransform], period: float):
        super().__init__()
        self._template, self._period = template, period
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._initial_pose_port = self.DeclareVectorInputPort("initial_pose", 6)
        self.frames = TemplateFrames(self, template, frames)
        self._state = self.DeclareDiscreteState([float(template.initial_state)])
        self.DeclareStateOutputPort("state", self._state)
        sources = [self._pose_port, self._state, self.frames.ticket]
        declare.scalar_output(
            self, "transition_distance", lambda context: template.distance(*self._state_pose_frames(context)), sources
        )
        declare.scalar_output(
            self, "progress", lambda context: template.progress(*self._state_pose_frames(context)), sources
        )
        self._limits = [template.max_wrench(number) for number in range(len(template.states))]
        declare.output(self, "max_wrench", MAX_WRENCH_SIZE, self._max_wrench, [self._state])
        self._read = ReadFlag(self) if template.limits_wrench else None
        if self._read is not None:
            self.DeclareInitializationPublishEvent(self._check_limits)
        declare.update_after_start(self, period, self._update, self._start)

    get_pose_input_port = input_getter("pose", "pose at which transition distances are evaluated, (6,)")
    get_initial_pose_input_port = input_getter("initial_pose", "pose that determines the first state, (6,)")
    get_frame_poses_input_port = input_getter(
        "frame_poses", "poses of the template's frames, (6·k,), instead of the parameters; optional"
    )
    get_state_output_port = output_getter("state", "number of the template's state, (1,)")
    get_transition_distance_output_port = output_getter("transition_distance", "transition distance, (1,) [m or rad]")
    get_progress_output_port = output_getter("progress", "progress in the task, (1,)")
    get_max_wrench_output_port = output_getter("max_wrench", "limits of force and torque of the state, (8,)")

    def _state_pose_frames(self, context: Context) -> tuple[int, RigidTransform, dict[str, RigidTransform]]:
        state = int(context.get_discrete_state().value(self._state).item())
        return state, pose_to_transform(self._pose_port.Eval(context)), self.frames.eval(context)

    def _max_wrench(self, context: Context) -> np.ndarray:
        limits = self._limits[int(context.get_discrete_state().value(self._state).item())]
        return limits if self._read is None else self._read.marked(context, limits)

    def _check_limits(self, context: Context) -> None:
        assert self._read is not None
        if not self._read.is_set(context):
            name = next(state.name for state in self._template.states if state.limits_wrench)
            raise InputError(
                f"state {name!r} of template {self._template.name!r} limits force or torque, and no controller follows "
                f"the limit: connect the output max_wrench of '{self.get_name()}' to the controller's input max_wrench"
            )

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        X_WE = pose_to_transform(declare.start_pose(self._initial_pose_port.Eval(context)))
        discrete_state.set_value(self._state, [float(self._template.state_at(X_WE, self.frames.eval(context)))])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._template.next_state(*self._state_pose_frames(context), self._period)
        discrete_state.set_value(self._state, [float(state)])
