"""Options of NarrowPassage, and the overrides of difficulty="hard"."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field

from guiderail.diagrams.envs.options import Number, TaskOptions
from guiderail.models.objects.narrow_passage import PassageGeometry

DEFAULT_GEOMETRY = PassageGeometry()
SECOND_OBSTACLE = (0.446, 0.78)  # [m] center, on the mean demonstration, midway between the gap and the goal
HARD: Mapping[str, Any] = {
    "gap_width": 0.03,
    "obstacle_radius": 0.08,
    "second_obstacle": True,
    "obstacle_beside": 0.075,
    "obstacles_end": True,
    "start_deviation": 0.03,
}
"""Options of difficulty="hard": half the gap width, and two obstacles on sampled sides that must not be touched."""


class NarrowPassageOptions(TaskOptions):
    """Options of NarrowPassage."""

    reward: Literal["sparse", "shaped"] = Field("sparse", description="name of the reward")
    observation: Literal["state", "image"] = Field("state", description="name of the observation")

    gap_width: Number = Field(
        round(DEFAULT_GEOMETRY.gap_x[1] - DEFAULT_GEOMETRY.gap_x[0], 9),
        ge=0.02,
        le=0.2,
        description="width of the gap for the robot's center [m]",
    )
    obstacle_radius: Number = Field(
        DEFAULT_GEOMETRY.obstacle_radius, ge=0.01, le=0.1, description="radius of the obstacles [m]"
    )
    second_obstacle: bool = Field(False, description="add an obstacle between the gap and the goal")
    obstacle_beside: Number = Field(
        0.0,
        ge=0,
        le=0.1,
        description="offset of the obstacles along x [m], alternately to the left and right; the first side is sampled",
    )
    obstacles_constrain: bool = Field(
        False,
        description="keep every command of a primitive outside of the fixed obstacle; not supported with "
        "second_obstacle, obstacle_beside or obstacles_end",
    )
    obstacles_end: bool = Field(False, description="end the episode as a collision when an obstacle is touched")
    start_deviation: Number = Field(
        0.0,
        ge=0,
        le=0.05,
        description="standard deviation of the start along x and y [m]; 0: only held-out starts vary",
    )

    @property
    def has_sampled_obstacles(self) -> bool:
        """True if a reset sets the obstacles; otherwise there is one fixed obstacle, which does not end the episode."""
        return self.obstacle_beside > 0 or self.obstacles_end or self.second_obstacle

    @property
    def geometry(self) -> PassageGeometry:
        """Nominal geometry with these options."""
        middle = 0.5 * (DEFAULT_GEOMETRY.gap_x[0] + DEFAULT_GEOMETRY.gap_x[1])
        is_default = self.gap_width == type(self).model_fields["gap_width"].default
        half = 0.5 * self.gap_width
        return PassageGeometry(
            gap_x=DEFAULT_GEOMETRY.gap_x if is_default else (middle - half, middle + half),
            obstacle_radius=self.obstacle_radius,
            second_obstacle=SECOND_OBSTACLE if self.second_obstacle else None,
            obstacles_move=self.has_sampled_obstacles,
        )
