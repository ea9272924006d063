"""Options that only some kinds of guidance have; this module does not import Drake."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field, field_validator

from guiderail.diagrams.envs.options import Integer, Number, Options, PositiveNumbers
from guiderail.models.policy import BASE_POLICIES, find_base_policy


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
        # A relative path would be wrong if the run is resumed from another folder.
        return value if value in BASE_POLICIES.names() else str(Path(value).resolve())


class GuardOptions(BasePolicyOptions):
    """Options of guidance of the kind `base_policy`, which executes the chunks."""

    guard: Literal["none", "projection", "slowdown"] = Field(
        "projection",
        description="filter that keeps chunks within the bounds, max_speed and max_jerk: projection to the nearest "
        "chunk, slowdown on the same path, or none",
    )
    max_jerk: PositiveNumbers = Field(
        (),
        description="largest jerk of a guarded command, in the form of max_speed; default of max_jerk and "
        "max_speed: twice the largest value in the demonstrations",
    )


class BarrierOptions(Options):
    """Options of `residual_cbf`."""

    barrier_decay: Number = Field(
        0.2, gt=0, le=1, description="γ, largest fraction of the distance to a constraint that one step may cover"
    )


class TangentOptions(Options):
    """Options of `residual_tangent`."""

    slack_width: Number = Field(
        0.5,
        gt=0,
        description="distance to a constraint at which motion towards it is halved, as a multiple of the "
        "displacement by an action of 1",
    )
