"""What a policy of the connector sees, each number centred and scaled."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.observation import Observed
from guiderail.diagrams.stations.bnc_workcell import HALF_TURN, HALF_TURN_OF_WRENCH
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.models.demonstrations.bnc_connector import NUM_STEPS
from guiderail.models.units import DEGREE, MM

OBSERVATIONS = ("state", "lever")

# The wrench's torques are small, and they are what tells on which side of the rim the plug sits: 0.02 Nm at 4 N.
HALF = 0.5 * (NUM_STEPS * CONTROL_PERIOD)
POSE_CENTRE = np.array([0.0, 0.0, 5.0 * MM, 45.0 * DEGREE, 0.0, 0.0])
POSE_SCALE = np.array([2.0 * MM, 2.0 * MM, 8.0 * MM, 45.0 * DEGREE, 1.5 * DEGREE, 1.5 * DEGREE])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.02, 0.02, 0.2])
# A torque grows with the push; divided by it, it is the lever, which doesn't. Where the command is tells what an
# action led to, which a pose that a rim holds back does not.
LEVER_SCALE, COMMAND_SCALE = 3.0 * MM, 2.0 * MM
LEAST_FORCE = 0.5  # [N] with which the plug stands on something


def observed(observation: str) -> tuple[Observed, ...]:
    """Time, pose and wrench; "lever" adds the contact's lever and the commanded x and y."""
    state = (
        Observed("time", HALF, HALF),
        Observed("pose", POSE_CENTRE, POSE_SCALE),
        Observed("wrench", 0.0, WRENCH_SCALE),
    )
    if observation == "state":
        return state
    return (*state, Observed("lever", 0.0, LEVER_SCALE), Observed("desired_pose", 0.0, COMMAND_SCALE, (0, 1)))


def half_turn(observation: str) -> tuple[float, ...]:
    """What half a turn about the jack's axis multiplies an observation by."""
    across = () if observation == "state" else (-1.0,) * 4
    return (1.0, *HALF_TURN, *HALF_TURN_OF_WRENCH, *across)
