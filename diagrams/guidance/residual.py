"""Residual RL (thesis, section 4.4.1): actions are added to a motion, with constant gains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.primitive import (
    PrimitiveGuidance,
    add_demonstration,
    primitive_config_of,
    refuse_limits,
)
from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.guidance.sct import ActiveConstraintFilter
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.control.command_filters import BarrierFilter, TangentSpaceFilter
from guiderail.models.control.keep_out import KeepOut
from guiderail.systems.command_filter import CommandFilter
from guiderail.systems.residual import Residual
from guiderail.systems.safety_filter import SafetyFilter

BARRIER_DECAY = 0.2  # γ of `residual_cbf`, largest fraction of the distance to a constraint that one step may cover
# Distance to a constraint at which `residual_tangent` halves the motion towards it, as a multiple of the displacement
# by an action of 1.
SLACK_WIDTH = 0.5


class ResidualDescent(Guidance):
    """Residual RL without demonstrations: p̂_t = p_t + Δp_t, where p_t is a straight descent.

    ``action`` is (3,); the command also respects the template's speed limits. In addition to the ports of all guidance
    there are ``state``, ``transition_distance``, ``progress`` and ``measured_violation``, all (1,).
    """

    def __init__(self, prior: PriorKnowledge):
        """Construct the guidance from an approach and the active constraints of a template.

        All poses are in the frame of the template's only object.
        """
        super().__init__()
        assert prior.template is not None
        assert prior.approach is not None
        placed, approach, period = prior.template, prior.approach, prior.period
        template = placed.template if placed.is_constrained(True) else placed.template.without_active_constraints()
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(period, 3))
        times = [0.0, (approach.heights[0] - approach.heights[1]) / approach.speed]
        corners = np.zeros((POSE_SIZE, 2))
        corners[2] = approach.heights
        line = builder.AddNamedSystem("descent", TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, corners)))
        # Without this hold, all systems after it would be computed again at every step of the plant.
        descent = add_system(builder, "descent_hold", ZeroOrderHold(period, POSE_SIZE), line.get_output_port())
        spread = add_system(builder, "spread", MatrixGain(D=np.eye(POSE_SIZE, 3)), hold.get_output_port())
        residual = Residual(np.array([approach.reach] * 3 + [0.0] * 3))
        add_system(builder, "residual", residual, reference=descent.get_output_port(), action=spread.get_output_port())
        constraints = ActiveConstraintFilter(template, placed.frames, period)
        requested_pose = residual.get_desired_pose_output_port()
        add_system(builder, "active_constraints", constraints, requested_pose=requested_pose)
        constraints.export_ports(builder, hold)
        builder.BuildInto(self)


class ResidualGuidance(PrimitiveGuidance):
    """Residual RL with demonstrations: p̂_t = p_t^kmp + Δp_t.

    Shapes in the motion constraints are not enforced; limits of speed, acceleration and joints are refused.
    """

    def __init__(
        self,
        prior: PriorKnowledge,
        make_filter: Callable[[PrimitiveConfig, KeepOut], Any] | None = None,
        *,
        takes_window: bool = False,
    ):
        """Construct the guidance.

        Args:
            prior: Prior knowledge.
            make_filter: Function of the primitive's configuration and the keep-out walls that returns a `SafetyFilter`
                or `CommandFilter` of the sum p̂_t; None: no filter. ``fallback`` is 1 while the filter changes the sum.
            takes_window: True if the motion p_t^kmp is the input ``reference_window`` instead of the demonstrations.

        Raises:
            InputError: If the motion waits for the robot (``progress=state``), or limits of its speed, acceleration or
                joints are given.
        """
        super().__init__()
        config, builder = primitive_config_of(prior), DiagramBuilder()
        if config.progress is not None:
            raise InputError("residual guidance is driven by the clock: choose kgrl, skgrl or kmp for progress=state")
        refuse_limits(config)
        action, pose = self._export_inputs(builder, config)
        kmp = add_demonstration(builder, config, action, takes_window=takes_window)
        residual = Residual(config.residual_gains())
        add_system(builder, "residual", residual, reference=kmp.get_command_output_port(), action=action)
        desired, fallback = residual.get_desired_pose_output_port(), kmp.get_fallback_output_port()
        if make_filter is not None:
            assert config.keep_out is not None
            safety = make_filter(config, config.keep_out)
            add_system(builder, "safety_filter", safety, desired_pose=desired, pose=pose)
            desired, fallback = safety.get_safe_pose_output_port(), safety.get_intervention_output_port()
        self._finish(builder, config, desired, fallback)


@register_guidance(
    "residual",
    needs=(("demonstrations",), ("approach", "template")),
    label="residual RL",
    color="#d62728",
    demonstrates=True,
    displaces=True,
)
def residual(prior: PriorKnowledge) -> Diagram:
    """Build residual RL with demonstrations, or with a scripted approach and active constraints."""
    return ResidualGuidance(prior) if prior.primitive is not None else ResidualDescent(prior)


@register_guidance(
    "safe_residual",
    needs=(("demonstrations", "keep_out"),),
    label="safe residual RL",
    color="#ff7f0e",
    demonstrates=True,
    displaces=True,
)
def safe_residual(prior: PriorKnowledge) -> Diagram:
    """Build residual RL with a filter that projects the command and stops it at walls; see `SafetyFilter`."""
    return ResidualGuidance(prior, lambda config, keep_out: SafetyFilter(keep_out, config.control_period))


@register_guidance(
    "residual_cbf",
    needs=(("demonstrations", "keep_out"),),
    label="residual RL, barrier function",
    color="#bcbd22",
    demonstrates=True,
    displaces=True,
)
def residual_cbf(prior: PriorKnowledge) -> Diagram:
    """Build residual RL with a control barrier function on the command; see `BarrierFilter`."""
    return ResidualGuidance(
        prior, lambda config, keep_out: CommandFilter(BarrierFilter(keep_out, BARRIER_DECAY), config.control_period)
    )


@register_guidance(
    "residual_tangent",
    needs=(("demonstrations", "keep_out"),),
    label="residual RL, tangent space",
    color="#7f7f7f",
    demonstrates=True,
    displaces=True,
)
def residual_tangent(prior: PriorKnowledge) -> Diagram:
    """Build residual RL in the tangent space of the constraints; see `TangentSpaceFilter`."""

    def make_filter(config: PrimitiveConfig, keep_out: KeepOut) -> CommandFilter:
        width = SLACK_WIDTH * float(config.residual_gains().max())
        return CommandFilter(TangentSpaceFilter(keep_out, width), config.control_period)

    return ResidualGuidance(prior, make_filter)
