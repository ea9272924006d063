"""NarrowPassage: a planar robot passes a gap and obstacles (thesis, sections 4.4.1 and 5.4.1)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import DiagramBuilder, OutputPort

from guiderail.diagrams.envs.observation import ObservationTerm, Observed
from guiderail.diagrams.envs.options import Number, Pair, ResetOptions
from guiderail.diagrams.envs.scene import Camera, Scene, in_plane
from guiderail.diagrams.envs.trace import Metric
from guiderail.diagrams.guidance.prior import Prior
from guiderail.diagrams.stations.plane import PlaneStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD, Station
from guiderail.diagrams.tasks.options import episode_stream
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import (
    Condition,
    Task,
    Threshold,
    World,
    add_constant,
    terminal_reward,
)
from guiderail.models.common.arrays import find_streak
from guiderail.models.common.errors import InputError
from guiderail.models.common.termination import Termination
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.objects.narrow_passage import (
    NUM_STEPS,
    PassageGeometry,
    action_cost,
    load_demonstrations,
)
from guiderail.models.primitives import ReferenceTrajectory

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


def avoids_obstacle_from(rows: Any) -> int | None:
    """Return the number, from 1, of the first of five consecutive episodes with obstacle costs below 1, or None.

    A path through the obstacle's middle costs about 100; an exploring policy sometimes touches the obstacle's margin.
    """
    index = find_streak(rows["reward_obstacle_cost"] > -1.0, 5)
    return None if index is None else index + 1


class NarrowPassageReset(ResetOptions):
    """Options of a reset of NarrowPassage."""

    start: Pair | None = Field(None, description="(x, y) of the start [m]; default: that of the demonstrations")


SUCCESS_REWARD = 200.0
PROGRESS = 100.0  # shaped reward for progress [1/m]

BLOCKED_TIME = 20 * CONTROL_PERIOD  # time at a wall without progress after which the robot is blocked [s]
BLOCKED_PROGRESS = 1e-4  # [m] smallest increase of y that counts as progress

# Phases, from −1 to 1, in which the demonstrations pass the first and the second obstacle.
PASSING = ((-0.8, -0.25), (0.1, 0.7))
SLALOM_ACTION = 1.0
# Indices into the observation [phase, x and y of the first obstacle, x and y of the second obstacle]. The observed x is
# −1 or 1, the side of the obstacle.
PHASE, SIDES = 0, (1, 3)


def scripted_slalom(observation: np.ndarray) -> np.ndarray:
    """Return an action (2,) along x, away from the obstacle that the robot is passing."""
    for (first, last), side in zip(PASSING, SIDES, strict=True):
        if first < observation[PHASE] < last:
            return np.array([-SLALOM_ACTION * observation[side], 0.0])
    return np.zeros(2)


IMAGE_SIZE = (144, 110)  # width and height of the observed image [pixels] (thesis, end of section 4.4.1)
COMPONENTS = 20  # components of the Gaussian mixture; with 8 to 16 the gap is blurred
# Repeatability of a demonstrator's hand, as a standard deviation [m]; its square is added to the fitted variances.
FLOOR = 0.002
HELD_OUT_DEVIATION = 0.01  # [m] standard deviation of a held-out start
MAX_DEVIATIONS = 4.0  # limit of a sampled start along x and y [standard deviations]; 1 of 8000 starts is clipped
MAX_START = 2.0  # [m] largest coordinate of a given start


@cache
def reference_trajectory() -> ReferenceTrajectory:
    """Return the reference of the nine demonstrations, fitted once per process."""
    return ReferenceTrajectory.from_demonstrations(load_demonstrations(), components=COMPONENTS, floor=FLOOR)


@register_task("NarrowPassage")
class NarrowPassage(Task):
    """Pass the gap to the goal.

    Rewards: "sparse" is the thesis's reward (4.22 to 4.25). "shaped" adds the distance gained towards the goal [cm].
    Observations: "state" is the time in [−1, 1] (the thesis's policy state), followed by the obstacles' positions if
    `obstacle_beside` is positive; "image" is 110 × 144 × 3.
    """

    station = PlaneStation
    Reset = NarrowPassageReset
    has_held_out_distribution = True
    defaults = {"guidance": "skgrl", "action_repeat": 5}
    presets = {"hard": HARD}
    scripted_policies = (scripted_slalom,)
    clip = 1.0
    statistics = (
        Metric(
            "avoids_obstacle_from",
            "episode",
            "number, from 1, of the first of five consecutive episodes whose obstacle cost is below 1",
            avoids_obstacle_from,
        ),
    )

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

    @model_validator(mode="after")
    def _check_options(self) -> Self:
        """Refuse obstacles that constrain the motion and are sampled."""
        if self.obstacles_constrain and self.has_sampled_obstacles:
            raise InputError(
                "obstacles_constrain needs a single fixed obstacle: leave out second_obstacle, obstacle_beside and "
                "obstacles_end"
            )
        return self

    @property
    def duration(self) -> float:
        """Duration of the demonstrations [s]."""
        return NUM_STEPS * CONTROL_PERIOD

    @property
    def collision(self) -> Threshold:
        """Any contact."""
        return Threshold()

    def workcell(self) -> PassageGeometry:
        """Return the walls, the restricted zone, the obstacle and the goal."""
        return self.geometry

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Return the obstacles' positions, one after the other, if a reset sets them."""
        if not self.has_sampled_obstacles:
            return {}
        return {"obstacles": add_constant(builder, "obstacles", np.zeros(self.geometry.obstacles.size))}

    def prior(self) -> Prior:
        """Return the nine demonstrations, the restricted zone, the walls and the obstacle of `obstacles_constrain`."""
        geometry = self.geometry
        motion = None
        if self.obstacles_constrain:
            from guiderail.models.control.shapes import Sphere

            discs = [Sphere(obstacle, geometry.obstacle_radius) for obstacle in geometry.obstacles]
            motion = MotionConstraints(geometry.constraints, outside=discs)
        return Prior(
            reference=reference_trajectory,
            constraints=geometry.constraints,
            motion=motion,
            keep_out=geometry.keep_out(),
            start_within=MAX_DEVIATIONS * max(self._start_deviation(held_out) for held_out in (False, True)),
        )

    def observe(self) -> Sequence[ObservationTerm] | Observed:
        """Return the phase and sampled obstacles, or the camera above the plane, whose image has +y to the right."""
        if self.observation == "state":
            offset = self.obstacle_beside
            obstacles = ObservationTerm("obstacles", self.geometry.obstacles.ravel(), offset or 1.0)
            return (ObservationTerm("phase"), obstacles) if offset else (ObservationTerm("phase"),)
        R_WC = RotationMatrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
        return Observed(camera=Camera(IMAGE_SIZE, np.deg2rad(30), RigidTransform(R_WC, [0.42, 0.5, 1.5])))

    def rewards(self) -> Mapping[str, Callable[..., float]]:
        """Return costs of motion and obstacles and the terminal reward; "shaped" adds the reward for progress."""
        geometry = self.geometry

        def costs(pose: np.ndarray, obstacles: np.ndarray) -> float:
            return sum(geometry.obstacle_cost(pose, obstacle) for obstacle in obstacles.reshape(-1, 2))

        def progress(pose: np.ndarray, last_pose: np.ndarray) -> float:
            return PROGRESS * (math.dist(last_pose, geometry.goal) - math.dist(pose, geometry.goal))

        terms = {
            "action_cost": lambda pose, last_pose: action_cost(pose - last_pose),
            "obstacle_cost": costs if self.has_sampled_obstacles else geometry.obstacle_cost,
            "terminal_reward": terminal_reward({"success": SUCCESS_REWARD}),
        }
        return {**terms, "progress": progress} if self.reward == "shaped" else terms

    def done(self) -> Mapping[str, Callable[..., bool] | Condition]:
        """Return success at the goal, "blocked" at a wall without progress, and collision if obstacles end episodes.

        In a collision, the robot's center is inside an obstacle; this term takes precedence.
        """
        geometry = self.geometry

        def is_blocked(pose: np.ndarray, contact_force: np.ndarray, fallback: np.ndarray) -> bool:
            return (contact_force[0] > 0 or fallback[0] > 0) and geometry.in_passage(pose)

        def is_touching(pose: np.ndarray, obstacles: np.ndarray) -> bool:
            return any(geometry.obstacle_distance(pose, obstacle) < 0.0 for obstacle in obstacles.reshape(-1, 2))

        blocked = Condition(
            is_blocked,
            seconds=BLOCKED_TIME,
            progress=lambda pose, contact_force, fallback: pose[1],
            min_progress=BLOCKED_PROGRESS,
        )
        conditions: dict[str, Callable[..., bool] | Condition] = {}
        if self.obstacles_end:
            conditions[Termination.COLLISION] = is_touching
        return conditions | {Termination.SUCCESS: geometry.at_goal, Termination.BLOCKED: blocked}

    def reset(self, world: World, rng: np.random.Generator, given: Any) -> dict[str, Any]:
        """Put the robot at the demonstrations' start plus a sampled deviation, and the obstacles on sampled sides.

        Raises:
            InputError: If the absolute value of a coordinate of the start is larger than `MAX_START`.
        """
        start, obstacles = reference_trajectory().means[0].copy(), self.geometry.obstacles
        deviation = self._start_deviation(given.held_out)
        if self.has_sampled_obstacles or self.start_deviation > 0:
            rng = episode_stream(rng, given.held_out)
        if self.has_sampled_obstacles:
            sides = (-1.0) ** (rng.integers(2) + np.arange(len(obstacles)))
            obstacles[:, 0] += self.obstacle_beside * sides
        if deviation:
            start = start + deviation * np.clip(rng.standard_normal(2), -MAX_DEVIATIONS, MAX_DEVIATIONS)
        if given.start is not None:
            start = np.array(given.start)
        if np.abs(start).max() > MAX_START:
            raise InputError(f"the reset option 'start' is at most {MAX_START:g} m along x and y, not {start.tolist()}")
        world.set_pose(start)
        if not self.has_sampled_obstacles:
            return {"start": start}
        world.set("obstacles", obstacles.ravel())
        world.station.set_obstacles(world.context, obstacles)
        return {"start": start, "obstacles": obstacles}

    def _start_deviation(self, held_out: bool) -> float:
        return self.start_deviation or (HELD_OUT_DEVIATION if held_out else 0.0)

    def scene(self) -> Scene:
        """Return the demonstrations, the edge of the restricted zone, and a camera above the plane."""
        edge = np.array([[self.geometry.zone_x, -0.1, 0.0], [self.geometry.zone_x, 1.1, 0.0]])
        X_WC = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.4, 0.5, 1.5])
        return Scene(
            to_world=in_plane,
            camera=Camera((480, 640), np.deg2rad(40), X_WC),
            demonstrations=tuple(load_demonstrations().outputs),
            constraint=(edge,),
            viewpoint=((0.4, 0.35, 0.78), (0.4, 0.48, 0.0)),
            line_radius=0.0025,
        )
