"""What can be chosen of the grid clamp, and what is chosen where it is hard."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

from pydantic import Field, field_validator

from guiderail.diagrams.options import Number, Numbers, Options
from guiderail.diagrams.stations.grid_clamp_workcell import GridClampWorkcell
from guiderail.models.objects.grid_clamp import GridClampDimensions
from guiderail.models.objects.grid_clamp_sdf import FRICTION
from guiderail.models.units import MM

# More than the cuboid lets the impedance push with: 6 mm below the seat and 8 mm beside, at 1500 N/m.
COLLISION_FORCE = 35.0  # [N], of the impedance
# The hand-designed skill before hands over a clamp above the hole, about here.
START_HEIGHT = (0.015, 0.018)  # [m]: the tips 3 to 6 mm above the table
HEIGHTS = (0.013, 0.060)  # [m] that it may begin at: above the table, and well inside the cuboid
DRAWN = GridClampDimensions()


class GridClampOptions(Options):
    """Of the clamp."""

    uncertainty: Literal["calibration", "disc", "known"] = Field(
        "calibration", description="where table and clamp may be"
    )
    start_height: Numbers = Field(
        START_HEIGHT, min_length=2, max_length=2, description="least and greatest height at which it begins [m]"
    )
    force_limit: Number = Field(COLLISION_FORCE, ge=8, le=60, description="more than that ends an episode [N]")
    seconds: Number = Field(10.0, ge=2, le=30, description="that an episode may take")
    hole_chamfer: Number = Field(DRAWN.hole_chamfer, ge=0.1 * MM, le=0.8 * MM, description="of the holes [m]")
    peg_chamfer: Number = Field(DRAWN.peg_chamfer, ge=0.1 * MM, le=0.8 * MM, description="of the pegs' tips [m]")
    clearance: Number = Field(
        DRAWN.clearance, ge=0.05 * MM, le=0.15 * MM, description="between a peg and its hole, on each side [m]"
    )
    friction: Number = Field(FRICTION, ge=0.05, le=0.4, description="of pegs, holes and table")

    @field_validator("start_height")
    @classmethod
    def _is_a_range(cls, value: tuple[float, ...]) -> tuple[float, ...]:
        if not HEIGHTS[0] <= value[0] <= value[1] <= HEIGHTS[1]:
            raise ValueError(f"give two heights from {HEIGHTS[0]} to {HEIGHTS[1]} m, the lower one first")
        return value

    def workcell(self) -> GridClampWorkcell:
        """The clamp and the table that are meant."""
        dimensions = replace(
            DRAWN.with_clearance(self.clearance), hole_chamfer=self.hole_chamfer, peg_chamfer=self.peg_chamfer
        )
        return GridClampWorkcell(dimensions, friction=self.friction)


HARD: dict[str, Any] = {"force_limit": 10.0}
"""The force limit is the difficulty: what comes down anywhere but in a hole, and goes on, has pushed too hard before it
has slid there by itself; the snap alone asks for six of the ten newtons."""
