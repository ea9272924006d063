"""The connector's rule where the jack may be far off: it feels on which side of the rim it stands, and steps there."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.bnc_connector.rewards import NUM_STEPS, POSE_CENTRE, POSE_SCALE
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.objects.bnc_connector.motion import RIM
from guiderail.models.objects.bnc_connector.search_demonstrations import HOLD_UNTIL, SEARCH
from guiderail.models.objects.insertion import COMMAND_SCALE, LEVER_SCALE

STEP = 0.5 * MM  # from decision to decision
REACH = 3.1 * MM  # where an action of one leads while the demonstrations search
ON_RIM = RIM - 0.5 * MM  # height from which the plug isn't in yet
# Where [time, pose, wrench, lever, command] lie in an observation.
TIME, Z, LEVER, COMMAND = 0, 3, slice(13, 15), slice(15, 17)
STANDS = SEARCH[0] - 0.2  # [s] when the plug may stand on the rim


def scripted_center_of_pressure(observation: np.ndarray) -> np.ndarray:
    """From where the command is a step along the lever, towards the point that bears the plug: there is the jack; (2,).

    Once the plug has dropped in it stays. Without a memory: what was commanded before is observed.

    Raises:
        InputError: if the observation has no lever.
    """
    if len(observation) < COMMAND.stop:
        raise InputError('this rule needs the contact\'s lever: choose observation="center_of_pressure"')
    time = 0.5 * (observation[TIME] + 1.0) * NUM_STEPS * CONTROL_PERIOD
    if not STANDS < time < HOLD_UNTIL:
        return np.zeros(2)
    command, lever = observation[COMMAND] * COMMAND_SCALE, observation[LEVER] * LEVER_SCALE
    height, length = observation[Z] * POSE_SCALE[2] + POSE_CENTRE[2], float(np.linalg.norm(lever))
    if height > ON_RIM and length > 0.0:
        command = command + STEP * lever / max(length, MM)
    return np.clip(command / REACH, -1.0, 1.0)
