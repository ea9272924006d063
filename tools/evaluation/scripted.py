"""Rules written by hand: that a task can be done with what a policy sees, and what a learned one has to beat."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import gymnasium
import numpy as np

from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector.rewards import POSE_CENTRE, POSE_SCALE
from guiderail.diagrams.tasks.bnc_connector.scripted import scripted_center_of_pressure
from guiderail.diagrams.tasks.bnc_connector.task import NUM_STEPS
from guiderail.diagrams.tasks.grid_clamp.task import CENTRE, SCALE, make_template
from guiderail.diagrams.tasks.narrow_passage.task import scripted_slalom
from guiderail.diagrams.tasks.pouring.scripted import scripted_pour, scripted_pour_aimed, scripted_pour_blind
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.models.objects.bnc_connector.motion import MM, RIM
from guiderail.models.objects.grid_clamp.geometry import GridClampDimensions
from guiderail.tools.evaluation.baselines import BASELINES, BaselinePolicy
from guiderail.tools.evaluation.rollout import PolicyFn

# The connector: where the demonstrations search the rim, the rule moves against the contact torque.
GAIN = 1.5  # of the action per scaled contact torque
# While the demonstrations search the rim, control steps.
SEARCH = (60, 185)
ON_RIM = (RIM - 1.2 * MM - POSE_CENTRE[2]) / POSE_SCALE[2]  # scaled height from which the plug isn't in yet
PUSHING = 0.2  # scaled force along z from which the plug counts as standing on something
# Where [time, pose, wrench] lie in an observation.
TIME, Z, FORCE_Z, TORQUE_X, TORQUE_Y = 0, 3, 9, 10, 11


def scripted_torque_search(observation: np.ndarray) -> np.ndarray:
    """Moves in x and y against the torque, which says on which side of its mouth the plug stands; (2,)."""
    step = 0.5 * (observation[TIME] + 1.0) * NUM_STEPS
    if not (SEARCH[0] < step < SEARCH[1] and observation[Z] > ON_RIM and observation[FORCE_Z] > PUSHING):
        return np.zeros(2)
    return np.clip(GAIN * np.array([-observation[TORQUE_Y], observation[TORQUE_X]]), -1.0, 1.0)


# The grid clamp: the rule feels its way over the table in three lanes until the pegs drop.
_D = GridClampDimensions()
ON_TABLE = _D.peg_length  # height of the pegs' tips while they stand on the table [m]
NEAR = 1.5 * MM  # above the table: from here on it comes down slowly, and searches
IN_HOLE = 0.5 * MM  # below the table: a peg that is so low is in its hole

LANES = np.array([-1.1, 0.0, 1.1]) * MM  # places along y; between two of them no peg fails to drop
LANE_ENDS = 3.7 * MM  # along x: past the largest offset
PRESS, SEARCH_SPEED = 4.0, 8.0 * MM  # [N], [m/s] while it searches
SNAP_FORCE = 12.0  # [N] that it snaps in with at most
GENTLE_SNAP_FORCE = 8.5  # [N] the same where ten newtons are too many
HEIGHT_GAIN, YIELD_GAIN, LANE_GAIN = 1.2 * MM, 2.0 * MM, 4.0  # [m/s/N] of force, the same, and [1/s] of distance
SPEED = make_template().parameters["speed_m_per_s"]  # of a full input
LIFT = make_template().parameters["lift"]  # part of it, upwards
STIFFNESS = Impedance().stiffness[0]


def scripted_search(observation: np.ndarray, snap_force: float = SNAP_FORCE) -> np.ndarray:
    """Inputs (3,) in [−1, 1] for an observation (6,), without a memory.

    Above the table it goes to where the first lane begins. On it, it presses lightly and follows the lanes, each the
    other way. In a hole it gives way to what pushes it sideways, and pushes down until it snaps.
    """
    position, force = observation[:3] * SCALE[:3] + CENTRE[:3], observation[3:] * SCALE[3:]
    # Measured is where the spring leaves it; the command is a spring's length farther on.
    command = position - force / STIFFNESS
    if position[2] > ON_TABLE + NEAR:
        velocity = np.array([*(LANE_GAIN * (np.array([-LANE_ENDS, LANES[0]]) - position[:2])), -SPEED])
        if position[2] < ON_TABLE + 3 * NEAR and np.hypot(position[0] + LANE_ENDS, position[1] - LANES[0]) > 0.5 * MM:
            velocity[2] = 0.0  # not down before it is there
    elif position[2] > ON_TABLE - IN_HOLE:
        velocity = np.array([*_along_lanes(command[:2]), HEIGHT_GAIN * (force[2] - PRESS)])
    else:
        velocity = np.array([*(YIELD_GAIN * force[:2]), HEIGHT_GAIN * (force[2] - snap_force)])
    speeds = np.array([SPEED, SPEED, LIFT * SPEED if velocity[2] > 0.0 else SPEED])
    return np.clip(velocity / speeds, -1.0, 1.0)


def _along_lanes(xy: np.ndarray) -> np.ndarray:
    """The velocity (2,) with which the search goes on at `xy`."""
    lane = int(np.argmin(np.abs(LANES - xy[1])))
    forward = 1.0 if lane % 2 == 0 else -1.0
    if forward * xy[0] < LANE_ENDS - 0.1 * MM:
        return np.array([forward * SEARCH_SPEED, LANE_GAIN * (LANES[lane] - xy[1])])
    return np.array([0.0, SEARCH_SPEED])


def scripted_gentle_search(observation: np.ndarray) -> np.ndarray:
    """The same, that never pushes harder than is allowed where the clamp is hard."""
    return scripted_search(observation, GENTLE_SNAP_FORCE)


def straight_descent(observation: np.ndarray) -> np.ndarray:
    """Down, (3,)."""
    return np.array([0.0, 0.0, -1.0])


SCRIPTED_POLICIES: dict[str, dict[str, PolicyFn]] = {
    "BncConnector": {
        "scripted_torque_search": scripted_torque_search,
        "scripted_center_of_pressure": scripted_center_of_pressure,
    },
    "GridClamp": {
        "scripted_search": scripted_search,
        "scripted_gentle_search": scripted_gentle_search,
        "straight_descent": straight_descent,
    },
    "NarrowPassage": {"scripted_slalom": scripted_slalom},
    "Pouring": {
        "scripted_pour": scripted_pour,
        "scripted_pour_aimed": scripted_pour_aimed,
        "scripted_pour_blind": scripted_pour_blind,
    },
}


# What "scripted" means at a difficulty; a task's first rule otherwise.
AT_DIFFICULTY = {
    ("BncConnector", "hard"): "scripted_center_of_pressure",
    ("GridClamp", "hard"): "scripted_gentle_search",
    ("Pouring", "hard"): "scripted_pour_aimed",
}


def find_scripted_policy(task: str, name: str, difficulty: str = "standard") -> PolicyFn:
    """A task's rule by its name; "scripted" is the one that was written for that difficulty.

    Raises:
        InputError: if there is no such rule.
    """
    rules = SCRIPTED_POLICIES.get(task, {})
    if name == "scripted" and rules:
        return rules[AT_DIFFICULTY.get((task, difficulty), next(iter(rules)))]
    if name not in rules:
        raise InputError(f"{task} has no policy {name!r}: {did_you_mean(name, [*rules, *BASELINES])}")
    return rules[name]


def make_baseline(task: str, name: str, seed: int = 0) -> Callable[[gymnasium.Env], PolicyFn]:
    """A null policy or a task's rule by its name: what acts, for an environment.

    Raises:
        InputError: if there is neither.
    """
    if name in BASELINES:
        return lambda env: BaselinePolicy(BASELINES[name], env, seed)
    find_scripted_policy(task, name)

    def acting(env: gymnasium.Env) -> PolicyFn:
        config = getattr(cast(Any, env.unwrapped).task.declaration, "config", None)
        return find_scripted_policy(task, name, getattr(config, "difficulty", "standard"))

    return acting
