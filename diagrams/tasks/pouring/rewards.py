"""Rewards of Pouring (thesis, equations 3.5 to 3.10)."""

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.systems.episode_monitor import TERMINATIONS
from guiderail.systems.reward_system import RewardTerm

REWARDS = ("sparse", "shaped", "hand_shaped")

TERMINAL = {"success": 200.0, "collision": -10.0}  # equation 3.5
SHAPING = 200.0  # equation 3.7
APPROACH = 15.0  # [1/m] equation 3.9
NEAR_BONUS = 0.2  # bonus per action within `NEAR`
TILT = 20.0  # [1/rad] equation 3.10
NEAR = 0.07  # [m] distance of the tips at which pouring begins: the rims keep them beyond the 0.04 of the thesis
POUR = 2  # index of the template's state Pour
AIM = np.array([0.0, -0.045])  # [m] position of the tip in the mug's frame from which both balls fall into the mug
AIMING = 2000.0  # reward per distance gained towards `AIM` [1/m]: 50 mm earn half as much as the whole tilt


def reward_terms(reward: str, inputs: int, action_repeat: int, aimed: bool = False) -> list[RewardTerm]:
    """Return the terms of a reward, one of `REWARDS`.

    The reward of an action is the sum over its control steps. Values that the thesis defines per action are therefore
    divided by `action_repeat`. If `aimed`, "shaped" includes the distance gained towards `AIM` in the state Pour.

    Raises:
        InputError: If there is no such reward.
    """
    terms = [
        RewardTerm(
            "terminal_reward",
            {"termination": 1},
            lambda termination: TERMINAL.get(TERMINATIONS[int(termination[0])], 0.0),
        ),
        RewardTerm("action_cost", {"action": inputs}, lambda action: -float(action @ action) / action_repeat),
    ]
    if reward == "sparse":
        return terms
    if reward == "shaped":
        shaping = RewardTerm(
            "shaping",
            {"progress": 1, "last_progress": 1},
            lambda progress, last_progress: SHAPING * float(progress[0] - last_progress[0]),
        )
        aiming = RewardTerm("aiming", {"tip_in_mug": 6, "last_tip_in_mug": 6, "state": 1}, _aiming)
        return [*terms, shaping, aiming] if aimed else [*terms, shaping]
    if reward == "hand_shaped":
        poses = {"tip_in_mug": 6, "last_tip_in_mug": 6}

        def approach(tip_in_mug: np.ndarray, last_tip_in_mug: np.ndarray) -> float:
            return _approach(tip_in_mug, last_tip_in_mug, action_repeat)

        def tilting(tip_in_mug: np.ndarray, last_tip_in_mug: np.ndarray) -> float:
            return _tilting(tip_in_mug, last_tip_in_mug) / 4  # equation 3.8

        return [*terms, RewardTerm("approach", poses, approach), RewardTerm("tilting", poses, tilting)]
    raise InputError(f"there is no reward '{reward}': use {', '.join(REWARDS)}")


def _aiming(tip_in_mug: np.ndarray, last_tip_in_mug: np.ndarray, state: np.ndarray) -> float:
    """Return the reward for the distance gained towards `AIM` in the state Pour."""
    if state[0] != POUR:
        return 0.0
    before, after = (float(np.linalg.norm(tip[:2] - AIM)) for tip in (last_tip_in_mug, tip_in_mug))
    return AIMING * (before - after)


def _approach(tip: np.ndarray, last: np.ndarray, action_repeat: int) -> float:
    """Return the reward of equation 3.9."""
    distance = np.linalg.norm(tip[:3])
    bonus = NEAR_BONUS / action_repeat if distance <= NEAR else 0.0
    return float(APPROACH * (np.linalg.norm(last[:3]) - distance) + bonus)


def _tilting(tip: np.ndarray, last: np.ndarray) -> float:
    """Return the reward of equation 3.10; the thermos is on the mug's −y side, so that a negative roll pours."""
    change = _euler(tip) - _euler(last)
    change -= 2 * np.pi * np.round(change / (2 * np.pi))
    if np.linalg.norm(tip[:3]) > NEAR:
        return -float(np.abs(change).sum())
    return float(-TILT * change[0] - abs(change[1]) - abs(change[2]))


def _euler(tip: np.ndarray) -> np.ndarray:
    """Return roll, pitch and yaw [rad]."""
    return Rotation.from_rotvec(tip[3:]).as_euler("xyz")
