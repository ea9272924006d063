"""Options that several tasks have; nothing here imports Drake."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field, ValidationInfo, field_validator

from guiderail.diagrams.envs.options import Number, Numbers, Pair, TaskOptions, increases, satisfies
from guiderail.models.common.transforms import DEGREE, MM, POSE_SIZE
from guiderail.models.primitives.reference import interpolate_prior

COLLISION_FORCE = 35.0  # contact force above which an episode ends [N]
MIN_CONTACT_FORCE = 0.5  # smallest force along z at which a center of pressure is computed [N]

# Scales of the observed center of pressure and of the observed command. The center of pressure, unlike the torque, does
# not increase with the contact force. The command is observed because the measured pose of a plug on a rim does not
# indicate the effect of an action.
CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE = 3.0 * MM, 2.0 * MM

# Variance ρ of the history [m², rad²]; the thesis's 1e-8, (0.1 mm)², is too large for demonstrations that vary by 1 mm.
HISTORY_VARIANCE = 1e-11

# Repeatability of a demonstrator's hand, as a standard deviation: x y z [m] and Rz Ry Rx [rad]. Its square is added to
# fitted variances.
REPEATABILITY_STD = (0.05 * MM, 0.05 * MM, 0.1 * MM, 0.2 * DEGREE, 0.05 * DEGREE, 0.05 * DEGREE)

NEGLIGIBLE_OFFSET = 0.3 * MM  # largest fixture offset with fixture_offset=none [m]
LARGEST_OFFSET = 4.0 * MM  # largest fixture offset [m]; beyond it the plug misses the rim of its socket
MAX_PRIOR_STD = np.array([0.05, 0.05, 0.05, 1.0, 1.0, 1.0])  # [m], [rad]; larger values are probably in mm or degrees
FORCE_LIMITS = (1.0, 60.0)  # smallest and largest force limit [N]


OffsetRange = Annotated[
    Pair,
    increases(0.0, LARGEST_OFFSET, f"give two distances from 0 to {LARGEST_OFFSET} m, the smaller one first"),
]
PriorStd = Annotated[
    Numbers,
    satisfies(
        lambda std: not (interpolate_prior(std, 101, POSE_SIZE) > MAX_PRIOR_STD).any(),
        f"give meters and radians, at most {MAX_PRIOR_STD[0]:g} m and {MAX_PRIOR_STD[-1]:g} rad",
    ),
]
ForceRange = Annotated[
    Pair,
    increases(
        *FORCE_LIMITS, f"give two forces from {FORCE_LIMITS[0]:g} to {FORCE_LIMITS[1]:g} N, the smaller one first"
    ),
]


class DemonstratedOptions(TaskOptions):
    """Options of `DemonstratedInsertion`."""

    reward: Literal["sparse", "shaped", "aligned"] = Field("sparse", description="name of the reward")
    observation: Literal["state", "center_of_pressure", "image", "image_and_state"] = Field(
        "state", description="name of the observation"
    )


class FixtureOffsetOptions(TaskOptions):
    """Options of a task whose fixture is offset from its nominal position."""

    fixture_offset: Literal["per_run", "per_episode", "none"] = Field(
        "per_run",
        description="offset of the fixture: sampled per run or per episode; none: at most 0.3 mm, sampled per episode",
    )
    offset_range: OffsetRange | None = Field(
        None, description="smallest and largest offset of the fixture [m]; default: depends on fixture_offset"
    )

    @field_validator("offset_range")
    @classmethod
    def _check_offset_range(cls, value: OffsetRange | None, info: ValidationInfo) -> OffsetRange | None:
        if value is not None and value[1] > NEGLIGIBLE_OFFSET and info.data.get("fixture_offset") == "none":
            raise ValueError(
                f"fixture_offset=none allows offsets up to {NEGLIGIBLE_OFFSET:g} m: choose fixture_offset=per_episode"
            )
        return value


class PriorOptions(TaskOptions):
    """Options of a task with recorded demonstrations of poses: several, or only one."""

    prior_std: PriorStd | None = Field(
        None,
        description="standard deviation around a single demonstration, required for one demonstration: x y z Rz Ry Rx "
        "[m], [rad], or rows of a phase from 0 to 1 and six such numbers; its square is added to the fitted variance",
        examples=[(0.002, 0.002, 0.0005, 0.02, 0.01, 0.01)],
    )


class ForceOptions(TaskOptions):
    """Options of a task with a force limit."""

    force_limit: Number = Field(
        COLLISION_FORCE,
        ge=FORCE_LIMITS[0],
        le=FORCE_LIMITS[1],
        description="force that ends an episode as a collision [N]",
    )
    force_limit_range: ForceRange | None = Field(
        None,
        description="range from which the force limit of every episode is sampled [N]; the policy observes the limit, "
        "except with observation=image; default: force_limit",
    )
    bounded_force: bool = Field(
        True,
        description="limit the force of the impedance so that it stays below force_limit; if false: to 40 N per axis",
    )

    @property
    def largest_force_limit(self) -> float:
        """Largest force limit of an episode [N]."""
        return self.force_limit if self.force_limit_range is None else self.force_limit_range[1]
