"""Guidance around a base policy, whose action chunks are a reference (KGRL, residual) or are executed with a guard."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, System
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain

from guiderail.diagrams.guidance.primitive import RESIDUAL, DemonstratedGuidance, PrimitiveGuidance, primitive_config_of
from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge, limits_per_output
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail_lerobot.base_policy import find_base_policy
from guiderail_lerobot.chunk_guard import ChunkGuard
from guiderail_lerobot.chunk_reference import ChunkReference
from guiderail_lerobot.chunk_safety_limiter import ChunkSafetyLimiter
from guiderail_lerobot.options import BasePolicyOptions, GuardOptions

LIMIT_FACTOR = 2.0  # default limits of a guard, relative to the largest speed and jerk of the demonstrations


def guard_limits(config: PrimitiveConfig, max_jerk: tuple[float, ...] = ()) -> tuple[np.ndarray, np.ndarray]:
    """Return the limits of velocity and jerk of a guard, (O,) each, in units of the outputs per s and s³.

    Args:
        config: Configuration with the demonstrations, for the default limits, and the speed limits.
        max_jerk: One limit for positions, two limits for positions and angles, or O limits. Outputs without a given
            limit have the default: angles if only one limit is given, and all outputs if it is ().

    Raises:
        InputError: If the motion has constraints other than linear bounds and speed limits, `max_jerk` has another
            number of entries, or outputs that the demonstrations do not move have no given limits.
    """
    outputs, motion, period = config.num_outputs, config.motion, config.control_period
    if motion is not None and (
        motion.outside or motion.state or np.isfinite(np.asarray(motion.max_acceleration)).any()
    ):
        raise InputError(
            "a guard limits only speed and jerk, within linear bounds: leave max_acceleration, "
            "joint_margin and shapes out"
        )
    limits = []
    for order in (1, 3):
        steps = np.abs(np.diff(config.reference.means, n=order, axis=0)).max(axis=0) / period**order
        groups = (steps[:3], steps[3:])
        limits.append(LIMIT_FACTOR * np.concatenate([np.full(len(group), group.max(initial=0.0)) for group in groups]))
    velocity, jerk = limits
    if motion is not None:
        speed = np.asarray(motion.max_speed, dtype=float)
        velocity = np.where(np.isfinite(speed), speed, velocity)
    if max_jerk:
        given = limits_per_output("max_jerk", max_jerk, outputs)
        jerk = np.where(np.isfinite(given), given, jerk)
    if unmoved := np.flatnonzero((velocity == 0.0) | (jerk == 0.0)).tolist():
        raise InputError(
            f"the demonstrations do not move the outputs {', '.join(map(str, unmoved))} and define no default limits "
            "for them: give max_speed and max_jerk for all outputs"
        )
    return velocity, jerk


class ChunkExecutionGuidance(DemonstratedGuidance):
    """Guidance that commands chunks, with a guard by default; the action has no effect.

    With a guard there is the output ``rate`` (1,) of `ChunkSafetyLimiter`. Without a guard (``guard=none``), the linear
    bounds are not enforced, and limits of the motion are refused.
    """

    def __init__(self, prior: PriorKnowledge, *, takes_window: bool = False):
        """Construct the guidance; with `takes_window`, the chunks come from the input ``reference_window``.

        Without this input, the chunks are parts of the demonstrations' mean.

        Raises:
            InputError: If the motion waits for the robot (``progress=state``), the guard does not support the limits
                and constraints, or limits are given without a guard.
        """
        super().__init__()
        config, options, builder = primitive_config_of(prior), prior.options, DiagramBuilder()
        if config.progress is not None:
            raise InputError("a base policy is driven by the clock: choose kgrl, skgrl or kmp for progress=state")
        _, pose = self._export_inputs(builder, config)
        outputs, points = config.num_outputs, config.horizon + 1
        is_guarded = options["guard"] != "none"
        # Not a Demultiplexer: Drake assumes that its output depends on time; see `add_demonstration`.
        means = np.eye(points * outputs if is_guarded else outputs, points * (outputs + outputs**2))
        chunk = builder.AddNamedSystem("chunk", MatrixGain(D=means))
        if takes_window:
            builder.ExportInput(chunk.get_input_port(), "reference_window")
        else:
            reference = add_system(builder, "reference", _chunk_reference(prior, None, outputs), observation=pose)
            builder.Connect(reference.get_reference_window_output_port(), chunk.get_input_port())
        if is_guarded:
            velocity, jerk = guard_limits(config, options["max_jerk"])
            guard = ChunkGuard(
                config.constraints,
                velocity,
                jerk,
                period=config.control_period,
                start=config.constraints.nearest(config.reference.means[0]),
                mode=options["guard"],
            )
            limiter = ChunkSafetyLimiter(guard, points, options["replan_steps"], config.control_period)
            add_system(builder, "chunk_safety_limiter", limiter, chunk=chunk.get_output_port(), pose=pose)
            builder.ExportOutput(limiter.get_rate_output_port(), "rate")
            desired, fallback = limiter.get_desired_pose_output_port(), limiter.get_fallback_output_port()
        else:
            if config.motion is not None or options["max_jerk"]:
                raise InputError(
                    "guard=none enforces no limits of the motion: choose another guard, or leave max_speed, "
                    "max_acceleration, max_jerk, joint_margin and shapes out"
                )
            never = builder.AddNamedSystem("fallback", ConstantVectorSource([0.0]))
            desired, fallback = chunk.get_output_port(), never.get_output_port()
        self._finish(builder, config, desired, fallback)


def _chunk_reference(prior: PriorKnowledge, source: str | None, observation_size: int) -> ChunkReference:
    config, options = primitive_config_of(prior), prior.options
    return ChunkReference(
        None if source is None else find_base_policy(source),
        observation_size,
        config.reference,
        horizon=config.horizon,
        replan_steps=options["replan_steps"],
        covariance_floor=options["covariance_floor"],
        period=config.control_period,
    )


class _BasePolicyReference:
    """Mixin of guidance that takes its reference from a base policy."""

    def __init__(self, prior: PriorKnowledge, **arguments: Any):
        self._prior = prior
        super().__init__(prior, **arguments, takes_window=True)  # type: ignore[call-arg]

    def make_reference(self, observation_size: int) -> System:
        return _chunk_reference(self._prior, self._prior.options["base_policy"], observation_size)


class BasePolicyPrimitiveGuidance(_BasePolicyReference, PrimitiveGuidance):
    """Guidance by a primitive with the chunks of a base policy as its mean."""


class BasePolicyGuidance(_BasePolicyReference, ChunkExecutionGuidance):
    """Guidance that commands the chunks of a base policy, with a guard by default."""


@register_guidance(
    "base_policy",
    needs=(("demonstrations",),),
    label="base policy",
    color="#7f7f7f",
    demonstrates=True,
    options=GuardOptions,
    ignores_actions=True,
)
def base_policy(prior: PriorKnowledge) -> Diagram:
    """Build guidance that executes a base policy's chunks, with a guard by default."""
    return BasePolicyGuidance(prior) if prior.options["base_policy"] else ChunkExecutionGuidance(prior)


@register_guidance(
    "kgrl_base_policy",
    needs=(("demonstrations",),),
    label="KGRL on a base policy",
    color="#17becf",
    demonstrates=True,
    options=BasePolicyOptions,
)
def kgrl_base_policy(prior: PriorKnowledge) -> Diagram:
    """Build KGRL around a base policy; no symmetry is used, because a base policy is not symmetric.

    The variance of the chunks is added to the covariance of the demonstrations.
    """
    return BasePolicyPrimitiveGuidance(prior) if prior.options["base_policy"] else PrimitiveGuidance(prior)


@register_guidance(
    "residual_base_policy",
    needs=(("demonstrations",),),
    label="residual RL on a base policy",
    color="#8c564b",
    demonstrates=True,
    options=BasePolicyOptions,
)
def residual_base_policy(prior: PriorKnowledge) -> Diagram:
    """Build residual RL around a base policy (Policy Decorator; Yuan et al., 2024), without constraints."""
    kind = BasePolicyPrimitiveGuidance if prior.options["base_policy"] else PrimitiveGuidance
    return kind(prior, **RESIDUAL)
