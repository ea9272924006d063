"""The demonstrations alone: a kernelized movement primitive that no action moves (thesis, section 2.2.7)."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.guidance.known import Known
from guiderail.diagrams.guidance.primitive_guidance import PrimitiveGuidance, add_demonstration, skill_of
from guiderail.diagrams.guidance.registry import register_guidance


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

    def __init__(self, known: Known):
        super().__init__()
        skill, builder = skill_of(known), DiagramBuilder()
        action, _ = self._export_inputs(builder, skill)
        kmp = add_demonstration(builder, skill, action)
        self._finish(builder, skill, kmp.get_output_output_port(), kmp.get_fallback_output_port())
