"""What the narrow passage can be asked for, and what is hard about it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import Field

from guiderail.diagrams.options import Number, Numbers, Options, ResetOptions
from guiderail.models.objects.narrow_passage import NarrowPassage

USUAL = NarrowPassage()
# Half way through the wide part behind the passage, on the demonstrations' mean.
SECOND_OBSTACLE = (0.446, 0.78)

HARD: Mapping[str, Any] = {
    "gap_width": 0.03,
    "obstacle_radius": 0.08,
    "second_obstacle": True,
    "obstacle_beside": 0.075,
    "obstacles_end": True,
    "start_deviation": 0.03,
}
"""A passage half as wide, and a slalom around two obstacles that may not be touched: from left or right, as drawn."""


class NarrowPassageOptions(Options):
    """Of the passage."""

    gap_width: Number = Field(
        round(USUAL.gap_x[1] - USUAL.gap_x[0], 9), ge=0.02, le=0.2, description="of the passage, for the centre [m]"
    )
    obstacle_radius: Number = Field(USUAL.obstacle_radius, ge=0.01, le=0.1, description="of the obstacles [m]")
    second_obstacle: bool = Field(False, description="whether there is another obstacle behind the passage")
    obstacle_beside: Number = Field(
        0.0,
        ge=0,
        le=0.1,
        description="how far beside their places obstacles stand, in turn left and right, as drawn [m]",
    )
    obstacles_end: bool = Field(False, description="whether touching an obstacle ends an episode, as a collision")
    start_deviation: Number = Field(
        0.0, ge=0, le=0.05, description="standard deviation of every start along x and y; 0: of held-out ones alone [m]"
    )

    @property
    def drawn(self) -> bool:
        """Whether a reset says where the obstacles are; otherwise there is the usual one, which only costs."""
        return self.obstacle_beside > 0 or self.obstacles_end or self.second_obstacle

    def world(self) -> NarrowPassage:
        """Where things usually are with these options."""
        middle = 0.5 * (USUAL.gap_x[0] + USUAL.gap_x[1])
        default = self.gap_width == type(self).model_fields["gap_width"].default
        half = 0.5 * self.gap_width
        return NarrowPassage(
            gap_x=USUAL.gap_x if default else (middle - half, middle + half),
            obstacle_radius=self.obstacle_radius,
            second_obstacle=SECOND_OBSTACLE if self.second_obstacle else None,
            obstacles_move=self.drawn,
        )


class NarrowPassageReset(ResetOptions):
    """Of a reset of the passage."""

    start: Numbers | None = Field(
        None, min_length=2, max_length=2, description="(x, y) [m] to start from, instead of where the demonstrations do"
    )
