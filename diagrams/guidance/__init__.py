"""Guidance: what stands between a policy's action and the pose that a robot is commanded."""

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.known import Approach, Known, Template
from guiderail.diagrams.guidance.primitive_skill import PrimitiveSkill
from guiderail.diagrams.guidance.registry import GUIDANCE, GuidanceKind, build_guidance, register_guidance

__all__ = [
    "GUIDANCE",
    "Approach",
    "Guidance",
    "GuidanceKind",
    "Known",
    "PrimitiveSkill",
    "Template",
    "build_guidance",
    "register_guidance",
]
