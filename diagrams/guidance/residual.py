"""Residual learning (thesis, section 4.4.1): a policy adds to a script, as far in every direction and at any time."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, PassThrough, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.primitive import PrimitiveGuidance, add_demonstration, skill_of
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.guidance.sct import ActiveConstraintFilter
from guiderail.models.common.poses import POSE_SIZE, WRENCH_SIZE
from guiderail.systems.residual import Residual
from guiderail.systems.safety_filter import SafetyFilter


class ResidualDescent(Guidance):
    """Residual learning without demonstrations: p̂_t = p_t + Δp_t, where p_t comes straight down.

    ``action`` is (3,); the command also respects the template's greatest speeds. Exports ``measured_violation`` too.
    """

    def __init__(self, known: PriorKnowledge):
        """
        Args:
            known: its approach, and a template whose active constraints are kept; that one has one object's frame, in
                which poses are given.
        """
        super().__init__()
        assert known.template is not None
        assert known.approach is not None
        placed, approach, period = known.template, known.approach, known.period
        template = placed.template if placed.constrained(True) else placed.template.without_active_constraints()
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(period, 3))
        times = [0.0, (approach.heights[0] - approach.heights[1]) / approach.speed]
        corners = np.zeros((POSE_SIZE, 2))
        corners[2] = approach.heights
        line = builder.AddNamedSystem("descent", TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, corners)))
        # Held: otherwise everything behind it would be computed anew at every step of the plant.
        held = builder.AddNamedSystem("descent_hold", ZeroOrderHold(period, POSE_SIZE))
        spread = builder.AddNamedSystem("spread", MatrixGain(D=np.eye(POSE_SIZE, 3)))
        residual = builder.AddNamedSystem("residual", Residual(np.array([approach.reach] * 3 + [0.0] * 3)))
        constraints = ActiveConstraintFilter(template, placed.frames, period)
        builder.AddNamedSystem("active_constraints", constraints)
        wrench = builder.AddNamedSystem("wrench", PassThrough(WRENCH_SIZE))
        builder.Connect(line.get_output_port(), held.get_input_port())
        builder.Connect(held.get_output_port(), residual.get_reference_input_port())
        builder.Connect(hold.get_output_port(), spread.get_input_port())
        builder.Connect(spread.get_output_port(), residual.get_action_input_port())
        builder.Connect(residual.get_desired_pose_output_port(), constraints.GetInputPort("requested_pose"))
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(constraints.GetInputPort("pose"), "pose")
        builder.ExportInput(wrench.get_input_port(), "wrench")
        builder.ExportOutput(hold.get_output_port(), "held_action")
        constraints.export_outputs(builder)
        builder.BuildInto(self)


class ResidualGuidance(PrimitiveGuidance):
    """Adds to the demonstrations: p̂_t = p_t^kmp + Δp_t."""

    def __init__(self, known: PriorKnowledge, *, safe: bool = False):
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
        builder.Connect(kmp.get_command_output_port(), residual.get_reference_input_port())
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
def residual(known: PriorKnowledge) -> Diagram:
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
def safe_residual(known: PriorKnowledge) -> Diagram:
    """Residual learning that stops before walls."""
    return ResidualGuidance(known, safe=True)
