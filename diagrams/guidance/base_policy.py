"""Guidance around a base policy: KGRL and residual learning whose reference is the policy's chunks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import Field, field_validator
from pydrake.systems.framework import Diagram, System

from guiderail.diagrams.envs.options import Integer, Number, Options
from guiderail.diagrams.guidance.primitive import KgrlGuidance, primitive_config_of
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.guidance.residual import ResidualGuidance
from guiderail.models.policy import BASE_POLICIES, find_base_policy
from guiderail.systems.chunk_reference import ChunkReference


class BasePolicyOptions(Options):
    """Options of guidance around a base policy."""

    base_policy: str = Field(
        "",
        description="base policy: folder of a run of the learner chunk, or a registered name; default: the "
        "demonstrations, as without a base policy",
    )
    replan_steps: Integer = Field(5, ge=1, le=1000, description="control steps between two chunks")
    covariance_floor: Number = Field(
        1.0, gt=0, description="share of the demonstrations' covariance that is added to the spread of the chunks"
    )

    @field_validator("base_policy")
    @classmethod
    def _check_source(cls, value: str) -> str:
        if not value:
            return value
        find_base_policy(value)
        # A run can be resumed from another folder.
        return value if value in BASE_POLICIES.names() else str(Path(value).resolve())


class _ChunkGuidance:
    """Mixin of guidance that takes its reference from a base policy."""

    def __init__(self, prior: PriorKnowledge, **arguments: Any):
        self._prior = prior
        super().__init__(prior, **arguments, takes_window=True)  # type: ignore[call-arg]

    def make_reference(self, observation_size: int) -> System:
        config, options = primitive_config_of(self._prior), self._prior.options
        return ChunkReference(
            find_base_policy(options["base_policy"]),
            observation_size,
            config.reference,
            horizon=config.horizon,
            replan_steps=options["replan_steps"],
            covariance_floor=options["covariance_floor"],
            period=config.control_period,
        )


class KgrlBasePolicyGuidance(_ChunkGuidance, KgrlGuidance):
    """KGRL whose mean is the chunk of a base policy, and whose covariance is widened by the chunks' spread."""


class ResidualBasePolicyGuidance(_ChunkGuidance, ResidualGuidance):
    """Bounded residual on a base policy (Policy Decorator; Yuan et al., 2024): p̂_t = p_t^base + Δp_t."""


@register_guidance(
    "kgrl_base_policy",
    needs=(("demonstrations",),),
    label="KGRL on a base policy",
    color="#17becf",
    demonstrates=True,
    options=BasePolicyOptions,
)
def kgrl_base_policy(prior: PriorKnowledge) -> Diagram:
    """Build KGRL around a base policy; no symmetry is used, because a base policy has none."""
    return KgrlBasePolicyGuidance(prior) if prior.options["base_policy"] else KgrlGuidance(prior)


@register_guidance(
    "residual_base_policy",
    needs=(("demonstrations",),),
    label="residual RL on a base policy",
    color="#8c564b",
    demonstrates=True,
    options=BasePolicyOptions,
)
def residual_base_policy(prior: PriorKnowledge) -> Diagram:
    """Build residual learning around a base policy, without constraints."""
    return ResidualBasePolicyGuidance(prior) if prior.options["base_policy"] else ResidualGuidance(prior)
