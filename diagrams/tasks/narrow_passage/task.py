"""NarrowPassage: a planar robot that must get through a gap and around what was put in its way (4.4.1, 5.4.1)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from guiderail.diagrams.envs.cameras import Camera
from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.envs.options import STANDARD, Number, Numbers, Options, ResetOptions
from guiderail.diagrams.envs.scene import Scene, in_plane
from guiderail.diagrams.envs.trace import Metric
from guiderail.diagrams.stations.plane import PlaneStation
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.offsets import episode_stream
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import EpisodeConstant, ScriptedPolicy, Task
from guiderail.models.common.arrays import find_streak
from guiderail.models.common.errors import InputError
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.objects.narrow_passage import demonstrations
from guiderail.models.objects.narrow_passage.geometry import PassageGeometry, action_cost
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.episode_monitor import SUCCESS, TerminationTerm
from guiderail.systems.reward_system import RewardTerm

if TYPE_CHECKING:
    from guiderail.diagrams.envs.config import EnvConfig

USUAL = PassageGeometry()
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

    def workcell(self) -> PassageGeometry:
        """Where things usually are with these options."""
        middle = 0.5 * (USUAL.gap_x[0] + USUAL.gap_x[1])
        default = self.gap_width == type(self).model_fields["gap_width"].default
        half = 0.5 * self.gap_width
        return PassageGeometry(
            gap_x=USUAL.gap_x if default else (middle - half, middle + half),
            obstacle_radius=self.obstacle_radius,
            second_obstacle=SECOND_OBSTACLE if self.second_obstacle else None,
            obstacles_move=self.drawn,
        )


def avoids_obstacle_from(rows: Any, cost: float = 1.0, streak: int = 5) -> int | None:
    """Return the first episode, from 1, that begins a streak of episodes whose obstacle cost is below `cost`, or None.

    A path through the obstacle's middle costs about a hundred; a policy that explores touches its margin now and then.

    Args:
        rows: Table of episodes.
        cost: Largest cost of an episode.
        streak: Length of the streak.
    """
    index = find_streak(rows["reward_obstacle_cost"] > -cost, streak)
    return None if index is None else index + 1


class NarrowPassageReset(ResetOptions):
    """Of a reset of the passage."""

    start: Numbers | None = Field(
        None, min_length=2, max_length=2, description="(x, y) [m] to start from, instead of where the demonstrations do"
    )


SUCCESS_REWARD = 200.0
PROGRESS = 100.0  # [1/m] of a shaped reward


def reward_terms(reward: str, world: PassageGeometry, drawn: bool = False) -> list[RewardTerm]:
    """ "sparse" is the thesis's, "shaped" adds how much nearer the goal came.

    With `drawn` the obstacles are where the signal of this name says, and each costs.
    """
    two_poses = {"pose": 2, "last_pose": 2}

    def progress(pose: np.ndarray, last_pose: np.ndarray) -> float:
        return PROGRESS * (math.dist(last_pose, world.goal) - math.dist(pose, world.goal))

    def costs(pose: np.ndarray, obstacles: np.ndarray) -> float:
        return sum(world.obstacle_cost(pose, obstacle) for obstacle in obstacles.reshape(-1, 2))

    obstacle_cost = RewardTerm("obstacle_cost", {"pose": 2}, world.obstacle_cost)
    if drawn:
        obstacle_cost = RewardTerm("obstacle_cost", {"pose": 2, "obstacles": world.obstacles.size}, costs)
    terms = [
        RewardTerm("action_cost", two_poses, lambda pose, last_pose: action_cost(pose - last_pose)),
        obstacle_cost,
        RewardTerm("terminal_reward", {"termination": 1}, _terminal_reward),
    ]
    return [*terms, RewardTerm("progress", two_poses, progress)] if reward == "shaped" else terms


def _terminal_reward(termination: np.ndarray) -> float:
    return SUCCESS_REWARD * (termination[0] == SUCCESS)


BLOCKED_STEPS = 20
BLOCKED_PROGRESS = 1e-4  # [m] along y


def conditions(world: PassageGeometry, touching_ends: bool = False) -> list[TerminationTerm]:
    """At the goal; or pressed against a wall, or stopped before it by a filter, and getting nowhere.

    With `touching_ends` also with the robot's centre in an obstacle, wherever the signal `obstacles` says that they
    are, and first of all.
    """

    def blocked(pose: np.ndarray, contact_force: np.ndarray, fallback: np.ndarray) -> bool:
        return (contact_force[0] > 0 or fallback[0] > 0) and world.in_passage(pose)

    def touched(pose: np.ndarray, obstacles: np.ndarray) -> bool:
        return any(world.obstacle_distance(pose, obstacle) < 0.0 for obstacle in obstacles.reshape(-1, 2))

    usual = [
        TerminationTerm("success", {"pose": 2}, world.at_goal),
        TerminationTerm(
            "blocked",
            {"pose": 2, "contact_force": 1, "fallback": 1},
            blocked,
            steps=BLOCKED_STEPS,
            progress=lambda pose, contact_force, fallback: pose[1],
            min_progress=BLOCKED_PROGRESS,
        ),
    ]
    collision = TerminationTerm("collision", {"pose": 2, "obstacles": world.obstacles.size}, touched)
    return [collision, *usual] if touching_ends else usual


# Phases, from -1 to 1, while the demonstrations are beside the first and the second obstacle.
BESIDE = ((-0.8, -0.25), (0.1, 0.7))
AWAY = 1.0  # of a full action
# Where [phase, first obstacle, second obstacle] lie in an observation: x and y each, x as a side from -1 to 1.
PHASE, SIDES = 0, (1, 3)


def scripted_slalom(observation: np.ndarray) -> np.ndarray:
    """Away from the obstacle that is being passed, along x, (2,)."""
    for (first, last), side in zip(BESIDE, SIDES, strict=True):
        if first < observation[PHASE] < last:
            return np.array([-AWAY * observation[side], 0.0])
    return np.zeros(2)


IMAGE_SIZE = (144, 110)  # width and height of the policy's image (4.4.1, end)
COMPONENTS = 20  # of the mixture: with 8 to 16 of them the passage is blurred
FLOOR = 0.002  # [m], how well a hand repeats itself: added to the demonstrations' covariance as a standard deviation
HELD_OUT_DEVIATION = 0.01  # [m] of a held-out start from the usual one
FARTHEST_DRAW = 4.0  # deviations of a start along x and along y: one in 8000 draws would be farther, and is put there
FARTHEST_START = 2.0  # [m] along x and y


@lru_cache(maxsize=1)
def reference_trajectory() -> ReferenceTrajectory:
    """What the nine demonstrations have in common: Gaussian mixture and regression, fitted once a process."""
    return ReferenceTrajectory.from_demonstrations(demonstrations.load(), components=COMPONENTS, floor=FLOOR)


@register_task("NarrowPassage")
class NarrowPassage(Task):
    """Through the gap: "sparse" is the thesis's reward (4.22-4.25), "shaped" adds how much nearer the goal came, in
    centimetres; "state" is the time in [-1, 1] (the thesis's policy state), "image" is 110 x 144 x 3."""

    workcell_kind = "plane"
    Options = NarrowPassageOptions
    Reset = NarrowPassageReset
    has_held_out_distribution = True
    options: NarrowPassageOptions
    rewards = ("sparse", "shaped")
    observations = ("state", "image")
    defaults = {"guidance": "skgrl", "action_repeat": 5}
    difficulties = {STANDARD: {}, "hard": HARD}
    num_steps = demonstrations.NUM_STEPS
    clip = 1.0
    statistics = (
        Metric(
            "avoids_obstacle_from",
            "episode",
            "first of five consecutive episodes whose obstacle cost is below 1, from 1",
            avoids_obstacle_from,
        ),
    )

    def __init__(self, config: EnvConfig):
        super().__init__(config)
        self._world = self.options.workcell()

    def workcell(self) -> PassageGeometry:
        """Walls, a zone, an obstacle and a goal."""
        return self._world

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Where the obstacles are, one after the other."""
        if not self.options.drawn:
            return {}
        self.drawn["obstacles"] = EpisodeConstant(builder, "obstacles", self._world.obstacles.size)
        return {"obstacles": self.drawn["obstacles"].port}

    def reference(self) -> ReferenceTrajectory:
        """Of the nine demonstrations."""
        return reference_trajectory()

    def constraints(self) -> LinearConstraints:
        """The restricted zone is not entered."""
        return self._world.constraints

    def keep_out(self) -> KeepOut:
        """Walls and zone."""
        return self._world.keep_out()

    def observation_terms(self) -> Sequence[ObservationTerm] | Camera:
        """The phase, and where obstacles are that a reset draws; or the plane from above, lying on its side: the way up
        is to the right."""
        if self.config.observation == "state":
            usual = self._world.obstacles.ravel()
            beside = ObservationTerm("obstacles", usual, self.options.obstacle_beside or 1.0)
            return (ObservationTerm("phase"), beside) if self.options.obstacle_beside else (ObservationTerm("phase"),)
        R_WC = RotationMatrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
        return Camera(IMAGE_SIZE, np.deg2rad(30), RigidTransform(R_WC, [0.42, 0.5, 1.5]))

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Of the way gone, the obstacle and the goal; of the way to the goal where the reward is shaped."""
        return reward_terms(self.config.reward, self._world, self.options.drawn)

    def termination_terms(self) -> list[TerminationTerm]:
        """At the goal, or getting nowhere; where touching obstacles ends an episode, that."""
        return conditions(self._world, self.options.obstacles_end)

    def reset(
        self, station: Station, guidance: Diagram, context: Context, rng: np.random.Generator, options: Any
    ) -> dict[str, Any]:
        """Starts where the demonstrations do, or as far beside it as it is asked for; held out, a little beside it."""
        start, obstacles = reference_trajectory().means[0].copy(), self._world.obstacles
        deviation = self._start_deviation(options.held_out)
        if self.options.drawn:
            rng = episode_stream(rng, options.held_out)
            sides = (-1.0) ** (rng.integers(2) + np.arange(len(obstacles)))
            obstacles[:, 0] += self.options.obstacle_beside * sides
        if deviation:
            start = start + deviation * np.clip(rng.standard_normal(2), -FARTHEST_DRAW, FARTHEST_DRAW)
        if options.start is not None:
            start = np.array(options.start)
        if np.abs(start).max() > FARTHEST_START:
            raise InputError(
                f"the reset option 'start' is at most {FARTHEST_START:g} m along x and y, not {start.tolist()}"
            )
        station.set_pose(context, start)
        if not self.options.drawn:
            return {"start": start}
        assert isinstance(station, PlaneStation)
        self.drawn["obstacles"].set(context, obstacles.ravel())
        station.set_obstacles(context, obstacles)
        return {"start": start, "obstacles": obstacles}

    def start_within(self) -> float:
        """As far as a start is drawn, held out or not."""
        return FARTHEST_DRAW * max(self._start_deviation(held_out) for held_out in (False, True))

    def _start_deviation(self, held_out: bool) -> float:
        return self.options.start_deviation or (HELD_OUT_DEVIATION if held_out else 0.0)

    @classmethod
    def scripted_policies(cls, difficulty: str = STANDARD) -> Mapping[str, ScriptedPolicy]:
        """Return the scripted policies by name; the first one is the default for `difficulty`."""
        policies = (scripted_slalom,)
        return {policy.__name__: policy for policy in policies}

    def camera(self) -> Camera:
        """The plane from above."""
        X_WC = RigidTransform(RotationMatrix(np.diag([1.0, -1.0, -1.0])), [0.4, 0.5, 1.5])
        return Camera((480, 640), np.deg2rad(40), X_WC)

    def scene(self) -> Scene:
        """The demonstrations, and the edge of the zone."""
        edge = np.array([[self._world.zone_x, -0.1, 0.0], [self._world.zone_x, 1.1, 0.0]])
        return Scene(
            to_world=in_plane,
            demonstrations=tuple(demonstrations.load().outputs),
            constraint=(edge,),
            viewpoint=((0.4, 0.35, 0.78), (0.4, 0.48, 0.0)),
            line_radius=0.0025,
        )
