"""Inputs that pouring is tried with: a scripted person's, and those of people who are careless or worse."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.diagrams.tasks.pouring.options import MAX_MUG_ERROR
from guiderail.diagrams.tasks.pouring.rewards import AIM
from guiderail.diagrams.tasks.pouring.task import POSITION_SCALE

AIM_OVER_THE_RIM = (0.03, 0.045)  # [m] before the believed mug's axis and above its rim: pushing there leads to Pour
AIMED = 0.008  # [m] as near to the aim it begins to pour
POURING_DEG = 95.0  # tilted farther than this it goes on: the balls roll
SOFTNESS = 0.03, 0.02  # [m] from which distance on the inputs get smaller, on the way and while aiming
# Where [tip in mug, error of the belief, template's state] lie in an observation.
ERROR, STATE = slice(6, 8), 8


def scripted_pour_aimed(observation: np.ndarray) -> np.ndarray:
    """Pushes to where the template begins to pour, then aims at the mug itself, and tips the thermos over; (3,)."""
    p_MP = observation[:3] / POSITION_SCALE
    if observation[STATE] < 0.5:
        p_BP = p_MP - np.array([*(MAX_MUG_ERROR * observation[ERROR]), 0.0])
        before, above = AIM_OVER_THE_RIM
        goal = np.array([*(before * p_BP[:2] / max(np.hypot(p_BP[0], p_BP[1]), 1e-9)), above])
        return np.clip((goal - p_BP) / SOFTNESS[0], -1.0, 1.0)
    to_go = AIM - p_MP[:2]
    tips = np.linalg.norm(to_go) < AIMED or _tilt_deg(observation) > POURING_DEG
    return np.array([*np.clip(to_go / SOFTNESS[1], -1.0, 1.0), float(tips)])


def scripted_pour_blind(observation: np.ndarray) -> np.ndarray:
    """The same for where the template believes the mug to be, (3,)."""
    seen = np.array(observation, dtype=float)
    seen[:2] -= POSITION_SCALE * MAX_MUG_ERROR * seen[ERROR]
    seen[ERROR] = 0.0
    return scripted_pour_aimed(seen)


def _tilt_deg(observation: np.ndarray) -> float:
    axis = Rotation.from_rotvec(observation[3:6]).as_matrix()[:, 2]
    return float(np.rad2deg(np.arccos(np.clip(axis[2], -1.0, 1.0))))


Inputs = Callable[[np.ndarray], np.ndarray]
"""From an observation of Pouring to the three inputs of its template."""

OVER_THE_RIM = (0.045, 0.055)
"""m: how far before the mug's axis and above its rim the person wants the thermos's tip."""

POURING = 0.078
"""m: nearer than this to the middle of the mug's opening the person stops steering and just pushes on."""


def scripted_pour(observation: np.ndarray) -> np.ndarray:
    """Someone who looks at the mug and pushes a three-axis device towards it, until it is poured."""
    p_MP = observation[:3] / POSITION_SCALE
    horizontal = np.hypot(p_MP[0], p_MP[1])
    towards = -p_MP[:2] / max(horizontal, 1e-9)
    if np.linalg.norm(p_MP) < POURING:
        return np.array([*towards, 0.0])
    before, above = OVER_THE_RIM
    return np.clip((np.array([*(-before * towards), above]) - p_MP) / 0.03, -1.0, 1.0)


def noisy_person(rng: np.random.Generator, spread: float = 1.5) -> Inputs:
    """The person, with hands that shake more than they steer."""
    return lambda observation: np.clip(scripted_pour(observation) + spread * rng.normal(size=3), -1.0, 1.0)


def random_walk(rng: np.random.Generator) -> Inputs:
    """Inputs at full deflection that are kept for a while: they reach every corner of the workspace."""
    held = np.sign(rng.normal(size=3))

    def inputs(observation: np.ndarray) -> np.ndarray:
        nonlocal held
        if rng.uniform() < 0.1:
            held = np.sign(rng.normal(size=3))
        return held

    return inputs


def rammer(rng: np.random.Generator) -> Inputs:
    """Someone who wants to hit the mug: always at it, from everywhere, and never quite straight."""

    def inputs(observation: np.ndarray) -> np.ndarray:
        at_it = -observation[:3] / np.linalg.norm(observation[:3])
        return np.clip(rng.uniform(0.5, 2.0) * at_it + 0.6 * rng.normal(size=3), -1.0, 1.0)

    return inputs


def presser(rng: np.random.Generator) -> Inputs:
    """Someone who presses down on the table and into the wrist's room there, and sideways."""

    def inputs(observation: np.ndarray) -> np.ndarray:
        return np.array([*np.clip(rng.normal(size=2), -1.0, 1.0), -1.0])

    return inputs


def uniform_random(rng: np.random.Generator) -> Inputs:
    """An make_baseline policy."""
    return lambda observation: rng.uniform(-1.0, 1.0, 3)


ADVERSARIES: dict[str, Callable[[np.random.Generator], Inputs]] = {
    "noisy_person": noisy_person,
    "random_walk": random_walk,
    "rammer": rammer,
    "presser": presser,
    "uniform_random": uniform_random,
}
