"""Residual learning (thesis, section 4.4.1): a policy adds to a script, as far in every direction and at any time."""

from __future__ import annotations

from pydrake.systems.framework import Diagram, DiagramBuilder

from guiderail.diagrams.guidance.known import Known
from guiderail.diagrams.guidance.primitive_guidance import PrimitiveGuidance, add_demonstration, skill_of
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.guidance.residual_descent import ResidualDescent
from guiderail.systems.residual import Residual
from guiderail.systems.safety_filter import SafetyFilter


class ResidualGuidance(PrimitiveGuidance):
    """Adds to the demonstrations: p̂_t = p_t^kmp + Δp_t."""

    def __init__(self, known: Known, *, safe: bool = False):
        """
        Args:
            known: with demonstrations; with `safe`, also what to keep away from.
            safe: True puts hand-made active constraints behind the sum; ``fallback`` is then 1 where a wall was in
                the way.
        """
        super().__init__()
        skill, builder = skill_of(known), DiagramBuilder()
        action, pose = self._export_inputs(builder, skill)
        kmp = add_demonstration(builder, skill, action)
        residual = builder.AddNamedSystem("residual", Residual(skill.residual_gains()))
        builder.Connect(kmp.get_output_output_port(), residual.get_reference_input_port())
        builder.Connect(action, residual.get_action_input_port())
        desired, fallback = residual.get_desired_pose_output_port(), kmp.get_fallback_output_port()
        if safe:
            assert skill.keep_out is not None
            safety = builder.AddNamedSystem("safety_filter", SafetyFilter(skill.keep_out, skill.control_period))
            builder.Connect(desired, safety.get_desired_pose_input_port())
            builder.Connect(pose, safety.get_pose_input_port())
            desired, fallback = safety.get_safe_pose_output_port(), safety.get_intervention_output_port()
        self._finish(builder, skill, desired, fallback)


@register_guidance(
    "residual",
    needs=(("demonstrations",), ("approach", "template")),
    label="residual RL",
    colour="#d62728",
    demonstrates=True,
    displaces=True,
)
def residual(known: Known) -> Diagram:
    """Adds to the demonstrations, or to a scripted approach behind a template's active constraints."""
    return ResidualGuidance(known) if known.demonstrations is not None else ResidualDescent(known)


@register_guidance(
    "safe_residual",
    needs=(("demonstrations", "keep_out"),),
    label="safe residual RL",
    colour="#ff7f0e",
    demonstrates=True,
    displaces=True,
)
def safe_residual(known: Known) -> Diagram:
    """Residual learning that stops before walls."""
    return ResidualGuidance(known, safe=True)
