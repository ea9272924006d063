"""Scripted policies of the connector: they feel on which side of the rim the plug stands, and move towards the jack."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.bnc_connector.rewards import POSE_CENTRE, POSE_SCALE
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.objects.bnc_connector.demonstrations import NUM_STEPS, RIM
from guiderail.models.objects.bnc_connector.search_demonstrations import HOLD_UNTIL, SEARCH
from guiderail.models.objects.insertion import COMMAND_SCALE, LEVER_SCALE

# Indices into the observation [time, pose, wrench, center of pressure, command].
TIME, Z, FORCE_Z, TORQUE_X, TORQUE_Y, CENTER_OF_PRESSURE, COMMAND = 0, 3, 9, 10, 11, slice(13, 15), slice(15, 17)

# Against the contact torque, while the demonstrations "insert" press on the rim.
GAIN = 1.5  # action per scaled contact torque
PRESSING = (60, 185)  # control steps
SCALED_RIM = (RIM - 1.2 * MM - POSE_CENTRE[2]) / POSE_SCALE[2]  # scaled height above which the plug is not in yet
CONTACT_FORCE = 0.2  # scaled force along z above which the plug is in contact

# Along the center of pressure, while the demonstrations "search" do.
STEP = 0.5 * MM  # per action
REACH = 3.1 * MM  # displacement that an action of one leads to
ON_RIM = RIM - 0.5 * MM  # height above which the plug is not in yet
MAY_PRESS = SEARCH[0] - 0.2  # earliest time at which the plug may stand on the rim [s]


def scripted_torque_search(observation: np.ndarray) -> np.ndarray:
    """Return an action in x and y against the contact torque, which tells on which side the plug stands, (2,)."""
    step = 0.5 * (observation[TIME] + 1.0) * NUM_STEPS
    is_on_rim = observation[Z] > SCALED_RIM and observation[FORCE_Z] > CONTACT_FORCE
    if not (PRESSING[0] < step < PRESSING[1] and is_on_rim):
        return np.zeros(2)
    return np.clip(GAIN * np.array([-observation[TORQUE_Y], observation[TORQUE_X]]), -1.0, 1.0)


def scripted_center_of_pressure(observation: np.ndarray) -> np.ndarray:
    """Return an action that moves the command a step towards the center of pressure, where the jack is, (2,).

    After the plug has dropped in, the command stays. The policy has no memory: the last command is observed.

    Raises:
        InputError: If the observation has no center of pressure.
    """
    if len(observation) < COMMAND.stop:
        raise InputError('this policy needs the center of pressure: choose observation="center_of_pressure"')
    time = 0.5 * (observation[TIME] + 1.0) * NUM_STEPS * CONTROL_PERIOD
    if not MAY_PRESS < time < HOLD_UNTIL:
        return np.zeros(2)
    command, lever = observation[COMMAND] * COMMAND_SCALE, observation[CENTER_OF_PRESSURE] * LEVER_SCALE
    height, length = observation[Z] * POSE_SCALE[2] + POSE_CENTRE[2], float(np.linalg.norm(lever))
    if height > ON_RIM and length > 0.0:
        command = command + STEP * lever / max(length, MM)
    return np.clip(command / REACH, -1.0, 1.0)
