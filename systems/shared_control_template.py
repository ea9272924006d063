"""Shared control template: state machine, input mapping and active constraints (thesis, section 2.3)."""

from collections.abc import Mapping

import numpy as np
from pydrake.common.value import AbstractValue
from pydrake.math import RigidTransform
from pydrake.systems.framework import BasicVector, Context, DependencyTicket, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE, pose_to_transform, transform_to_pose
from guiderail.models.control.wrench import MAX_WRENCH_SIZE
from guiderail.models.laws.template_law import TemplateLaw, TemplateState, requested_pose
from guiderail.models.templates.template import SharedControlTemplate, check_template
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import ReadFlag, input_getter, output_getter


class TemplateFrames:
    """Poses of a template's object frames, declared as numeric parameters of a LeafSystem and as an optional port.

    Poses that are constant during an episode are parameters: a guidance diagram needs no additional port, and a reset
    moves an object with `set`. For objects that move, the input port ``frame_poses`` (6·k,) has the poses of all k
    frames in the order of `names`, [x y z Rz Ry Rx] each; while it is connected, it replaces the parameters. One source
    of it, such as a `MeasuredPose` of a fixture, serves all systems of the template. A template without frames has no
    such port.

    Args:
        system: System under construction; outputs that use the frames must depend on `ticket`.
        template: Template that uses the frames.
        frames: Default poses in the world by frame name.

    Attributes:
        names: Names of the frames.

    Raises:
        InputError: If a frame is missing, a pose is not finite, or a pose of the world is given.
    """

    def __init__(self, system: LeafSystem, template: SharedControlTemplate, frames: Mapping[str, RigidTransform]):
        check_template(template, frames)
        missing = [name for name in template.frames if name not in frames]
        if missing:
            raise InputError(f"the template {template.name} needs the frame {missing[0]}: give its pose")
        self._system, self.names = system, template.frames
        self._indices = [
            system.DeclareNumericParameter(BasicVector(_checked_pose(name, frames[name]))) for name in template.frames
        ]
        sources: list[declare.Source] = [system.all_parameters_ticket()]
        self._port = None
        if self.names:
            self._port = system.DeclareVectorInputPort("frame_poses", POSE_SIZE * len(self.names))
            sources.append(self._port)
        self._cache = declare.cache(system, "template_frames", self._calc, sources)

    @property
    def ticket(self) -> DependencyTicket:
        """Dependency ticket of values that are computed from the frames."""
        return self._cache.ticket()

    def eval(self, context: Context) -> dict[str, RigidTransform]:
        """Return the poses by name; `context` is the context of the system."""
        return self._cache.Eval(context)

    def set(self, context: Context, frames: Mapping[str, RigidTransform]) -> None:
        """Set the poses of frames by name in the context of the system; other frames do not move.

        Raises:
            InputError: If the context is another system's, the template has no such frame, or a pose is not finite.
        """
        declare.check_own_context(self._system, context)
        if unknown := [name for name in frames if name not in self.names]:
            raise InputError(f"the template has no frame {unknown[0]}, only {', '.join(self.names)}")
        poses = {name: _checked_pose(name, X_WF) for name, X_WF in frames.items()}
        for name, pose in poses.items():
            index = self._indices[self.names.index(name)]
            context.get_mutable_numeric_parameter(index).SetFromVector(pose)

    def _calc(self, context: Context) -> dict[str, RigidTransform]:
        if self._port is not None and self._port.HasValue(context):
            poses = list(self._port.Eval(context).reshape(-1, POSE_SIZE))
            for name, pose in zip(self.names, poses, strict=True):
                if not is_finite(pose):
                    raise InputError(f"the frame {name} must be at a finite pose, not at {pose}")
        else:
            poses = [np.asarray(context.get_numeric_parameter(index).CopyToVector()) for index in self._indices]
        return {name: pose_to_transform(pose) for name, pose in zip(self.names, poses, strict=True)}


_frame_poses_getter = input_getter(
    "frame_poses", "poses of the template's frames, (6·k,), instead of the parameters; optional"
)


def _checked_pose(name: str, X_WF: RigidTransform) -> np.ndarray:
    pose = transform_to_pose(X_WF)
    if not np.isfinite(pose).all():
        raise InputError(f"the frame {name} must be at a finite pose, not at {X_WF.translation()}")
    return pose


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
        frames: Poses of the template's object frames, which a reset can set, or the port ``frame_poses``
            (`TemplateFrames`).
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
    get_frame_poses_input_port = _frame_poses_getter
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


class SctInputMapping(LeafSystem):
    """Apply the input mapping of a template's current state to the inputs of a policy or a user.

        H^im = displace_q(H, map_q(u))    (equations 2.19 and 2.20)

    H is ``pose``, u is ``action`` clipped to [−1, 1] and constant for one period, and q is ``state``. If ``action`` is
    not finite, or ``state`` is not the number of a state, the requested pose is NaN, and an `ActiveConstraintProjector`
    repeats its last safe command.

    ``action`` is (n,), in [−1, 1]; ``pose`` and ``requested_pose`` are (6,), [x y z Rz Ry Rx] in meters and radians;
    ``state`` is (1,), the number of the template's state.

    Args:
        template: Shared control template.
        frames: Poses of the template's object frames by name, in the reference frame of the poses at the ports.
        period: Control period [s], positive.

    Raises:
        InputError: If the period is not positive, or a frame is missing or not finite.

    Attributes:
        frames: Poses of the template's object frames, which a reset can set, or the port ``frame_poses``
            (`TemplateFrames`).
    """

    def __init__(self, template: SharedControlTemplate, frames: Mapping[str, RigidTransform], period: float):
        super().__init__()
        declare.check_period(period)
        self._template, self._period = template, period
        self._action_port = self.DeclareVectorInputPort("action", template.inputs)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._state_port = self.DeclareVectorInputPort("state", 1)
        self.frames = TemplateFrames(self, template, frames)
        sources = [self._action_port, self._pose_port, self._state_port, self.frames.ticket]
        declare.output(self, "requested_pose", 6, self._requested_pose, sources)

    get_action_input_port = input_getter("action", "inputs u of a policy or a user, (n,), in [−1, 1]")
    get_pose_input_port = input_getter("pose", "pose H to displace, (6,)")
    get_state_input_port = input_getter("state", "number of the template's state, (1,)")
    get_frame_poses_input_port = _frame_poses_getter
    get_requested_pose_output_port = output_getter("requested_pose", "requested pose H^im, (6,), not constrained")

    def _requested_pose(self, context: Context) -> np.ndarray:
        state = declare.state_number(self._state_port, context, len(self._template.states))
        action, pose = self._action_port.Eval(context), self._pose_port.Eval(context)
        return requested_pose(self._template, state, action, pose, self.frames.eval(context), self._period)


class ActiveConstraintProjector(LeafSystem):
    """Project requested poses into the active constraints of a shared control template's current state.

        H^ac = project_q(H^im), reachable in one period from the last command    (equation 2.21)

    H^im is the requested pose, q the template's state and H^ac the command; see `SharedControlTemplate.command`. The
    last command is discrete state. The first command is the measured pose, moved towards the constraints by at most the
    motion of one period. Between control instants, the output depends only on discrete state, H^im and q.

    If the requested pose or the measured pose is not finite, the last safe command is repeated and ``fallback`` is 1.
    The last command is also repeated if the tracking error exceeds its limit and the new command would not reduce it,
    for example while an obstacle blocks the robot. A repeated command can be outside the constraints after a transition
    or the motion of an object; it is then projected into the constraints.

    All poses are (6,), [x y z Rz Ry Rx] in meters and radians; the other ports are (1,). ``state`` is the number of the
    template's state. Each violation output is the largest violation of an active constraint, in meters or radians; it
    is 0 if all active constraints are satisfied. If ``state`` is not the number of a state, the last command is
    repeated with ``fallback`` 1, and the violations are the maxima over all states.

    Args:
        template: Shared control template.
        frames: Poses of the template's object frames by name, in the reference frame of the poses at the ports.
        period: Control period [s], positive.
        max_tracking_error: Limit of the tracking error [m], positive; infinite by default. The tracking error is the
            distance between the last command and the position measured at the same instant.

    Raises:
        InputError: If a frame is missing or not finite, or active constraints of a state contradict each other. At
            initialization, if the measured pose or a frame is not finite, or the measured pose is more than 0.2 m or 1
            rad outside of the active constraints.

    Attributes:
        frames: Poses of the template's object frames, which a reset can set, or the port ``frame_poses``
            (`TemplateFrames`).
    """

    def __init__(
        self,
        template: SharedControlTemplate,
        frames: Mapping[str, RigidTransform],
        period: float,
        max_tracking_error: float = np.inf,
    ):
        super().__init__()
        self._law = TemplateLaw(template, {}, period, max_tracking_error=max_tracking_error)
        self._requested_pose_port = self.DeclareVectorInputPort("requested_pose", 6)
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._state_port = self.DeclareVectorInputPort("state", 1)
        self.frames = TemplateFrames(self, template, frames)

        # [last command (6,), pose (6,) measured at the same instant]
        self._last = declare.unset_state(self, 12)
        constraints = [self._state_port, self.frames.ticket]
        self._command = declare.cache_entry(
            self, "command", self._calc_command, [*constraints, self._last, self._requested_pose_port]
        )
        declare.part_output(self, "desired_pose", self._command, lambda command: command[:6], 6)
        declare.output(
            self,
            "last_desired_pose",
            6,
            lambda context: declare.initialized(self, context, self._last)[:6],
            [self._last],
        )
        declare.part_output(self, "fallback", self._command, lambda command: command[6])
        declare.scalar_output(self, "commanded_violation", self._commanded_violation, [self._command, *constraints])
        declare.scalar_output(self, "measured_violation", self._measured_violation, [*constraints, self._pose_port])
        declare.update_after_start(self, period, self._update, self._start)

    get_requested_pose_input_port = input_getter("requested_pose", "requested pose H^im, (6,)")
    get_pose_input_port = input_getter("pose", "measured pose, (6,)")
    get_state_input_port = input_getter("state", "number of the template's state, (1,)")
    get_frame_poses_input_port = _frame_poses_getter
    get_desired_pose_output_port = output_getter("desired_pose", "command H^ac, (6,), inside the active constraints")
    get_last_desired_pose_output_port = output_getter("last_desired_pose", "previous command, (6,)")
    get_fallback_output_port = output_getter("fallback", "flag that the last safe command is repeated, (1,)")
    get_commanded_violation_output_port = output_getter("commanded_violation", "violation of the command, (1,)")
    get_measured_violation_output_port = output_getter("measured_violation", "violation of the measured pose, (1,)")

    def _state(self, context: Context) -> int | None:
        return declare.state_number(self._state_port, context, len(self._law.template.states))

    def _calc_command(self, context: Context, value: AbstractValue) -> None:
        """Compute the command and the fallback flag, (7,)."""
        stored = declare.initialized(self, context, self._last)
        last, measured = stored[:6], stored[6:]
        number, command, is_fallback = self._state(context), last, True
        if number is not None:
            requested, frames = self._requested_pose_port.Eval(context), self.frames.eval(context)
            command, is_fallback = self._law.constrain(TemplateState(number, last, measured), requested, frames)
        value.set_value(np.append(command, float(is_fallback)))

    def _commanded_violation(self, context: Context) -> float:
        return self._law.violation(self._state(context), self._command.Eval(context)[:6], self.frames.eval(context))

    def _measured_violation(self, context: Context) -> float:
        return self._law.violation(self._state(context), self._pose_port.Eval(context), self.frames.eval(context))

    def _start(self, context: Context, discrete_state: DiscreteValues) -> None:
        measured = declare.start_pose(self._pose_port.Eval(context))
        # The state port is not read, because the system that outputs the state is initialized at the same instant.
        start = self._law.start_in(measured, self.frames.eval(context))
        discrete_state.set_value(self._last, np.concatenate([start.last, measured]))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        command, measured = self._command.Eval(context)[:6], self._pose_port.Eval(context)
        discrete_state.set_value(self._last, np.concatenate([command, measured]))
