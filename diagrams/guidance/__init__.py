"""Guidance: what stands between a policy's action and the pose that a robot is commanded.

All guidance has the inputs `action`, `pose`, `wrench` and the outputs `desired_pose` and `fallback`, so that it can be
exchanged without touching anything else.
"""

from typing import TYPE_CHECKING

from guiderail.models.errors import InputError

if TYPE_CHECKING:
    from pydrake.systems.framework import Diagram

    from guiderail.diagrams.guidance.primitive_skill import PrimitiveSkill

GUIDANCE = ("none", "sct", "kmp", "residual", "safe_residual", "kgrl", "skgrl")
"""Every kind of guidance; which of them make sense depends on what is known about the task."""

PRIMITIVE_GUIDANCE = ("kmp", "residual", "safe_residual", "kgrl", "skgrl")
"""The kinds that are made of demonstrations."""


def check_guidance(kind: str, sensible: tuple[str, ...], task: str = "this task") -> None:
    """Refuses a kind of guidance that doesn't exist or makes no sense for a task.

    Raises:
        InputError: naming those that do make sense.
    """
    if kind in sensible:
        return
    names = ", ".join(sensible)
    if kind not in GUIDANCE:
        raise InputError(f"there is no guidance '{kind}': {task} can be guided by {names}")
    raise InputError(f"guidance '{kind}' needs something that nobody wrote down for {task}: use {names}")


def build_guidance(kind: str, skill: "PrimitiveSkill", task: str = "this task") -> "Diagram":
    """The guidance of a kind, made of a skill learned from demonstrations.

    Raises:
        InputError: if there is no such kind, or the skill lacks what it needs.
    """
    from guiderail.diagrams.guidance import primitive_guidance as made_of_primitive

    builders = {
        "kmp": made_of_primitive.KmpGuidance,
        "residual": made_of_primitive.ResidualGuidance,
        "safe_residual": lambda skill: made_of_primitive.ResidualGuidance(skill, safe=True),
        "kgrl": made_of_primitive.KgrlGuidance,
        "skgrl": made_of_primitive.SkgrlGuidance,
    }
    if skill.keep_out is None:
        del builders["safe_residual"]
    check_guidance(kind, tuple(builders), task)
    return builders[kind](skill)
