"""Options of Pouring, the overrides of difficulty="hard", and its templates."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import Field
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.options import Integer, Number, Numbers, Pair, ResetOptions, TaskOptions
from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.models.common.errors import InputError
from guiderail.models.objects.pouring import MUG, Ball
from guiderail.models.templates import SharedControlTemplate, load_template

FULL_SPEED = 0.15  # speed at an input of 1 along one axis [m/s]
FULL_TILT = 0.8  # tilting speed at an input of 1 [rad/s]
NO_FUNNEL = 0.24  # height of a funnel that has no effect, that of the template's ceiling [m]
# Default input_speed with the sparse reward, at which random inputs sometimes succeed.
SPARSE_INPUT_SPEED = 1.7


def make_template(
    config: PouringConfig,
    input_speed: float = 1.0,
    *,
    shield: bool = False,
    pour_distance: float | None = None,
    funnel: bool = True,
    **aiming: float,
) -> SharedControlTemplate:
    """Return the template for the vessels of `config`, with all speeds multiplied by `input_speed`.

    `aiming` is empty, or `aim_speed` and `pour_speed`, fractions of the full speeds. If they are given, inputs can aim
    the tip: in the state Pour, or with `shield` in a state before it. `pour_distance` (at which the state Pour begins,
    [m]) and `funnel` are those of the template without aiming.
    """
    changes = {} if pour_distance is None else {"near_m": pour_distance - config.mug.outer_radius}
    changes |= {} if funnel else {"funnel_m": NO_FUNNEL}
    return load_template(
        ("pouring_shielded" if shield else "pouring_aimed") if aiming else "pouring",
        **({} if aiming else changes),
        full_speed_m_per_s=input_speed * FULL_SPEED,
        full_tilt_rad_per_s=input_speed * FULL_TILT,
        mug_radius_m=config.mug.outer_radius,
        thermos_radius_m=config.thermos.outer_radius,
        **aiming,
    )


def frames_of(
    template: SharedControlTemplate, X_TMug: RigidTransform, X_TObserved: RigidTransform | None = None
) -> dict[str, RigidTransform]:
    """Return the poses of a template's objects for an actual or estimated pose X_TMug of the mug.

    X_TObserved is the pose of the mug that the policy observes, on which the shield depends; X_TMug by default.
    """
    if "behind_mug" not in template.frames:
        return {"mug_tip": X_TMug}
    frames = {"behind_mug": X_TMug @ RigidTransform([0.0, template.parameters["behind_m"], 0.0])}
    if "pour_line" in template.frames:
        frames["pour_line"] = (X_TMug if X_TObserved is None else X_TObserved) @ RigidTransform([*POUR_LINE, 0.0])
    return frames


POUR_LINE = (0.0, -0.035)  # [m] position of the tip in the mug's frame around which both balls fall into the mug
MAX_MUG_OFFSET = 0.04  # [m] largest mug offset along x and y; beyond it the arm reaches few of the starts
POSITION_SCALE = 5.0  # [1/m] scale of observed positions, which are then as large as observed angles near the mug
MAX_MUG_ERROR = 0.06  # [m] largest distance from the estimated mug position that aiming can reach

HARD: Mapping[str, Any] = {
    "aim": True,
    "mug_error_least": 0.035,
    "mug_error_most": 0.05,
    "mug_inner_diameter": 0.07,
    "time_limit": 6.0,
    "shield": True,
}
"""Options of difficulty="hard": the template uses an estimated mug position, whose error is sampled and observed.

Without the shield 26 % of the training episodes spill, and the policies pour in 87 to 99 % of the held-out episodes.
"""

THESIS: Mapping[str, Any] = {"input_speed": 0.25, "time_limit": 20.0, "pour_distance": 0.1, "funnel": False}
"""Options of difficulty="thesis": the pace of the thesis, and a template that does not lead to where pouring succeeds.

The 65 episodes of the thesis had 149 actions each on average.
At the standard speed, the scripted policy pours within 28 actions; at this speed within about 90. Uncorrelated random
inputs then move the thermos four times less, and a success needs four times as many actions in the right direction.
"""

MOST_BALLS = 8  # largest number of balls


class PouringOptions(TaskOptions):
    """Options of Pouring."""

    reward: Literal["shaped", "sparse", "hand_shaped"] = Field("shaped", description="name of the reward")
    balls: Integer = Field(2, ge=2, le=MOST_BALLS, description="number of balls")
    balls_in: Integer | None = Field(
        None, ge=1, le=MOST_BALLS, description="balls that have to be in the mug; default: all"
    )
    ball_diameter: Number = Field(Ball().diameter, ge=0.02, le=0.045, description="diameter of a ball [m]")
    input_speed: Number | None = Field(
        None,
        ge=0.2,
        le=2.0,
        description="factor of the template's input speed; default: 1, or 1.7 with the sparse reward",
    )
    mug_inner_diameter: Number = Field(MUG.inner_diameter, description="inner diameter of the mug [m]")
    mug_depth: Number = Field(MUG.depth, description="inner depth of the mug [m]")
    mug_offset: Number = Field(
        0.0, ge=0, le=MAX_MUG_OFFSET, description="largest sampled offset of the mug along x and y [m]"
    )
    mug_error_least: Number = Field(
        0.0,
        ge=0,
        le=MAX_MUG_ERROR,
        description="smallest sampled distance between actual and estimated mug position [m]",
    )
    mug_error_most: Number = Field(
        0.0,
        ge=0,
        le=MAX_MUG_ERROR,
        description="largest sampled distance between actual and estimated mug position [m]",
    )
    time_limit: Number = Field(15.0, ge=3.0, le=30.0, description="duration of an episode [s]")
    aim: bool = Field(
        False, description="let inputs aim the tip in the state Pour; observe the mug error and the template's state"
    )
    aim_speed: Number = Field(1.0, ge=0.1, le=1.0, description="fraction of the inputs' full speed while aiming")
    pour_speed: Number = Field(0.3, ge=0.1, le=1.0, description="fraction of the full tilting speed in Pour, with aim")

    pour_distance: Number | None = Field(
        None, ge=0.06, le=0.2, description="distance of the tips at which the template pours, without aim [m]"
    )
    funnel: bool = Field(True, description="lead the tip down to the mug's rim by a funnel, without aim")
    shield: bool = Field(False, description="allow to tilt only where the balls fall into the observed mug; needs aim")

    @property
    def needed(self) -> int:
        """Number of balls that have to be in the mug."""
        return self.balls if self.balls_in is None else self.balls_in

    @property
    def ball(self) -> Ball:
        """Ball: a shell with a mass proportional to its surface."""
        default = Ball()
        return replace(
            default, diameter=self.ball_diameter, mass=default.mass * (self.ball_diameter / default.diameter) ** 2
        )

    def check(self) -> None:
        """Check that the options are compatible.

        Raises:
            InputError: If `mug_error_least` is larger than `mug_error_most`, `balls_in` is larger than `balls`, the
                balls do not fit into the thermos, or `shield` is set without `aim`.
        """
        if self.shield and not self.aim:
            raise InputError("the option shield needs the option aim: give aim=true too")
        if self.needed > self.balls:
            raise InputError(f"balls_in must be at most balls, which is {self.balls}, not {self.needed}: give both")
        top = PouringConfig(ball=self.ball, num_balls=self.balls).stack()[-1, 2] + 0.5 * self.ball_diameter
        if top > 0.0:
            raise InputError(
                f"{self.balls} balls of {self.ball_diameter:g} m do not fit into the thermos: choose fewer balls, or "
                "smaller balls, such as ball_diameter=0.026"
            )
        if self.mug_error_least > self.mug_error_most:
            raise InputError(
                f"mug_error_least must be at most mug_error_most, which is {self.mug_error_most:g} m, "
                f"not {self.mug_error_least:g} m: give both"
            )


class PouringReset(ResetOptions):
    """Options of a reset of Pouring."""

    start: Annotated[Numbers, Len(3, 3)] | None = Field(
        None, description="(x, y, z) of the upright thermos's tip in the frame of the estimated mug [m]"
    )
    mug_position: Pair | None = Field(
        None, description="(x, y) of the estimated mug position relative to its nominal position [m]"
    )
    mug_error: Pair | None = Field(None, description="(x, y) from the actual to the estimated mug position [m]")
