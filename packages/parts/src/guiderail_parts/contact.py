"""Choice of a task's contact geometry and of its settings, from the penetration measured in scripted insertions."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.stations.station import PLANT_PERIOD
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import MM
from guiderail_parts.geometry.drake_check import Piece, piece_text
from guiderail_parts.geometry.mesh_file import obj_text
from guiderail_parts.geometry.preparation import KINDS, ContactSurface, make_compliant
from guiderail_parts.geometry.solids import join_surfaces
from guiderail_parts.isolation import IsolatedError, run_isolated

MODULUS = 2e9  # first modulus of the compliant part [Pa]
MAX_MODULUS = 5e10  # largest modulus [Pa]
SNAP_MODULI = (2e7, 5e7, 5e6)  # moduli of snapping bodies, in the order of the trials [Pa]
# Commanded depths below the target [m]. If bodies snap, they are tried in turn until the plug is seated. Otherwise the
# first depth is used.
PUSHES = (4.0 * MM, 8.0 * MM, 14.0 * MM)
MISALIGNMENTS = ((1.5 * MM, 0.0), (0.0, 1.5 * MM))  # offsets (x, y) at which the socket must block the plug [m]
MIN_SPEED = 2.0  # smallest desired real-time factor
MAX_TRIALS = 5  # largest number of settings tried for each contact geometry
MIN_TIME_STEP = 0.0025  # largest time step that is not halved further [s]
TRIAL_SECONDS = 20.0  # CPU time of a geometry's trials after which no further settings are tried [s]
CHECK_SECONDS = 20  # largest CPU time for Drake to build the contact geometry [s]


@dataclass(frozen=True)
class Contact:
    """Contact geometry and settings."""

    compliant: str  # name of the compliant part, "plug" or "socket"
    pieces: tuple[Piece, ...]  # pieces of the compliant part
    deviation: float = 0.0  # largest measured distance of the pieces from the part's surface [m]
    snapping: frozenset[int] = frozenset()  # indices of the compliant part's bodies that snap
    modulus: float = MODULUS  # modulus of the bodies that do not snap [Pa]
    snap_modulus: float = MODULUS  # modulus of the snapping bodies [Pa]
    time_step: float | None = None  # time step of the simulation [s]; the default if None

    @property
    def files(self) -> list[tuple[str, float]]:
        """File name and modulus [Pa] of each piece."""
        return [
            (
                f"{self.compliant}_{number}{piece.suffix}",
                self.snap_modulus if piece.body in self.snapping else self.modulus,
            )
            for number, piece in enumerate(self.pieces)
        ]

    @property
    def snapping_pieces(self) -> frozenset[str]:
        """Names of the snapping geometries."""
        return frozenset(f"piece_{i}" for i, piece in enumerate(self.pieces) if piece.body in self.snapping)

    def describe(self) -> str:
        """Return the geometry and the settings as text."""
        kind = "convex pieces" if all(piece.suffix == ".obj" for piece in self.pieces) else "tetrahedral meshes"
        step = f", {1e3 * self.time_step:g} ms a step" if self.time_step else ""
        return f"{self.compliant} compliant, {len(self.pieces)} {kind}, {self.modulus:.0e} Pa{step}"


@dataclass(frozen=True)
class Choice:
    """Contact with its trials."""

    contact: Contact  # contact geometry and settings
    push: float  # commanded depth below the target [m]
    aligned: Any  # trial with the socket in place
    misaligned: tuple[Any, ...] = ()  # trials at `MISALIGNMENTS`; empty if the aligned plug does not seat
    seconds: float = 0.0  # CPU time of cutting, meshing and checking all geometries, without the trials [s]

    @property
    def trials(self) -> tuple[Any, ...]:
        """All trials."""
        return self.aligned, *self.misaligned

    @property
    def deepest(self) -> float:
        """Largest penetration in all trials, including those with the plug on the rim [m]."""
        return max(trial.penetration for trial in self.trials)

    @property
    def speed(self) -> float:
        """Smallest real-time factor of the trials."""
        return min(trial.real_time_factor for trial in self.trials)


MakeFile = Callable[[Contact, float], Any]
"""Function that returns the task file for a contact and a push [m]."""


def choose_contact(
    folder: Path,
    surfaces: dict[str, ContactSurface],
    make_file: MakeFile,
    tolerance: float,
    clearance: float,
    log: Callable[[str], None],
) -> Choice:
    """Return the best contact by `rank`, and write its files into the folder.

    Args:
        folder: Folder of the task.
        surfaces: Contact surfaces of the parts "plug" and "socket".
        make_file: See `MakeFile`.
        tolerance: Intended deviation of the pieces from the surfaces [m]. Convex pieces are refused above twice, and
            tetrahedra above four times this deviation.
        clearance: Clearance between the walls [m]; infinite if no walls face each other.
        log: Function called with a sentence on each result.

    Raises:
        InputError: If no part can be made compliant, or Drake refuses or cannot simulate every geometry.
    """
    allowed = 0.5 * clearance if np.isfinite(clearance) and clearance > 0.0 else 5e-5
    snapping = surfaces["plug"].snapping
    usable = {name: surface for name, surface in surfaces.items() if name == "plug" or not snapping}
    choices: list[Choice] = []
    reasons: list[str] = []

    def report(reason: str) -> None:
        reasons.append(reason)
        log(reason)

    seconds, start = 0.0, cpu_time()
    for kind in KINDS:
        for name, pieces, deviation in make_compliant(kind, usable, tolerance, report):
            number = len(surfaces[name].bodies)
            snapped = frozenset(range(number - snapping, number)) if name == "plug" else frozenset()
            contact = Contact(name, tuple(pieces), deviation, snapped)
            _write_pieces(folder, contact, surfaces)
            try:  # in a child process, because Drake may abort
                run_isolated(_make_station, folder, make_file(contact, PUSHES[0]), cpu_seconds=CHECK_SECONDS)
                refusal = ""
            except IsolatedError as error:
                refusal = str(error)
            seconds += cpu_time() - start
            if refusal:
                report(f"{name}: Drake refuses its contact geometry ({refusal})")
            else:
                try:
                    choices += _adapt_settings(folder, contact, make_file, allowed, log)
                except RuntimeError as error:  # Drake fails at small faces, such as 1e-10 m² of a rigid surface
                    report(f"{name}: Drake can't simulate its contact geometry ({brief(str(error))})")
                if choices and all(max(rank(choice, allowed) for choice in choices)[:3]):
                    break
            start = cpu_time()
        if any(choice.aligned.success for choice in choices):
            break
    if not choices:
        advice = "remove details without contact, such as threads and lettering, and export them again"
        if find_spec("pytetwild") is None:
            advice = f'pip install "guiderail[repair]", which makes tetrahedral meshes of intricate parts, or {advice}'
            reasons = [reason for reason in reasons if "pytetwild" not in reason]
        raise InputError(f"these parts can't be simulated ({'; '.join(reasons)}): {advice}")
    best = max(choices, key=lambda choice: rank(choice, allowed))
    _write_pieces(folder, best.contact, surfaces)
    return replace(best, seconds=seconds)


def rank(choice: Choice, allowed: float) -> tuple[bool, bool, bool, float]:
    """Return a sort key; a better choice has a larger key.

    The criteria are a seated plug, a penetration of at most `allowed` [m], and a speed of at least `MIN_SPEED`, in this
    order. Ties are broken by the larger speed if the penetration is allowed, otherwise by the smaller penetration.
    """
    seats = bool(choice.aligned.success)
    is_shallow = seats and choice.deepest <= allowed
    return seats, is_shallow, choice.speed >= MIN_SPEED, choice.speed if is_shallow else -choice.deepest


def _make_station(folder: Path, file: Any) -> None:
    """Build a station of the task file, as the check of its geometry; run in a child process."""
    from guiderail.diagrams.stations.gantry import GantryStation
    from guiderail_parts.task import write_workcell

    GantryStation(write_workcell(folder, file)).CreateDefaultContext()


def _adapt_settings(
    folder: Path, contact: Contact, make_file: MakeFile, allowed: float, log: Callable[[str], None]
) -> list[Choice]:
    """Return the choices in the order of the trials; each follows from the penetration of the previous choice.

    If the resting plug penetrates the socket while it is pushed, the modulus is increased. If the penetration is
    transient, it is an overshoot proportional to the time step, and the time step is decreased. The dissipation stays
    at its default, because a smaller dissipation would eject the plug.
    """
    choices: list[Choice] = []
    start = cpu_time()
    for _ in range(MAX_TRIALS):
        try:
            choice = _try_contact(folder, contact, make_file)
        except RuntimeError:
            if not choices:
                raise
            break  # the previous settings could be simulated
        choices.append(choice)
        resting = max(trial.resting_penetration for trial in choice.trials)
        log(
            f"{contact.describe()}: {'seats' if choice.aligned.success else 'does not seat'}, "
            f"{choice.aligned.peak_force:.1f} N, penetration {1e3 * choice.deepest:.3f} mm, {choice.speed:.1f} × real "
            "time"
        )
        if choice.aligned.success and choice.deepest <= allowed:
            break
        step = contact.time_step or PLANT_PERIOD
        if choice.aligned.success and resting > 0.7 * allowed and contact.modulus < MAX_MODULUS:
            factor = float(np.clip(2.0 * resting / allowed, 2.0, 10.0))
            contact = replace(contact, modulus=min(contact.modulus * factor, MAX_MODULUS))
        elif step > MIN_TIME_STEP and choice.speed > 2.0 * MIN_SPEED:
            contact = replace(contact, time_step=0.5 * step)
        else:
            break
        if cpu_time() - start > TRIAL_SECONDS:
            break
    return choices


def cpu_time() -> float:
    """Return the CPU time of this process and of its finished children [s]."""
    return sum(os.times()[:4])


def _try_contact(folder: Path, contact: Contact, make_file: MakeFile) -> Choice:
    """Return the trials with the first snap modulus and push depth that seat the plug, or the last ones tried."""
    from guiderail_parts.trial import insert

    for modulus in SNAP_MODULI if contact.snapping else (contact.modulus,):
        contact = replace(contact, snap_modulus=modulus)
        for push in PUSHES if contact.snapping else PUSHES[:1]:
            file = make_file(contact, push)
            aligned = insert(folder, file, snapping=contact.snapping_pieces)
            if aligned.success and aligned.lowest < -file.tolerance.height:
                # Nothing stops the plug at the target, so a push would move it past. `create_task` logs this case.
                alternative = make_file(contact, 0.0)
                unpushed = insert(folder, alternative, snapping=contact.snapping_pieces)
                if unpushed.success:
                    push, file, aligned = 0.0, alternative, unpushed
            if aligned.success:
                # Penetration is largest on the rim, where edges meet.
                misaligned = tuple(
                    insert(folder, file, offset=xy, snapping=contact.snapping_pieces) for xy in MISALIGNMENTS
                )
                return Choice(contact, push, aligned, misaligned)
    return Choice(contact, push, aligned)


def _write_pieces(folder: Path, contact: Contact, surfaces: dict[str, ContactSurface]) -> None:
    """Write the files of the contact geometry into the folder, and delete those of another contact."""
    for name in surfaces:
        for old in [*folder.glob(f"{name}_*.obj"), *folder.glob(f"{name}_*.vtk")]:
            old.unlink()
        if name != contact.compliant:
            text = obj_text(*join_surfaces(surfaces[name].bodies))
            (folder / f"{name}_surface.obj").write_text(text, encoding="utf-8")
    for (file, _), piece in zip(contact.files, contact.pieces, strict=True):
        (folder / file).write_text(piece_text(piece), encoding="utf-8")
