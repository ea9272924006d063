"""The rewards that the narrow passage is learned from (thesis, equations 4.22 to 4.25)."""

from __future__ import annotations

import math

import numpy as np

from guiderail.models.objects.narrow_passage import NarrowPassage, action_cost
from guiderail.systems.episode_monitor import SUCCESS
from guiderail.systems.reward_system import RewardTerm

SUCCESS_REWARD = 200.0
PROGRESS = 100.0  # [1/m] of a shaped reward


def reward_terms(reward: str, world: NarrowPassage, drawn: bool = False) -> list[RewardTerm]:
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
