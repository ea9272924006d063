"""Drag, lever arm and capture of a workpiece that is pressed on the rim of its fixture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from guiderail.diagrams.tasks.contact_probe import MAX_DRAG_ERROR, SPEEDS, RimContact, drag, press_on_rim
from guiderail.diagrams.tasks.options import MIN_CONTACT_FORCE
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.control.wrench import center_of_pressure
from guiderail.systems.recorder import Recording

DROPPED = 1.0 * MM  # depth below the rim at which a workpiece has dropped in [m]
RESOLUTION = 0.02 * MM  # resolution of the capture offset [m]


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
    recording, cost = press_on_rim(workcell, contact, [(contact.radius, 0.0)], station, options)
    capture = capture_offset(workcell, contact, station, **options)
    return ContactProbe(contact.friction, drags, _lever(recording), capture, cost)


def _lever(recording: Recording) -> float:
    return float(np.linalg.norm(center_of_pressure(recording["wrench"][-10:].mean(axis=0), MIN_CONTACT_FORCE)))


def capture_offset(workcell: Any, contact: RimContact, station: str = "gantry", **options: Any) -> float:
    """Return the largest offset along x from which a pressed workpiece drops in [m], by bisection."""
    near, far = 0.0, contact.radius
    while far - near > RESOLUTION:
        middle = 0.5 * (near + far)
        heights = press_on_rim(workcell, contact, [(middle, 0.0)], station, options)[0]["pose"][:, 2]
        near, far = (middle, far) if heights[-1] < contact.height - DROPPED else (near, middle)
    return near
