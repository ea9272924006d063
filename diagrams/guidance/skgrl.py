"""sKGRL (thesis, equations 5.1-5.3): KGRL whose motion passes through where it has been."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.guidance.known import Known
from guiderail.diagrams.guidance.primitive_guidance import PrimitiveGuidance, skill_of
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.systems.history_buffer import HistoryBuffer
from guiderail.systems.history_length_schedule import HistoryLengthSchedule
from guiderail.systems.lc_ns_kmp_system import LcNsKmpSystem


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

    def __init__(self, known: Known):
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
        past = kmp.get_output_output_port() if skill.history_source == "commanded" else pose
        builder.Connect(action, kmp.get_null_space_action_input_port())
        builder.Connect(history.get_history_output_port(), kmp.get_history_input_port())
        builder.Connect(past, history.get_output_input_port())
        # Either way it starts from where the robot is: a command from anywhere else would be a jump.
        builder.Connect(pose, history.get_initial_output_input_port())
        self._finish(builder, skill, kmp.get_output_output_port(), kmp.get_fallback_output_port())
