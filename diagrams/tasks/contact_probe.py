"""Probe of simulated contact: drag, lever arm and capture of a workpiece that is pressed on the rim of its fixture.

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
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM, POSE_SIZE
from guiderail.models.control.wrench import center_of_pressure
from guiderail.systems.recorder import Recording

SPEEDS = (0.02, 0.04)  # speeds along the rim [m/s]
MAX_DRAG_ERROR = 0.15  # largest deviation of a drag from the friction coefficient, as a fraction, in converged contact
PRESS = 2.7 * MM  # depth of the command below the rim; 4 N at the gantry's stiffness [m]
CLEARANCE = 0.5 * MM  # height of the start above the rim [m]
DOWN, END = 0.6, 1.4  # times at which the workpiece has been pressed on the rim, and at which a motion ends [s]
FROM = 0.92  # time from which a sliding workpiece is measured [s]
DROPPED = 1.0 * MM  # depth below the rim at which a workpiece has dropped in [m]
RESOLUTION = 0.02 * MM  # resolution of the capture offset [m]


@dataclass(frozen=True)
class RimContact:
    """Place on the rim of a fixture at which a displaced workpiece stands."""

    height: float  # height of the tool center of a workpiece on the rim, in the target frame [m]
    radius: float  # displacement of a workpiece that surely stands on the rim [m]
    friction: float  # friction coefficient of both parts
    turn: float = 0.0  # turn of the workpiece about z [rad]


@dataclass(frozen=True)
class ContactProbe:
    """Measured contact of a workpiece on the rim."""

    friction: float  # friction coefficient
    drags: tuple[float, ...]  # ratio of drag to normal force at each of `SPEEDS`
    lever: float  # distance of the center of pressure from the workpiece's axis, at rest [m]
    capture: float  # largest offset from which a pressed workpiece drops in [m]
    cost: float = float("nan")  # CPU time per simulated time of a resting workpiece, without the station's construction

    @property
    def drag_error(self) -> float:
        """Largest deviation of a drag from the friction coefficient, as a fraction of it; infinite without contact."""
        errors = np.abs(np.array(self.drags) / self.friction - 1.0)
        return float(errors.max()) if np.isfinite(errors).all() else float("inf")

    @property
    def has_converged(self) -> bool:
        """True if the drag is the friction up to `MAX_DRAG_ERROR`."""
        return self.drag_error <= MAX_DRAG_ERROR

    def describe(self) -> str:
        """Return the results as text."""
        drags = ", ".join(f"{drag:.2f}" for drag in self.drags)
        speeds = ", ".join(f"{1e3 * speed:g}" for speed in SPEEDS)
        return (
            f"drag / normal force on the rim {drags} at {speeds} mm/s (friction {self.friction:g}), "
            f"lever arm {self.lever / MM:.2f} mm, capture {self.capture / MM:.2f} mm"
        )


def probe_contact(task: Any, station: str = "gantry", **options: Any) -> ContactProbe:
    """Measure the contact of an insertion task in seconds, with a new station for each motion.

    Args:
        task: Task with the method `rim_contact`.
        station: Name of a simulated station.
        options: Options of the station, such as `time_step` [s].

    Raises:
        InputError: If the task has no rim.
    """
    contact = task.rim_contact() if hasattr(task, "rim_contact") else None
    if contact is None:
        raise InputError(f"{task.name} has no rim on which its contact can be measured")
    workcell = task.workcell()
    drags = tuple(drag(workcell, contact, speed, station, **options) for speed in SPEEDS)
    recording, cost = _press(workcell, contact, [(contact.radius, 0.0)], station, options)
    capture = capture_offset(workcell, contact, station, **options)
    return ContactProbe(contact.friction, drags, _lever(recording), capture, cost)


def drag(workcell: Any, contact: RimContact, speed: float, station: str = "gantry", **options: Any) -> float:
    """Return the ratio of drag to normal force of a workpiece that circles on the rim at a speed [m/s].

    It is the median over the time in contact, and not a number if the workpiece does not touch.
    """
    angles = speed / contact.radius * np.linspace(0.0, END - DOWN, 81)
    offsets = contact.radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    recording, _ = _press(workcell, contact, offsets, station, options)
    wrench = recording["wrench"][round(FROM / CONTROL_PERIOD) :]
    wrench = wrench[wrench[:, 2] > MIN_CONTACT_FORCE]
    ratios = np.linalg.norm(wrench[:, :2], axis=1) / wrench[:, 2]
    return float(np.median(ratios)) if len(ratios) else float("nan")


def lever_arm(workcell: Any, contact: RimContact, offset: float, station: str = "gantry", **options: Any) -> float:
    """Return the distance of the center of pressure from the axis of a workpiece at rest on the rim [m]."""
    return _lever(_press(workcell, contact, [(offset, 0.0)], station, options)[0])


def _lever(recording: Recording) -> float:
    return float(np.linalg.norm(center_of_pressure(recording["wrench"][-10:].mean(axis=0), MIN_CONTACT_FORCE)))


def capture_offset(workcell: Any, contact: RimContact, station: str = "gantry", **options: Any) -> float:
    """Return the largest offset along x from which a pressed workpiece drops in [m], by bisection."""
    near, far = 0.0, contact.radius
    while far - near > RESOLUTION:
        middle = 0.5 * (near + far)
        heights = _press(workcell, contact, [(middle, 0.0)], station, options)[0]["pose"][:, 2]
        near, far = (middle, far) if heights[-1] < contact.height - DROPPED else (near, middle)
    return near


def _press(
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
