"""KGRL (thesis, equation 4.21): null-space actions on a movement primitive that keeps linear constraints."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.guidance.known import Known
from guiderail.diagrams.guidance.primitive_guidance import PrimitiveGuidance, skill_of
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.systems.lc_ns_kmp_system import LcNsKmpSystem


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

    def __init__(self, known: Known):
        super().__init__()
        skill, builder = skill_of(known), DiagramBuilder()
        action, _ = self._export_inputs(builder, skill)
        primitive = skill.primitive(history=False)
        gains = skill.null_space_gains(primitive)
        kmp = builder.AddNamedSystem("lc_ns_kmp", LcNsKmpSystem(primitive, gains, skill.control_period))
        builder.Connect(action, kmp.get_null_space_action_input_port())
        self._finish(builder, skill, kmp.get_output_output_port(), kmp.get_fallback_output_port())
