"""Base policy of the study `connector_hard_base_policy`: a search that sometimes succeeds (research/experiments.md)."""

import numpy as np

from guiderail.diagrams.tasks.bnc_connector import (
    CENTER_OF_PRESSURE,
    COMMAND,
    HOLD_UNTIL,
    MAY_PRESS,
    ON_RIM,
    POSE_CENTER,
    POSE_SCALE,
    TIME,
    Z,
    reference_trajectory,
)
from guiderail.diagrams.tasks.options import CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE
from guiderail.models.common.transforms import MM
from guiderail_lerobot.base_policy import register_base_policy

CHUNK_STEPS = 40  # number K of commands in a chunk
STEP = 0.28 * MM  # displacement towards the center of pressure per chunk; the scripted policy takes 0.5 mm


@register_base_policy("connector_slow_search")
def slow_search(observation: np.ndarray) -> np.ndarray:
    """Return a chunk (K, 6): the demonstrations' mean, displaced towards the center of pressure in small steps."""
    reference = reference_trajectory("search")
    step = round(0.5 * (float(observation[TIME]) + 1.0) * reference.num_steps)
    at = np.minimum(step + np.arange(CHUNK_STEPS), reference.num_steps - 1)
    chunk = reference.means[at].copy()
    searching = (reference.times[at] > MAY_PRESS) & (reference.times[at] < HOLD_UNTIL)
    command, lever = observation[COMMAND] * COMMAND_SCALE, observation[CENTER_OF_PRESSURE] * CENTER_OF_PRESSURE_SCALE
    length = float(np.linalg.norm(lever))
    if observation[Z] * POSE_SCALE[2] + POSE_CENTER[2] > ON_RIM and length > 0.0:
        command = command + STEP * lever / max(length, MM)
    chunk[searching, :2] = command
    return chunk
