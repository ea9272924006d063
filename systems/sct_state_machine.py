"""State machine of a shared control template (thesis, section 2.3)."""

from collections.abc import Mapping

from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.transforms import pose_to_transform
from guiderail.models.templates.template import SharedControlTemplate
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.template_frames import TemplateFrames


class SctStateMachine(LeafSystem):
    """Finite state machine of a shared control template.

        q → q' if d_q < threshold of the transition to q',  q' → q if d_q > threshold + hysteresis

    q is the state and d_q its transition distance. At every control step, the conditions are evaluated with the pose
    just before the step, and at most one transition is taken (see `SharedControlTemplate.next_state`). A transition is
    postponed until a command can satisfy the active constraints of the next state within one period. An episode begins
    in the state of the initial pose (`SharedControlTemplate.state_at`).

    .. pydrake_system::

        name: SctStateMachine
        input_ports:
        - pose
        - initial_pose
        - frame_poses (optional)
        output_ports:
        - state
        - transition_distance
        - progress

    ``pose`` and ``initial_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians. ``initial_pose`` is the measured
    pose. It replaces ``pose`` at initialization, because a commanded ``pose`` may not be initialized yet. ``state`` is
    (1,), the number of the state, without direct feedthrough. ``transition_distance`` is (1,), d_q of the current state
    in meters or radians. ``progress`` is (1,), the progress in the whole task, accumulated over the states. Its
    increase in a step is the decrease d_{t−1} − d_t of the transition distance (equation 3.2) times the weight of the
    state.

    Args:
        template: Shared control template.
        frames: Poses of the template's object frames by name, in the reference frame of the poses at the ports.
        period: Control period [s], positive.

    Raises:
        InputError: If the period is not positive, or a frame is missing or not finite. At initialization, if
            ``initial_pose`` is not finite.

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
        declare.update_after_start(self, period, self._update, self._start)

    get_pose_input_port = input_getter("pose", "pose at which transition distances are evaluated, (6,)")
    get_initial_pose_input_port = input_getter("initial_pose", "pose that determines the first state, (6,)")
    get_frame_poses_input_port = input_getter(
        "frame_poses", "poses of the template's frames, (6·k,), instead of the parameters; optional"
    )
    get_state_output_port = output_getter("state", "number of the template's state, (1,)")
    get_transition_distance_output_port = output_getter("transition_distance", "transition distance, (1,) [m or rad]")
    get_progress_output_port = output_getter("progress", "progress in the task, (1,)")

    def _state_pose_frames(self, context: Context) -> tuple[int, RigidTransform, dict[str, RigidTransform]]:
        state = int(context.get_discrete_state().value(self._state).item())
        return state, pose_to_transform(self._pose_port.Eval(context)), self.frames.eval(context)

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        X_WE = pose_to_transform(declare.start_pose(self._initial_pose_port.Eval(context)))
        discrete_state.set_value(self._state, [float(self._template.state_at(X_WE, self.frames.eval(context)))])

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        state = self._template.next_state(*self._state_pose_frames(context), self._period)
        discrete_state.set_value(self._state, [float(state)])
