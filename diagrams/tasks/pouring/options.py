"""What pouring can be asked for, and what is hard about it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from pydantic import Field
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.options import Integer, Number, Numbers, Options, ResetOptions
from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.models.common.errors import InputError
from guiderail.models.objects.pouring.vessels import MUG, Ball
from guiderail.models.templates import SharedControlTemplate, load_template

FULL_SPEED = 0.15  # [m/s] of a full input, along one axis
FULL_TILT = 0.8  # [rad/s]
# What is rewarded only once it is done is found only if random inputs sometimes do it.
SPARSE_INPUT_SPEED = 1.7


def make_template(config: PouringConfig, input_speed: float = 1.0) -> SharedControlTemplate:
    """The pouring template for this scene's vessels; `input_speed` times as fast as it is meant."""
    return _load("pouring", config, input_speed)


def make_aimed_template(
    config: PouringConfig, input_speed: float, aim_speed: float, pour_speed: float
) -> SharedControlTemplate:
    """The template whose Pour can be aimed; `aim_speed` and `pour_speed` are parts of the full speeds in Pour."""
    return _load("pouring_aimed", config, input_speed, aim_speed=aim_speed, pour_speed=pour_speed)


def _load(name: str, config: PouringConfig, input_speed: float, **others: float) -> SharedControlTemplate:
    return load_template(
        name,
        full_speed_m_per_s=input_speed * FULL_SPEED,
        full_tilt_rad_per_s=input_speed * FULL_TILT,
        mug_radius_m=config.mug.outer_radius,
        thermos_radius_m=config.thermos.outer_radius,
        **others,
    )


def frames_of(template: SharedControlTemplate, X_TMug: RigidTransform) -> dict[str, RigidTransform]:
    """The poses of a template's objects for a mug, or for where it is believed to be."""
    if "behind_mug" in template.frames:
        return {"behind_mug": X_TMug @ RigidTransform([0.0, template.parameters["behind_m"], 0.0])}
    return {"mug_tip": X_TMug}


MAX_MUG_OFFSET = 0.04  # [m] along x and y: farther off the arm would reach few of the starts
POSITION_SCALE = 5.0  # [1/m] makes positions near the mug as large as angles in the observation
MAX_MUG_ERROR = 0.06  # [m] as far as an aimed Pour leads from where the mug is believed

HARD: Mapping[str, Any] = {
    "aim": True,
    "mug_error_least": 0.035,
    "mug_error_most": 0.05,
    "mug_inner_diameter": 0.07,
    "time_limit": 6.0,
}
"""The mug stands elsewhere than the template believes, anew every episode, and whoever pours has to see that."""


MOST_BALLS = 8


class PouringOptions(Options):
    """Of pouring."""

    balls: Integer = Field(2, ge=2, le=MOST_BALLS, description="how many are poured")
    balls_in: Integer | None = Field(
        None, ge=1, le=MOST_BALLS, description="how many of them have to be in the mug; all of them unless given"
    )
    ball_diameter: Number = Field(Ball().diameter, ge=0.02, le=0.045, description="[m]")
    input_speed: Number | None = Field(
        None, ge=0.2, le=2.0, description="how much faster the template's inputs are; 1, and 1.7 where sparse, if None"
    )
    mug_inner_diameter: Number = Field(MUG.inner_diameter, description="of the mug that stands there [m]")
    mug_depth: Number = Field(MUG.depth, description="[m]")
    mug_offset: Number = Field(
        0.0, ge=0, le=MAX_MUG_OFFSET, description="up to which the mug is moved along x and y at every reset [m]"
    )
    mug_error_least: Number = Field(
        0.0, ge=0, le=MAX_MUG_ERROR, description="least distance from the mug to where it is believed to be [m]"
    )
    mug_error_most: Number = Field(
        0.0, ge=0, le=MAX_MUG_ERROR, description="largest one; distance and direction are drawn at every reset [m]"
    )
    time_limit: Number = Field(15.0, ge=3.0, le=30.0, description="after which an episode ends [s]")
    aim: bool = Field(False, description="whether Pour can be aimed; the policy then sees error and template's state")
    aim_speed: Number = Field(
        1.0, ge=0.1, le=1.0, description="part of the inputs' full speed with which Pour is aimed"
    )
    pour_speed: Number = Field(0.3, ge=0.1, le=1.0, description="part of the full tilt's with which an aimed Pour tips")

    @property
    def needed(self) -> int:
        """How many balls have to be in the mug."""
        return self.balls if self.balls_in is None else self.balls_in

    @property
    def ball(self) -> Ball:
        """Each of them: a shell, whose mass grows with its surface."""
        usual = Ball()
        return replace(usual, diameter=self.ball_diameter, mass=usual.mass * (self.ball_diameter / usual.diameter) ** 2)

    def check(self) -> None:
        """Refuses numbers that don't go together.

        Raises:
            InputError: if the least error is larger than the largest one, more balls have to be in than there are, or
                they don't go into the thermos.
        """
        if self.needed > self.balls:
            raise InputError(f"balls_in must be at most balls, which is {self.balls}, not {self.needed}: give both")
        top = PouringConfig(ball=self.ball, num_balls=self.balls).stack()[-1, 2] + 0.5 * self.ball_diameter
        if top > 0.0:
            raise InputError(
                f"{self.balls} balls of {self.ball_diameter:g} m don't go into the thermos: take fewer, or smaller "
                "ones such as ball_diameter=0.026"
            )
        if self.mug_error_least > self.mug_error_most:
            raise InputError(
                f"mug_error_least must be at most mug_error_most, which is {self.mug_error_most:g} m, "
                f"not {self.mug_error_least:g} m: give both"
            )


class PouringReset(ResetOptions):
    """Of a reset of pouring."""

    start: Numbers | None = Field(
        None,
        min_length=3,
        max_length=3,
        description="(x, y, z) [m] of the upright thermos's tip in the frame of the mug, where that is believed to be",
    )
    mug_position: Numbers | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="(x, y) [m] of the mug, where that is believed to be, from where it nominally stands",
    )
    mug_error: Numbers | None = Field(
        None, min_length=2, max_length=2, description="(x, y) [m] from the mug to where it is believed to be"
    )
