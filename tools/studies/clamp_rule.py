"""What a grid-clamp policy has to beat, and that it can be beaten.

Two policies without learning: the straight descent, and a hand-written rule that feels its way over the table in three
lanes until the pegs drop. The first must mostly fail where table and clamp are not where they should be, the second
must not: then there is something to learn, and it can be learned from what a policy sees.
"""

from __future__ import annotations

import argparse
import json

import numpy as np

from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.grid_clamp import CENTRE, MM, SCALE, make_env, make_skill
from guiderail.models.objects.grid_clamp import GridClampDimensions
from guiderail.tools.rollouts.judging import total, trials, worst

_D = GridClampDimensions()
ON_TABLE = _D.peg_length  # height of the pegs' tips while they stand on the table [m]
NEAR = 1.5 * MM  # above the table: from here on it comes down slowly, and searches
IN_HOLE = 0.5 * MM  # below the table: a peg that is so low is in its hole

LANES = np.array([-1.1, 0.0, 1.1]) * MM  # places along y; between two of them no peg fails to drop
LANE_ENDS = 3.7 * MM  # along x: past the largest offset
PRESS, SEARCH_SPEED = 4.0, 8.0 * MM  # [N], [m/s] while it searches
SNAP_FORCE = 12.0  # [N] that it snaps in with at most
HEIGHT_GAIN, YIELD_GAIN, LANE_GAIN = 1.2 * MM, 2.0 * MM, 4.0  # [m/s/N] of force, the same, and [1/s] of distance
SPEED = make_skill().parameters["speed_m_per_s"]  # of a full input
LIFT = make_skill().parameters["lift"]  # part of it, upwards
STIFFNESS = Impedance().stiffness[0]


def searching_rule(observation: np.ndarray) -> np.ndarray:
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
        velocity = np.array([*(YIELD_GAIN * force[:2]), HEIGHT_GAIN * (force[2] - SNAP_FORCE)])
    speeds = np.array([SPEED, SPEED, LIFT * SPEED if velocity[2] > 0.0 else SPEED])
    return np.clip(velocity / speeds, -1.0, 1.0)


def _along_lanes(xy: np.ndarray) -> np.ndarray:
    """The velocity (2,) with which the search goes on at `xy`."""
    lane = int(np.argmin(np.abs(LANES - xy[1])))
    forward = 1.0 if lane % 2 == 0 else -1.0
    if forward * xy[0] < LANE_ENDS - 0.1 * MM:
        return np.array([forward * SEARCH_SPEED, LANE_GAIN * (LANES[lane] - xy[1])])
    return np.array([0.0, SEARCH_SPEED])


def straight_descent(observation: np.ndarray) -> np.ndarray:
    """Down, (3,)."""
    return np.array([0.0, 0.0, -1.0])


def main(arguments: list[str] | None = None) -> None:
    """Prints how many succeed, and with what force."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--station", default="rails")
    options = parser.parse_args(arguments)
    for uncertainty in ("known", "calibration"):
        env = make_env(uncertainty=uncertainty, station=options.station)
        for policy in (straight_descent, searching_rule):
            rows = trials(env, policy, options.trials)
            what = {"uncertainty": uncertainty, "policy": policy.__name__, "trials": options.trials}
            came = {"successes": total(rows, "success"), "peak_force": worst(rows, "peak_force")}
            print(json.dumps(what | came), flush=True)


if __name__ == "__main__":
    main()
