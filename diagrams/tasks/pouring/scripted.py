"""Scripted policies of pouring: the three inputs of its template."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.diagrams.tasks.pouring.options import MAX_MUG_ERROR, POSITION_SCALE
from guiderail.diagrams.tasks.pouring.rewards import AIM

# Indices into the observation [tip in mug, error of the believed mug, template's state].
ERROR, STATE = slice(6, 8), 8

OVER_THE_RIM = (0.045, 0.055)  # [m] goal of the tip before the mug's axis and above its rim
POURING_DISTANCE = 0.078  # [m] nearer than this to the middle of the mug's opening it only pushes on
SOFTNESS = 0.03  # [m] distance below which the inputs decrease

AIM_OVER_THE_RIM = (0.03, 0.045)  # [m] the same goal for the believed mug: pushing there leads to Pour
AIM_SOFTNESS = 0.02  # [m] distance below which the inputs decrease while aiming
AIM_TOLERANCE = 0.008  # [m] distance from the aim below which it tilts
POURING_TILT = 95.0  # [degrees] tilt above which it continues whatever the aim, because the balls roll


def scripted_pour(observation: np.ndarray) -> np.ndarray:
    """Return inputs that push the thermos's tip towards the mug until it is poured, (3,)."""
    p_MP = observation[:3] / POSITION_SCALE
    horizontal = np.hypot(p_MP[0], p_MP[1])
    towards = -p_MP[:2] / max(horizontal, 1e-9)
    if np.linalg.norm(p_MP) < POURING_DISTANCE:
        return np.array([*towards, 0.0])
    before, above = OVER_THE_RIM
    return np.clip((np.array([*(-before * towards), above]) - p_MP) / SOFTNESS, -1.0, 1.0)


def scripted_pour_aimed(observation: np.ndarray) -> np.ndarray:
    """Return inputs that push to where Pour begins, aim at the actual mug, and tilt the thermos, (3,)."""
    p_MP = observation[:3] / POSITION_SCALE
    if observation[STATE] < 0.5:
        p_BP = p_MP - np.array([*(MAX_MUG_ERROR * observation[ERROR]), 0.0])
        before, above = AIM_OVER_THE_RIM
        goal = np.array([*(before * p_BP[:2] / max(np.hypot(p_BP[0], p_BP[1]), 1e-9)), above])
        return np.clip((goal - p_BP) / SOFTNESS, -1.0, 1.0)
    to_aim = AIM - p_MP[:2]
    is_tilting = np.linalg.norm(to_aim) < AIM_TOLERANCE or _tilt(observation) > POURING_TILT
    return np.array([*np.clip(to_aim / AIM_SOFTNESS, -1.0, 1.0), float(is_tilting)])


def scripted_pour_blind(observation: np.ndarray) -> np.ndarray:
    """Return the inputs of `scripted_pour_aimed` for the believed mug instead of the actual one, (3,)."""
    believed = np.array(observation, dtype=float)
    believed[:2] -= POSITION_SCALE * MAX_MUG_ERROR * believed[ERROR]
    believed[ERROR] = 0.0
    return scripted_pour_aimed(believed)


def _tilt(observation: np.ndarray) -> float:
    """Return the angle between the thermos's axis and the vertical [degrees]."""
    axis = Rotation.from_rotvec(observation[3:6]).as_matrix()[:, 2]
    return float(np.rad2deg(np.arccos(np.clip(axis[2], -1.0, 1.0))))
