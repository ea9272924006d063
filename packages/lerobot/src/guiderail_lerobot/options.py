"""Options of guidance around a base policy."""

from collections.abc import Hashable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, field_validator
from typing_extensions import override

from guiderail.diagrams.envs.options import Integer, Number, Options, PositiveNumbers, entries_of
from guiderail_lerobot.base_policy import BASE_POLICIES, add_base_policy, base_policy_key, find_base_policy


class BasePolicyOptions(Options):
    """Options of guidance around a base policy."""

    entries: ClassVar[Mapping[str, str]] = entries_of(
        "base_policy", "replan_steps", "covariance_floor", "guard", "max_jerk"
    )

    base_policy: str = Field(
        "",
        description="base policy: folder of a run of the learner chunk, or a registered name; default: none, and the "
        "guidance is built from the demonstrations",
    )
    replan_steps: Integer = Field(5, ge=1, le=1000, description="control steps between two predictions of a chunk")
    covariance_floor: Number = Field(
        1.0, gt=0, description="multiple of the demonstrations' covariance that is added to the chunks' variance"
    )

    @field_validator("base_policy")
    @classmethod
    def _check_source(cls, value: str) -> str:
        if not value:
            return value
        if (name := add_base_policy(value)) in BASE_POLICIES.names():
            return name
        find_base_policy(value)
        # A relative path would be wrong if the run is resumed from another folder.
        return str(Path(value).resolve())

    @override
    @classmethod
    def diagram_key(cls, options: Mapping[str, Any]) -> Hashable:
        """Return a key that changes if another policy replaces the base policy."""
        return base_policy_key(options["base_policy"])


class GuardOptions(BasePolicyOptions):
    """Options of the guidance `base_policy`, which executes a base policy's chunks."""

    guard: Literal["none", "projection", "slowdown"] = Field(
        "projection",
        description="filter that keeps chunks within the bounds, max_speed and max_jerk: projection to the nearest "
        "chunk, slowdown on the same path, or none",
    )
    max_jerk: PositiveNumbers = Field(
        (),
        description="largest jerk of a command behind the guard, in the form of max_speed; if max_jerk or max_speed "
        "is not given: twice the largest value in the demonstrations",
    )
