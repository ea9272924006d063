"""Pouring where the mug is not where the template believes it is: someone who looks at it, and someone who doesn't."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.diagrams.tasks.pouring import POSITION_SCALE
from guiderail.diagrams.tasks.pouring_options import MAX_MUG_ERROR
from guiderail.diagrams.tasks.pouring_rewards import AIM

OVER_THE_RIM = (0.03, 0.045)  # [m] before the believed mug's axis and above its rim: pushing there leads to Pour
AIMED = 0.008  # [m] as near to the aim it begins to pour
POURING_DEG = 95.0  # tilted farther than this it goes on: the balls roll
SOFTNESS = 0.03, 0.02  # [m] from which distance on the inputs get smaller, on the way and while aiming
# Where [tip in mug, error of the belief, template's state] lie in an observation.
ERROR, STATE = slice(6, 8), 8


def aiming_person(observation: np.ndarray) -> np.ndarray:
    """Pushes to where the template begins to pour, then aims at the mug itself, and tips the thermos over; (3,)."""
    p_MP = observation[:3] / POSITION_SCALE
    if observation[STATE] < 0.5:
        p_BP = p_MP - np.array([*(MAX_MUG_ERROR * observation[ERROR]), 0.0])
        before, above = OVER_THE_RIM
        goal = np.array([*(before * p_BP[:2] / max(np.hypot(p_BP[0], p_BP[1]), 1e-9)), above])
        return np.clip((goal - p_BP) / SOFTNESS[0], -1.0, 1.0)
    to_go = AIM - p_MP[:2]
    tips = np.linalg.norm(to_go) < AIMED or _tilt_deg(observation) > POURING_DEG
    return np.array([*np.clip(to_go / SOFTNESS[1], -1.0, 1.0), float(tips)])


def blind_person(observation: np.ndarray) -> np.ndarray:
    """The same for where the template believes the mug to be, (3,)."""
    seen = np.array(observation, dtype=float)
    seen[:2] -= POSITION_SCALE * MAX_MUG_ERROR * seen[ERROR]
    seen[ERROR] = 0.0
    return aiming_person(seen)


def _tilt_deg(observation: np.ndarray) -> float:
    axis = Rotation.from_rotvec(observation[3:6]).as_matrix()[:, 2]
    return float(np.rad2deg(np.arccos(np.clip(axis[2], -1.0, 1.0))))
