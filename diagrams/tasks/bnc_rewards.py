"""The rewards that the connector is learned from (thesis, equations 4.27 and 4.28)."""

from __future__ import annotations

import numpy as np

from guiderail.models.units import MM
from guiderail.systems.episode_monitor import TERMINATIONS
from guiderail.systems.reward_system import RewardTerm

# The thesis gives no unit of f: here it is 10 N and 0.5 Nm.
ACTION_WEIGHT = FORCE_WEIGHT = 0.01
REWARD_WRENCH = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5])
TERMINAL = {"success": 60.0, "collision": -50.0}
# [1/mm]. A lock comes when the demonstrations end, however soon the plug dropped: paid at the end only, a policy that
# wiggles until it drops is worth as much as one that feels where to go, and fails now and then. From the start to the
# lock it is 15.6 mm, the last 5.5 of them in the jack.
DEPTH_REWARD = 5.0
# [1/mm] of coming nearer to the jack's axis. On the rim, the depth says nothing of where it is better.
ALIGNMENT_REWARD = 5.0

REWARDS = ("sparse", "shaped", "aligned")


def reward_terms(reward: str, num_actions: int) -> list[RewardTerm]:
    """ "sparse" is the thesis's reward, "shaped" adds the depth gained, "aligned" nearness to the jack's axis, too.

    Where the axis is, only a simulation knows: it is rewarded and not observed. What is added is gained from step to
    step, a difference of potentials.
    """
    terms = [
        RewardTerm("action_cost", {"action": num_actions}, lambda action: -ACTION_WEIGHT * float(action @ action)),
        RewardTerm("force_cost", {"wrench": 6}, _force_cost),
        RewardTerm("terminal_reward", {"termination": 1}, _terminal_reward),
    ]
    if reward in ("shaped", "aligned"):
        terms.append(RewardTerm("depth", {"plug": 6, "last_plug": 6}, _depth_gained))
    if reward == "aligned":
        terms.append(RewardTerm("alignment", {"plug": 6, "last_plug": 6}, _alignment_gained))
    return terms


def _force_cost(wrench: np.ndarray) -> float:
    scaled = wrench / REWARD_WRENCH
    return -FORCE_WEIGHT * float(scaled @ scaled)


def _terminal_reward(termination: np.ndarray) -> float:
    return TERMINAL.get(TERMINATIONS[int(termination[0])], 0.0)


def _depth_gained(plug: np.ndarray, last_plug: np.ndarray) -> float:
    return DEPTH_REWARD * float(last_plug[2] - plug[2]) / MM


def _alignment_gained(plug: np.ndarray, last_plug: np.ndarray) -> float:
    nearer = np.hypot(*last_plug[:2]) - np.hypot(*plug[:2])
    return ALIGNMENT_REWARD * float(nearer) / MM
