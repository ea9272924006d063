"""What a policy of the connector sees, each number centred and scaled."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.linalg import block_diag

from guiderail.diagrams.observation import Observed
from guiderail.diagrams.stations.bnc_workcell import HALF_TURN, HALF_TURN_OF_WRENCH
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.models.demonstrations.bnc_connector import NUM_STEPS
from guiderail.models.insertion import COMMAND_SCALE, LEVER_SCALE
from guiderail.models.units import DEGREE, MM

OBSERVATIONS = ("state", "lever")

# The wrench's torques are small, and they are what tells on which side of the rim the plug sits: 0.02 Nm at 4 N.
POSE_CENTRE = np.array([0.0, 0.0, 5.0 * MM, 45.0 * DEGREE, 0.0, 0.0])
POSE_SCALE = np.array([2.0 * MM, 2.0 * MM, 8.0 * MM, 45.0 * DEGREE, 1.5 * DEGREE, 1.5 * DEGREE])
WRENCH_SCALE = np.array([5.0, 5.0, 8.0, 0.02, 0.02, 0.2])


def observed(observation: str, num_steps: int = NUM_STEPS) -> tuple[Observed, ...]:
    """Time, pose and wrench; "lever" adds the contact's lever and the commanded x and y."""
    half = 0.5 * num_steps * CONTROL_PERIOD
    state = (
        Observed("time", half, half),
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


def sides_of_the_rim(observation: str, explored: Iterable[int]) -> tuple[np.ndarray, np.ndarray] | None:
    """Seven other sides from which a plug on the rim feels the same: quarter turns about the axis, and their mirrors.

    Vectors across the axis turn; a mirror also changes the sign of torques and tilts. What is about the axis stays.

    Args:
        observation: one of `OBSERVATIONS`.
        explored: the outputs that actions move.

    Returns:
        Of observations (7, n, n) and of actions (7, A, A); None where actions move x and not y, or one tilt alone.
    """
    quarter, mirror = np.array([[0.0, -1.0], [1.0, 0.0]]), np.diag([1.0, -1.0])
    turns = [np.linalg.matrix_power(quarter, k) for k in range(4)]
    observations, actions, outputs = [], [], list(explored)
    for across in [*turns[1:], *(turn @ mirror for turn in turns)]:
        axial = np.linalg.det(across).round() * across
        # A pose has Ry before Rx.
        pose = block_diag(across, np.eye(2), axial[::-1, ::-1])
        wrench = block_diag(across, np.eye(1), axial, np.eye(1))
        further = () if observation == "state" else (across, across)
        observations.append(block_diag(np.eye(1), pose, wrench, *further))
        actions.append(pose[np.ix_(outputs, outputs)])
    if any((np.abs(action).sum(0) != 1).any() for action in actions):
        return None
    return np.array(observations), np.array(actions)
