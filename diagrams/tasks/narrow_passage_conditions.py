"""How an episode in the narrow passage ends."""

from __future__ import annotations

import numpy as np

from guiderail.models.objects.narrow_passage import NarrowPassage
from guiderail.systems.episode_monitor import Condition

BLOCKED_STEPS = 20
BLOCKED_PROGRESS = 1e-4  # [m] along y


def conditions(world: NarrowPassage, touching_ends: bool = False) -> list[Condition]:
    """At the goal; or pressed against a wall, or stopped before it by a filter, and getting nowhere.

    With `touching_ends` also with the robot's centre in an obstacle, wherever the signal `obstacles` says that they
    are, and first of all.
    """

    def blocked(pose: np.ndarray, contact_force: np.ndarray, fallback: np.ndarray) -> bool:
        return (contact_force[0] > 0 or fallback[0] > 0) and world.in_passage(pose)

    def touched(pose: np.ndarray, obstacles: np.ndarray) -> bool:
        return any(world.obstacle_distance(pose, obstacle) < 0.0 for obstacle in obstacles.reshape(-1, 2))

    usual = [
        Condition("success", {"pose": 2}, world.at_goal),
        Condition(
            "blocked",
            {"pose": 2, "contact_force": 1, "fallback": 1},
            blocked,
            steps=BLOCKED_STEPS,
            progress=lambda pose, contact_force, fallback: pose[1],
            min_progress=BLOCKED_PROGRESS,
        ),
    ]
    collision = Condition("collision", {"pose": 2, "obstacles": world.obstacles.size}, touched)
    return [collision, *usual] if touching_ends else usual
