"""Rewards, observations and symmetries of the connector (thesis, equations 4.27 and 4.28)."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.linalg import block_diag

from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.tasks.bnc_connector.workcell import HALF_TURN, HALF_TURN_OF_WRENCH
from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.objects.insertion import CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE
from guiderail.systems.episode_monitor import TERMINATIONS
from guiderail.systems.reward_system import RewardTerm

# The scale of torques is small, because 0.02 Nm at 4 N indicate on which side of the rim the plug stands.
POSE_CENTER = np.array([0.0, 0.0, 5.0 * MM, 45.0 * DEGREE, 0.0, 0.0])
POSE_SCALE = np.array([2.0 * MM, 2.0 * MM, 8.0 * MM, 45.0 * DEGREE, 1.5 * DEGREE, 1.5 * DEGREE])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.02, 0.02, 0.2])


def observation_terms(
    observation: str,
    duration: float,
    center: np.ndarray = POSE_CENTER,
    scale: np.ndarray = POSE_SCALE,
    wrench_scale: np.ndarray = WRENCH_SCALE,
) -> tuple[ObservationTerm, ...]:
    """Return time, pose and wrench; "center_of_pressure" adds the center of pressure and the commanded x and y.

    An image replaces the center of pressure. `duration` is the duration of an episode [s].
    """
    half = 0.5 * duration
    state = (
        ObservationTerm("time", half, half),
        ObservationTerm("pose", center, scale),
        ObservationTerm("wrench", 0.0, wrench_scale),
    )
    if observation != "center_of_pressure":
        return state
    return (
        *state,
        ObservationTerm("center_of_pressure", 0.0, CENTER_OF_PRESSURE_SCALE),
        ObservationTerm("desired_pose", 0.0, COMMAND_SCALE, (0, 1)),
    )


def half_turn(observation: str) -> tuple[float, ...]:
    """Return the signs of an observation after half a turn about the jack's axis."""
    across = () if observation == "state" else (-1.0,) * 4
    return (1.0, *HALF_TURN, *HALF_TURN_OF_WRENCH, *across)


def sides_of_the_rim(observation: str, action_dims: Iterable[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
    """Return the seven symmetries of a plug on the rim: quarter turns about the axis, and reflections.

    Vectors across the axis rotate; a reflection also changes the sign of torques and tilts. Components along and about
    the axis of pose and wrench are unchanged.

    Returns:
        Matrices of observations (7, n, n), of actions (7, A, A) and of privileged observations (7, 9, 9); None if
        actions move only one of x and y, or only one of the tilts.
    """
    quarter, mirror = np.array([[0.0, -1.0], [1.0, 0.0]]), np.diag([1.0, -1.0])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    observations, actions, privileged, outputs = [], [], [], list(action_dims)
    for across in [*turns[1:], *(turn @ mirror for turn in turns)]:
        axial = np.linalg.det(across).round() * across
        # In a pose, Ry comes before Rx.
        pose = block_diag(across, np.eye(2), axial[::-1, ::-1])
        wrench = block_diag(across, np.eye(1), axial, np.eye(1))
        further = () if observation == "state" else (across, across)
        observations.append(block_diag(np.eye(1), pose, wrench, *further))
        actions.append(pose[np.ix_(outputs, outputs)])
        privileged.append(block_diag(across, np.linalg.det(across).round(), wrench))
    if any((np.abs(action).sum(0) != 1).any() for action in actions):
        return None
    return np.array(observations), np.array(actions), np.array(privileged)


# The thesis gives no units of the wrench f; here they are 10 N and 0.5 Nm.
ACTION_WEIGHT = FORCE_WEIGHT = 0.01
REWARD_WRENCH = np.array([10.0, 10.0, 10.0, 0.5, 0.5, 0.5])
TERMINAL = {"success": 60.0, "collision": -50.0}
# Reward per depth gained [1/mm]. The connector locks when the demonstrations end, however early the plug drops. With a
# terminal reward alone, a policy that moves at random until the plug drops would earn as much as one that uses the
# contact, and would sometimes fail. The path from start to lock is 15.6 mm long, with the last 5.5 mm in the jack.
DEPTH_REWARD = 5.0
# Reward per distance gained towards the jack's axis [1/mm]; on the rim, the depth does not indicate the direction.
ALIGNMENT_REWARD = 5.0


def reward_terms(reward: str, num_actions: int) -> list[RewardTerm]:
    """Return the terms of a reward, one of `REWARDS`.

    "sparse" is the thesis's reward, "shaped" adds the depth gained, and "aligned" also adds the distance gained towards
    the jack's axis. This distance is privileged: the policy does not observe this simulation state. Depth gained and
    distance gained are differences of potentials.
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
