"""What all guidance made of a movement primitive shares: its ports, and the demonstrations that nothing pulls at."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import MatrixGain, PassThrough, ZeroOrderHold

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.primitive_config import PrimitiveConfig
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.history_buffer import HistoryBuffer
from guiderail.systems.history_length_schedule import HistoryLengthSchedule
from guiderail.systems.lc_ns_kmp_system import LcNsKmpSystem


def skill_of(known: PriorKnowledge) -> PrimitiveConfig:
    """The demonstrations that are known; whoever registered its needs has them."""
    assert known.demonstrations is not None
    return known.demonstrations


class PrimitiveGuidance(Guidance):
    """A diagram with the ports of all guidance, around a movement primitive.

    ``action`` has one entry per action_dims output. ``constraint_violation`` is judged of the command as it comes out,
    whether or not this kind keeps the constraints.
    """

    def _export_inputs(self, builder: DiagramBuilder, skill: PrimitiveConfig) -> tuple[OutputPort, OutputPort]:
        """Exports the inputs and returns where the held action, spread over all outputs (O,), and the pose come out."""
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(skill.control_period, skill.num_actions))
        action = hold.get_output_port()
        if not np.array_equal(skill.selection, np.eye(skill.num_outputs)):
            spread = builder.AddNamedSystem("explored_outputs", MatrixGain(D=skill.selection))
            builder.Connect(action, spread.get_input_port())
            action = spread.get_output_port()
        pose = builder.AddNamedSystem("pose", PassThrough(skill.num_outputs))
        wrench = builder.AddNamedSystem("wrench", PassThrough(skill.wrench_size))
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(pose.get_input_port(), "pose")
        builder.ExportInput(wrench.get_input_port(), "wrench")
        self._held_action = hold.get_output_port()
        return action, pose.get_output_port()

    def _finish(
        self, builder: DiagramBuilder, skill: PrimitiveConfig, desired_pose: OutputPort, fallback: OutputPort
    ) -> None:
        """Exports the outputs and builds."""
        violation = builder.AddNamedSystem(
            "constraint_violation", ConstraintViolation(skill.constraints, skill.control_period)
        )
        builder.Connect(desired_pose, violation.get_pose_input_port())
        builder.ExportOutput(desired_pose, "desired_pose")
        builder.ExportOutput(self._held_action, "held_action")
        builder.ExportOutput(violation.get_violation_output_port(), "constraint_violation")
        builder.ExportOutput(fallback, "fallback")
        builder.BuildInto(self)


def add_demonstration(builder: DiagramBuilder, skill: PrimitiveConfig, action: OutputPort) -> LcNsKmpSystem:
    """Adds the primitive without actions, constraints or history: what the demonstrations alone command."""
    primitive = skill.primitive(history=False, constrained=False)
    kmp = builder.AddNamedSystem("kmp", LcNsKmpSystem(primitive, None, skill.control_period))
    # Not a ConstantVectorSource: Drake takes that for something that depends on time, and the primitive would be
    # computed anew at every step of the plant.
    zero = builder.AddNamedSystem("no_action", MatrixGain(D=np.zeros((skill.num_outputs, skill.num_outputs))))
    builder.Connect(action, zero.get_input_port())
    builder.Connect(zero.get_output_port(), kmp.get_null_space_action_input_port())
    return kmp


@register_guidance(
    "kmp",
    needs=(("demonstrations",),),
    label="demonstration alone",
    colour="#333333",
    demonstrates=True,
    displaces=True,
)
class KmpGuidance(PrimitiveGuidance):
    """Commands the demonstrations' mean; the action changes nothing."""

    def __init__(self, known: PriorKnowledge):
        super().__init__()
        skill, builder = skill_of(known), DiagramBuilder()
        action, _ = self._export_inputs(builder, skill)
        kmp = add_demonstration(builder, skill, action)
        self._finish(builder, skill, kmp.get_command_output_port(), kmp.get_fallback_output_port())


@register_guidance(
    "kgrl",
    needs=(("demonstrations",),),
    label="KGRL",
    colour="#1f77b4",
    demonstrates=True,
    displaces=True,
)
class KgrlGuidance(PrimitiveGuidance):
    """A policy's actions deviate where the demonstrations did, and every command keeps the constraints."""

    def __init__(self, known: PriorKnowledge):
        super().__init__()
        skill, builder = skill_of(known), DiagramBuilder()
        action, _ = self._export_inputs(builder, skill)
        primitive = skill.primitive(history=False)
        gains = skill.null_space_gains(primitive)
        kmp = builder.AddNamedSystem("lc_ns_kmp", LcNsKmpSystem(primitive, gains, skill.control_period))
        builder.Connect(action, kmp.get_null_space_action_input_port())
        self._finish(builder, skill, kmp.get_command_output_port(), kmp.get_fallback_output_port())


@register_guidance(
    "skgrl",
    needs=(("demonstrations",),),
    label="sKGRL",
    colour="#2ca02c",
    demonstrates=True,
    displaces=True,
)
class SkgrlGuidance(PrimitiveGuidance):
    """Null-space actions through a history of outputs: exploration is smooth.

    With an adaptive history the motion passes through less of it in contact, so that it answers to forces as quickly as
    KGRL there, and is as smooth as ever elsewhere. The shortest history is one output, never none: every command still
    begins where the last one ended, whatever the length does.
    """

    def __init__(self, known: PriorKnowledge):
        super().__init__()
        skill, builder = skill_of(known), DiagramBuilder()
        action, pose = self._export_inputs(builder, skill)
        primitive = skill.primitive(history=True)
        gains = skill.null_space_gains(primitive)
        shorter = [
            (one, skill.null_space_gains(one)) for one in map(skill.primitive_of_length, skill.shorter_histories)
        ]
        kmp = builder.AddNamedSystem("lc_ns_kmp", LcNsKmpSystem(primitive, gains, skill.control_period, shorter))
        if shorter:
            schedule = builder.AddNamedSystem(
                "history_length",
                HistoryLengthSchedule(
                    (skill.history, *skill.shorter_histories), skill.control_period, wrench_size=skill.wrench_size
                ),
            )
            builder.ConnectInput("wrench", schedule.get_wrench_input_port())
            builder.Connect(schedule.get_history_length_output_port(), kmp.get_history_length_input_port())
        history = builder.AddNamedSystem(
            "history", HistoryBuffer(skill.num_outputs, skill.history, skill.control_period)
        )
        past = kmp.get_command_output_port() if skill.history_source == "commanded" else pose
        builder.Connect(action, kmp.get_null_space_action_input_port())
        builder.Connect(history.get_history_output_port(), kmp.get_history_input_port())
        builder.Connect(past, history.get_output_input_port())
        # Either way it starts from where the robot is: a command from anywhere else would be a jump.
        builder.Connect(pose, history.get_initial_output_input_port())
        self._finish(builder, skill, kmp.get_command_output_port(), kmp.get_fallback_output_port())
