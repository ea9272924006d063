"""Probe of simulated contact: drag of a workpiece that is pressed on the rim of its fixture.

Not a task: `create-task` (guiderail-parts) and `converge` (guiderail-studies) run it; a task only returns its
`RimContact`.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from guiderail.diagrams.envs.recording import DrivenStation, linear_motion
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.options import MIN_CONTACT_FORCE
from guiderail.models.common.transforms import MM, POSE_SIZE
from guiderail.systems.recorder import Recording

SPEEDS = (0.02, 0.04)  # speeds along the rim [m/s]
MAX_DRAG_ERROR = 0.15  # largest deviation of a drag from the friction coefficient, as a fraction, in converged contact
PRESS = 2.7 * MM  # depth of the command below the rim; 4 N at the gantry's stiffness [m]
CLEARANCE = 0.5 * MM  # height of the start above the rim [m]
DOWN, END = 0.6, 1.4  # times at which the workpiece has been pressed on the rim, and at which a motion ends [s]
FROM = 0.92  # time from which a sliding workpiece is measured [s]
STROKE = 0.3  # duration of a stroke of a workpiece that does not slide around the rim [s]
MAX_SPEED_ERROR = 0.15  # largest deviation of the speed of a measured stroke, as a fraction of it


@dataclass(frozen=True)
class RimContact:
    """Place on the rim of a fixture at which a displaced workpiece stands."""

    height: float  # height of the tool center of a workpiece on the rim, in the target frame [m]
    radius: float  # displacement of a workpiece that surely stands on the rim [m]
    friction: float  # friction coefficient of both parts
    turn: float = 0.0  # turn of the workpiece about z [rad]
    # False if the displaced workpiece surely stands on the rim only along x: it then slides to and fro along y. Around
    # the axis, a workpiece that is not round drops in or is held by the walls, and its drag is not that of the rim.
    all_round: bool = True


def drag(workcell: Any, contact: RimContact, speed: float, station: str = "gantry", **options: Any) -> float:
    """Return the ratio of drag to normal force of a workpiece that slides on the rim at a speed [m/s].

    It is the median over the time in contact, and not a number if the workpiece does not touch. To and fro, only the
    time at this speed counts; around the axis, the workpiece lags behind the command and is slower.
    """
    times = np.linspace(0.0, END - DOWN, 81)
    if contact.all_round:
        begin, angles = FROM, speed / contact.radius * times
        offsets = contact.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    else:
        # From the middle of a stroke, along y.
        begin = DOWN
        position = 0.5 - np.abs((times / STROKE + 0.5) % 2.0 - 1.0)
        offsets = np.stack([np.full(len(times), contact.radius), speed * STROKE * position], axis=1)
    recording, _ = press_on_rim(workcell, contact, offsets, station, options)
    wrench, pose = (recording[name][round(begin / CONTROL_PERIOD) :] for name in ("wrench", "pose"))
    measured = wrench[:, 2] > MIN_CONTACT_FORCE
    if not contact.all_round:
        measured &= np.abs(np.abs(np.gradient(pose[:, 1], CONTROL_PERIOD)) / speed - 1.0) <= MAX_SPEED_ERROR
    ratios = np.linalg.norm(wrench[measured, :2], axis=1) / wrench[measured, 2]
    return float(np.median(ratios)) if len(ratios) else float("nan")


def press_on_rim(
    workcell: Any, contact: RimContact, offsets: Sequence[tuple[float, float]] | np.ndarray, station: str, options: Any
) -> tuple[Recording, float]:
    """Record a workpiece that is pressed on the rim at the first of the `offsets` and moves along them (N, 2) [m].

    Returns:
        The recording, and the CPU time per simulated time.
    """
    times = np.linspace(DOWN, END, len(offsets)) if len(offsets) > 1 else np.array([DOWN])
    path = np.zeros((len(times), POSE_SIZE))
    path[:, :2] = offsets
    path[:, 2], path[:, 3] = contact.height - PRESS, contact.turn
    start = path[0] + [0.0, 0.0, PRESS + CLEARANCE, 0.0, 0.0, 0.0]
    built = STATIONS.get(station).build(workcell, **options)
    source = linear_motion(np.append(0.0, times), np.concatenate([start[None], path]))
    driven = DrivenStation(built, source, round(END / CONTROL_PERIOD))
    driven.start(start)
    begin = time.process_time()
    recording = driven.run()
    return recording, (time.process_time() - begin) / END
