"""The rewards that the grid clamp is learned from (thesis, equations 3.11 and 3.12)."""

from __future__ import annotations

import numpy as np

from guiderail.models.pose_coordinates import POSE_SIZE
from guiderail.systems.episode_monitor import SUCCESS, TERMINATIONS
from guiderail.systems.reward_system import RewardTerm

SUCCESS_REWARD = 50.0
SHAPING, FORCE_WEIGHT = 300.0, 1.0 / 12.0  # [1/m], [1/N²]
# Of coming nearer to the holes' axis [1/m], and of an end by too much force: steps are parts of a millimetre, and
# whoever presses gently and long must not lose more than whoever gives up at once.
ALIGNMENT, COLLISION_REWARD = 3000.0, -25.0

REWARDS = ("shaped", "no_force", "sparse", "aligned")


def reward_terms(reward: str, num_actions: int, hold: int) -> list[RewardTerm]:
    """ "shaped" is the thesis's, "no_force" the same without the cost of force, "sparse" without the distance gained.

    "aligned" adds nearness to the holes' axis, which only a simulation knows and a policy does not see, and a cost of
    pushing too hard. What the thesis gives once a decision is divided among its `hold` control steps.
    """
    terms = [
        RewardTerm("terminal_reward", {"termination": 1}, _terminal_reward),
        RewardTerm("action_cost", {"action": num_actions}, lambda action: -float(action @ action) / hold),
    ]
    if reward != "no_force":
        terms.append(RewardTerm("force_cost", {"wrench": 6}, lambda wrench: _force_cost(wrench[:3]) / hold))
    if reward != "sparse":
        terms.append(RewardTerm("shaping", {"pose": POSE_SIZE, "last_pose": POSE_SIZE}, _distance_gained))
    if reward == "aligned":
        terms.append(RewardTerm("alignment", {"clamp": POSE_SIZE, "last_clamp": POSE_SIZE}, _alignment_gained))
        terms.append(RewardTerm("collision_cost", {"termination": 1}, _collision_cost))
    return terms


def _terminal_reward(termination: np.ndarray) -> float:
    return SUCCESS_REWARD * (termination[0] == SUCCESS)


def _force_cost(force: np.ndarray) -> float:
    return -FORCE_WEIGHT * float(force @ force)


def _distance_gained(pose: np.ndarray, last_pose: np.ndarray) -> float:
    return SHAPING * float(last_pose[2] - pose[2])


def _alignment_gained(clamp: np.ndarray, last_clamp: np.ndarray) -> float:
    return ALIGNMENT * float(np.hypot(*last_clamp[:2]) - np.hypot(*clamp[:2]))


def _collision_cost(termination: np.ndarray) -> float:
    return COLLISION_REWARD * (TERMINATIONS[int(termination[0])] == "collision")
