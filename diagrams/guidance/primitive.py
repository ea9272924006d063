"""Guidance by a movement primitive: the demonstrations alone (KMP), KGRL and sKGRL."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import Adder, MatrixGain, PassThrough, Saturation, ZeroOrderHold

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.lc_ns_kmp_system import LcNsKmpSystem


def primitive_config_of(prior: PriorKnowledge) -> PrimitiveConfig:
    """Return the configuration of the prior's primitive; the prior must have demonstrations."""
    assert prior.primitive is not None
    return prior.primitive


def refuse_limits(config: PrimitiveConfig) -> None:
    """Raise an `InputError` if limits of the motion are given, for guidance that does not enforce them."""
    motion = config.motion
    if motion is None:
        return
    given = {
        "max_speed": np.isfinite(np.asarray(motion.max_speed, float)).any(),
        "max_acceleration": np.isfinite(np.asarray(motion.max_acceleration, float)).any(),
        "joint_margin": bool(motion.state),
    }
    if names := " and ".join(name for name, is_given in given.items() if is_given):
        raise InputError(f"only kgrl, skgrl and kmp enforce {names}: choose one of them, or leave {names} out")


class PrimitiveGuidance(Guidance):
    """Base class of guidance around a movement primitive.

    ``action`` has one entry per explored output. ``constraint_violation`` is the command's violation of the
    constraints, even if this kind of guidance does not enforce them.
    """

    def _export_inputs(self, builder: DiagramBuilder, config: PrimitiveConfig) -> tuple[OutputPort, OutputPort]:
        """Export the inputs; return the ports of the held action, mapped to all outputs (O,), and of the pose."""
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(config.control_period, config.num_actions))
        action = hold.get_output_port()
        if not np.array_equal(config.selection, np.eye(config.num_outputs)):
            action = add_system(builder, "explored_outputs", MatrixGain(D=config.selection), action).get_output_port()
        pose = builder.AddNamedSystem("pose", PassThrough(config.num_outputs))
        wrench = builder.AddNamedSystem("wrench", PassThrough(config.wrench_size))
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(pose.get_input_port(), "pose")
        builder.ExportInput(wrench.get_input_port(), "wrench")
        self._held_action = hold.get_output_port()
        return action, pose.get_output_port()

    def _constrain(
        self, builder: DiagramBuilder, config: PrimitiveConfig, kmp: LcNsKmpSystem, pose: OutputPort
    ) -> tuple[OutputPort, OutputPort]:
        """Return the ports of the command and the fallback flag, after the motion constraints if there are any.

        The primitive's progress waits for the robot if the configuration has a progress rule.
        """
        command, fallback = kmp.get_command_output_port(), kmp.get_fallback_output_port()
        if config.motion is not None:
            from guiderail.models.control.motion_constraints import MotionConstraintFilter
            from guiderail.systems.command_filter import CommandFilter

            motion = CommandFilter(MotionConstraintFilter(config.motion, config.control_period), config.control_period)
            add_system(builder, "motion_constraints", motion, desired_pose=command, pose=pose)
            count = add_system(builder, "fallbacks", Adder(2, 1), fallback, motion.get_intervention_output_port())
            flag = add_system(builder, "fallback", Saturation(np.zeros(1), np.ones(1)), count.get_output_port())
            command, fallback = motion.get_safe_pose_output_port(), flag.get_output_port()
        if config.progress is not None:
            from guiderail.systems.progress_clock import ProgressClock

            clock = ProgressClock(config.progress, config.num_outputs, config.control_period)
            add_system(builder, "progress", clock, command=command, pose=pose)
            builder.Connect(clock.get_motion_time_output_port(), kmp.get_motion_time_input_port())
            builder.ExportOutput(clock.get_motion_time_output_port(), "motion_time")
        return command, fallback

    def _finish(
        self, builder: DiagramBuilder, config: PrimitiveConfig, desired_pose: OutputPort, fallback: OutputPort
    ) -> None:
        """Export the outputs and build the diagram."""
        violation = ConstraintViolation(config.motion or config.constraints, config.control_period)
        add_system(builder, "constraint_violation", violation, pose=desired_pose)
        builder.ExportOutput(desired_pose, "desired_pose")
        builder.ExportOutput(self._held_action, "held_action")
        builder.ExportOutput(violation.get_violation_output_port(), "constraint_violation")
        builder.ExportOutput(fallback, "fallback")
        builder.BuildInto(self)


def add_demonstration(
    builder: DiagramBuilder, config: PrimitiveConfig, action: OutputPort, *, takes_window: bool = False
) -> LcNsKmpSystem:
    """Add a primitive that commands the mean of the reference, without actions, constraints or history.

    The reference is fitted to the demonstrations, or is the input ``reference_window`` if `takes_window` is True.
    """
    primitive = config.primitive(history=False, constrained=False)
    kmp = builder.AddNamedSystem("kmp", LcNsKmpSystem(primitive, None, config.control_period))
    if takes_window:
        builder.ExportInput(kmp.get_reference_window_input_port(), "reference_window")
    # Not a ConstantVectorSource: Drake assumes that its output depends on time, so the primitive would be computed
    # again at every step of the plant.
    zero = add_system(builder, "no_action", MatrixGain(D=np.zeros((config.num_outputs, config.num_outputs))), action)
    builder.Connect(zero.get_output_port(), kmp.get_null_space_action_input_port())
    return kmp


@register_guidance(
    "kmp",
    needs=(("demonstrations",),),
    label="demonstration alone",
    color="#333333",
    demonstrates=True,
    displaces=True,
    ignores_actions=True,
)
class KmpGuidance(PrimitiveGuidance):
    """Guidance that commands the demonstrations' mean; the action has no effect.

    The linear constraints are enforced only together with shapes or limits of the motion.
    """

    def __init__(self, prior: PriorKnowledge):
        super().__init__()
        config, builder = primitive_config_of(prior), DiagramBuilder()
        action, pose = self._export_inputs(builder, config)
        kmp = add_demonstration(builder, config, action)
        self._finish(builder, config, *self._constrain(builder, config, kmp, pose))


@register_guidance(
    "kgrl",
    needs=(("demonstrations",),),
    label="KGRL",
    color="#1f77b4",
    demonstrates=True,
    displaces=True,
)
class KgrlGuidance(PrimitiveGuidance):
    """KGRL: actions displace the command where the demonstrations vary, and commands satisfy the constraints."""

    def __init__(self, prior: PriorKnowledge, *, constrained: bool = True, takes_window: bool = False):
        """Construct the guidance; without constraints it is the guidance `residual_covariance`.

        With `takes_window`, mean and covariance come from the input ``reference_window``, not from the demonstrations.

        Raises:
            InputError: If there are limits of speed, acceleration or joints, but `constrained` is False.
        """
        super().__init__()
        given_config, builder = primitive_config_of(prior), DiagramBuilder()
        config = given_config if constrained else replace(given_config, motion=None)
        if not constrained:
            refuse_limits(given_config)
        action, pose = self._export_inputs(builder, config)
        primitive = config.primitive(history=False, constrained=constrained)
        kmp = LcNsKmpSystem(primitive, config.null_space_gains(primitive), config.control_period)
        add_system(builder, "lc_ns_kmp", kmp, null_space_action=action)
        if takes_window:
            builder.ExportInput(kmp.get_reference_window_input_port(), "reference_window")
        self._finish(builder, given_config, *self._constrain(builder, config, kmp, pose))


@register_guidance(
    "residual_covariance",
    needs=(("demonstrations",),),
    label="residual RL scaled by covariance",
    color="#e377c2",
    demonstrates=True,
    displaces=True,
)
def residual_covariance(prior: PriorKnowledge) -> KgrlGuidance:
    """Build KGRL without constraints: a residual that is scaled by the covariance of the demonstrations."""
    return KgrlGuidance(prior, constrained=False)


@register_guidance(
    "skgrl",
    needs=(("demonstrations",),),
    label="sKGRL",
    color="#2ca02c",
    demonstrates=True,
    displaces=True,
)
class SkgrlGuidance(PrimitiveGuidance):
    """Guidance by sKGRL: null-space actions with a history of outputs, so that exploration is smooth.

    With an adaptive history, the motion passes through fewer past outputs during contact, so that it reacts to forces
    as quickly as KGRL. With the shortest history, the motion passes through the last output only.
    """

    def __init__(self, prior: PriorKnowledge):
        from guiderail.systems.history_buffer import HistoryBuffer

        super().__init__()
        config, builder = primitive_config_of(prior), DiagramBuilder()
        action, pose = self._export_inputs(builder, config)
        primitive = config.primitive(history=True)
        gains = config.null_space_gains(primitive)
        shorter_primitives = map(config.primitive_of_length, config.shorter_histories)
        shorter = [(short, config.null_space_gains(short)) for short in shorter_primitives]
        kmp = LcNsKmpSystem(primitive, gains, config.control_period, shorter)
        add_system(builder, "lc_ns_kmp", kmp, null_space_action=action)
        if shorter:
            from guiderail.systems.history_length_schedule import HistoryLengthSchedule

            lengths = (config.history, *config.shorter_histories)
            schedule = HistoryLengthSchedule(lengths, config.control_period, wrench_size=config.wrench_size)
            builder.AddNamedSystem("history_length", schedule)
            builder.ConnectInput("wrench", schedule.get_wrench_input_port())
            builder.Connect(schedule.get_history_length_output_port(), kmp.get_history_length_input_port())
        # Commanded and measured histories both start at the robot's pose, so that the first command does not jump.
        near = primitive.reference.means[0] if config.num_outputs == 6 else None  # a pose, with angles
        history = HistoryBuffer(config.num_outputs, config.history, config.control_period, near)
        add_system(builder, "history", history, initial_output=pose)
        command, fallback = self._constrain(builder, config, kmp, pose)
        past = command if config.history_source == "commanded" else pose
        builder.Connect(history.get_history_output_port(), kmp.get_history_input_port())
        builder.Connect(past, history.get_output_input_port())
        self._finish(builder, config, command, fallback)
