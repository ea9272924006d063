"""Scripted policies of the grid clamp: straight descent, and a search over the table in three lanes."""

from __future__ import annotations

import numpy as np

from guiderail.diagrams.stations.station import Impedance
from guiderail.models.common.units import MM
from guiderail.models.objects.grid_clamp.geometry import GridClampDimensions
from guiderail.models.templates import load_template

# Centre and scale of the observation [position, force].
CENTRE = np.array([0.0, 0.0, 12.0 * MM, 0.0, 0.0, 0.0])
SCALE = np.array([2.0 * MM, 2.0 * MM, 10.0 * MM, 2.0, 2.0, 5.0])

ON_TABLE = GridClampDimensions().peg_length  # height of the clamp while the pegs stand on the table [m]
NEAR = 1.5 * MM  # height above the table below which it descends slowly and searches
IN_HOLE = 0.5 * MM  # depth below the table at which a peg is in its hole
LANES = np.array([-1.1, 0.0, 1.1]) * MM  # places along y; no peg can pass between two of them without dropping
LANE_ENDS = 3.7 * MM  # along x, beyond the largest offset
PRESS, SEARCH_SPEED = 4.0, 8.0 * MM  # force [N] and speed [m/s] of the search
SNAP_FORCE = 12.0  # largest force while it snaps in [N]
GENTLE_SNAP_FORCE = 8.5  # the same for a force limit of 10 N
HEIGHT_GAIN, YIELD_GAIN, LANE_GAIN = 1.2 * MM, 2.0 * MM, 4.0  # [m/s/N], [m/s/N] and [1/s]
_PARAMETERS = load_template("grid_clamp").parameters
SPEED = _PARAMETERS["speed_m_per_s"]  # speed of a full input
LIFT = _PARAMETERS["lift"]  # fraction of it, upwards
STIFFNESS = Impedance().stiffness[0]


def scripted_search(observation: np.ndarray, snap_force: float = SNAP_FORCE) -> np.ndarray:
    """Return the inputs of a search without memory, (3,) in [−1, 1].

    Above the table the clamp moves to the start of the first lane. On the table it presses lightly and follows the
    lanes in alternating directions. In a hole it yields to lateral forces, and pushes down until it snaps in.

    Args:
        observation: Scaled position and force, (6,).
        snap_force: Largest force while it snaps in [N].
    """
    position, force = observation[:3] * SCALE[:3] + CENTRE[:3], observation[3:] * SCALE[3:]
    command = position - force / STIFFNESS  # the impedance's spring separates it from the measured position
    if position[2] > ON_TABLE + NEAR:
        velocity = np.array([*(LANE_GAIN * (np.array([-LANE_ENDS, LANES[0]]) - position[:2])), -SPEED])
        if position[2] < ON_TABLE + 3 * NEAR and np.hypot(position[0] + LANE_ENDS, position[1] - LANES[0]) > 0.5 * MM:
            velocity[2] = 0.0  # no descent before it is at the start
    elif position[2] > ON_TABLE - IN_HOLE:
        velocity = np.array([*_lane_velocity(command[:2]), HEIGHT_GAIN * (force[2] - PRESS)])
    else:
        velocity = np.array([*(YIELD_GAIN * force[:2]), HEIGHT_GAIN * (force[2] - snap_force)])
    speeds = np.array([SPEED, SPEED, LIFT * SPEED if velocity[2] > 0.0 else SPEED])
    return np.clip(velocity / speeds, -1.0, 1.0)


def _lane_velocity(xy: np.ndarray) -> np.ndarray:
    """Return the velocity along the lanes at `xy`, (2,)."""
    lane = int(np.argmin(np.abs(LANES - xy[1])))
    forward = 1.0 if lane % 2 == 0 else -1.0
    if forward * xy[0] < LANE_ENDS - 0.1 * MM:
        return np.array([forward * SEARCH_SPEED, LANE_GAIN * (LANES[lane] - xy[1])])
    return np.array([0.0, SEARCH_SPEED])


def scripted_gentle_search(observation: np.ndarray) -> np.ndarray:
    """Return the inputs of `scripted_search` for a force limit of 10 N, (3,)."""
    return scripted_search(observation, GENTLE_SNAP_FORCE)


def straight_descent(observation: np.ndarray) -> np.ndarray:
    """Return a full input downwards, (3,)."""
    return np.array([0.0, 0.0, -1.0])
