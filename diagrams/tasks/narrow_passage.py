"""NarrowPassage: a planar robot that must get through a gap and around what was put in its way (4.4.1, 5.4.1)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, OutputPort

from guiderail.diagrams.cameras import Camera
from guiderail.diagrams.observation import Observed
from guiderail.diagrams.options import STANDARD
from guiderail.diagrams.scene import Scene, in_plane
from guiderail.diagrams.stations.plane import PlaneStation
from guiderail.diagrams.stations.station import Station
from guiderail.diagrams.tasks.drawn import Drawn
from guiderail.diagrams.tasks.narrow_passage_conditions import conditions
from guiderail.diagrams.tasks.narrow_passage_options import HARD, NarrowPassageOptions, NarrowPassageReset
from guiderail.diagrams.tasks.narrow_passage_rewards import reward_terms
from guiderail.diagrams.tasks.offsets import episode_stream
from guiderail.diagrams.tasks.registry import register_task
from guiderail.diagrams.tasks.task import Choice, Task
from guiderail.models.demonstrations import narrow_passage as demonstrations
from guiderail.models.errors import InputError
from guiderail.models.keep_out import KeepOut
from guiderail.models.objects.narrow_passage import NarrowPassage as World
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.episode_monitor import Condition
from guiderail.systems.reward_system import RewardTerm

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

    world_kind = "plane"
    Options = NarrowPassageOptions
    Reset = NarrowPassageReset
    draws_held_out = True
    options: NarrowPassageOptions
    rewards = ("sparse", "shaped")
    observations = ("state", "image")
    defaults = {"guidance": "skgrl", "hold": 5}
    difficulties = {STANDARD: {}, "hard": HARD}
    num_steps = demonstrations.NUM_STEPS
    clip = 1.0

    def __init__(self, options: NarrowPassageOptions, choice: Choice):
        super().__init__(options, choice)
        self._world = options.world()

    def world(self) -> World:
        """Walls, a zone, an obstacle and a goal."""
        return self._world

    def signals(self, builder: DiagramBuilder, station: Station) -> Mapping[str, OutputPort]:
        """Where the obstacles are, one after the other."""
        if not self.options.drawn:
            return {}
        self.drawn["obstacles"] = Drawn(builder, "obstacles", self._world.obstacles.size)
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

    def observed(self) -> Sequence[Observed] | Camera:
        """The phase, and where obstacles are that a reset draws; or the plane from above, lying on its side: the way up
        is to the right."""
        if self.choice.observation == "state":
            usual = self._world.obstacles.ravel()
            beside = Observed("obstacles", usual, self.options.obstacle_beside or 1.0)
            return (Observed("phase"), beside) if self.options.obstacle_beside else (Observed("phase"),)
        R_WC = RotationMatrix(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]))
        return Camera(IMAGE_SIZE, np.deg2rad(30), RigidTransform(R_WC, [0.42, 0.5, 1.5]))

    def reward_terms(self, num_actions: int) -> list[RewardTerm]:
        """Of the way gone, the obstacle and the goal; of the way to the goal where the reward is shaped."""
        return reward_terms(self.choice.reward, self._world, self.options.drawn)

    def conditions(self) -> list[Condition]:
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
