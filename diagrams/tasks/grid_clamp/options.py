"""Options of GridClamp, and the overrides of difficulty="hard"."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from guiderail.diagrams.envs.options import Number, Pair, increases
from guiderail.diagrams.tasks.options import FORCE_LIMITS, ForceOptions
from guiderail.models.common.transforms import MM
from guiderail.models.objects.grid_clamp import FRICTION, GridClampDimensions

# Contact force above which an episode ends [N]. An unbounded impedance of 1500 N/m does not reach this force: the
# template's cuboid is 8 mm wide, and ends 6 mm below the target and 18 mm below a clamp on the table.
COLLISION_FORCE = 35.0
START_HEIGHT = (0.015, 0.018)  # [m] default: the preceding skill ends with the pegs' tips 3 to 6 mm above the table
HEIGHTS = (0.013, 0.060)  # [m] accepted start heights: above the table, and well inside the cuboid
NOMINAL = GridClampDimensions()
StartHeight = Annotated[
    Pair, increases(*HEIGHTS, f"give two heights from {HEIGHTS[0]} to {HEIGHTS[1]} m, the lower one first")
]


class GridClampOptions(ForceOptions):
    """Options of GridClamp."""

    reward: Literal["shaped", "no_force", "sparse", "aligned"] = Field("shaped", description="name of the reward")
    fixture_offset: Literal["per_run", "per_episode", "none"] = Field(
        "per_run", description="offsets of table and clamp: sampled per run or per episode; none: clamp within 0.15 mm"
    )
    start_height: StartHeight = Field(START_HEIGHT, description="smallest and largest start height [m]")
    force_limit: Number = Field(
        COLLISION_FORCE, ge=8, le=FORCE_LIMITS[1], description="force that ends an episode as a collision [N]"
    )
    seconds: Number = Field(10.0, ge=2, le=30, description="duration of an episode [s]")
    hole_chamfer: Number = Field(NOMINAL.hole_chamfer, ge=0.1 * MM, le=0.8 * MM, description="chamfer of the holes [m]")
    peg_chamfer: Number = Field(
        NOMINAL.peg_chamfer, ge=0.1 * MM, le=0.8 * MM, description="chamfer of the pegs' tips [m]"
    )
    clearance: Number = Field(
        NOMINAL.clearance,
        ge=0.05 * MM,
        le=0.15 * MM,
        description="clearance between a peg and its hole on each side [m]",
    )
    friction: Number = Field(FRICTION, ge=0.05, le=0.4, description="friction coefficient of pegs, holes and table")


HARD: dict[str, Any] = {"force_limit": 10.0, "seconds": 6.0}
"""Options of difficulty="hard": a short time limit, and a force limit of 10 N; snapping in needs 6 N.

The impedance's force is bounded below the limit, so that an untrained policy fails by the time limit and not by a
collision. On the gantry with exact sensors, random actions succeed in half of the episodes, and the scripted search in
98 % (docs/results/grid_clamp.md).
"""
