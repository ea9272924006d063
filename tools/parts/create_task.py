"""From two mesh files to a task folder: contact geometry, motion, success and demonstrations, measured."""

from __future__ import annotations

import itertools
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.units import DEGREE, MM
from guiderail.models.objects.insertion import COLLISION_FORCE
from guiderail.models.parts.assembly_check import (
    MAX_RESTING_OVERLAP,
    InsertionMotion,
    check_target,
    compute_centre_of_mass,
    find_obstructions,
    make_solids,
    measure_side_clearance,
    plan_motion,
)
from guiderail.models.parts.convex_decomposition import cut_into_convex_pieces, to_arrays
from guiderail.models.parts.mesh_file import UNITS, Part, find_unit, load_part, obj_text
from guiderail.models.parts.symmetry import find_symmetries
from guiderail.tools.files import atomic_folder, check_writable

AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
MODULI = (2e9, 1e10, 3e10)  # [Pa] of what is compliant, tried in this order until it is stiff enough
SNAP_MODULI = (2e7, 5e7, 5e6)  # [Pa] of a body that has to give way
PUSHES = (4.0 * MM, 8.0 * MM, 14.0 * MM)  # commanded below the target, as little as seats the plug
MISALIGNMENTS = ((1.5 * MM, 0.0), (0.0, 1.5 * MM))  # offsets of the socket at which it must block the plug [m]
TIME_STEPS = (None, 0.005)  # [s] of the simulation: its own, and half of it where parts are too deep in each other
FAST_ENOUGH = 4.0  # times real time, from which the other side is not tried
BEARABLE = 2.0  # times real time, which is not given up to be less deep
DENSITY = 2700.0  # [kg/m³] of a part, aluminium's; rails carry no weight
CLEAR = 3.0 * MM


@dataclass(frozen=True)
class Contact:
    """Which part is compliant, and in how many pieces.

    Attributes:
        compliant: "plug" or "socket".
        bodies: its convex pieces, for each of its bodies.
        modulus: of those that don't snap [Pa].
        snap_modulus: of those that do [Pa].
        snapping: numbers of the bodies that do.
        time_step: of the simulation [s], its own unless given.
    """

    compliant: str
    bodies: tuple[tuple[Any, ...], ...]
    modulus: float
    snap_modulus: float
    snapping: frozenset[int]
    time_step: float | None = None

    @property
    def pieces(self) -> list[tuple[str, float, Any]]:
        """Each piece's file, modulus [Pa] and solid."""
        found = []
        for number, body in enumerate(self.bodies):
            modulus = self.snap_modulus if number in self.snapping else self.modulus
            found += [(modulus, solid) for solid in body]
        return [(f"{self.compliant}_{i}.obj", modulus, solid) for i, (modulus, solid) in enumerate(found)]

    @property
    def snapping_pieces(self) -> frozenset[str]:
        """Names of the geometries that give way."""
        numbers = [number for number, body in enumerate(self.bodies) for _ in body]
        return frozenset(f"piece_{i}" for i, number in enumerate(numbers) if number in self.snapping)


def read_parts(
    plug: Path, socket: Path, unit: str | None, plug_pose: Sequence[float], axis: str, centre: Sequence[float] | None
) -> tuple[Part, Part]:
    """Both parts in the target frame: z out of the socket, its origin on the axis at the plug's lower end.

    Args:
        plug, socket: the files.
        unit: of both files' numbers; None where their formats say it.
        plug_pose: [x y z] in the files' unit and [rx ry rz] in degrees by which the plug's file is moved into the
            socket's; zeros where both are drawn assembled.
        axis: which way the plug comes out, in the socket's file.
        centre: a point on the axis, in the socket's file; the plug's centre of mass unless given.

    Raises:
        InputError: if a file can't be used, or an argument makes no sense.
    """
    if axis not in AXES:
        raise InputError(f"--axis is one of {', '.join(AXES)}, not {axis!r}: the way the plug comes out")
    units = [find_unit(path, unit) for path in (plug, socket)]
    if None in units:
        raise InputError(
            f"{(plug, socket)[units.index(None)].name} does not say its unit: give --unit {', '.join(UNITS)}"
        )
    first, second = (load_part(path, str(one)) for path, one in zip((plug, socket), units, strict=True))
    scale = UNITS[str(units[1])]
    first = first.transform(_rotation(np.asarray(plug_pose[3:]) * DEGREE), np.asarray(plug_pose[:3]) * scale)
    z = np.array(AXES[axis], dtype=float)
    x = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.5 else np.array([0.0, 1.0, 0.0])
    to_target = np.stack([x, np.cross(z, x), z])
    first, second = (part.transform(to_target, np.zeros(3)) for part in (first, second))
    origin = np.array([*compute_centre_of_mass(first)[:2], first.bounds[0, 2]])
    if centre is not None:
        origin[:2] = (to_target @ (np.asarray(centre, dtype=float) * scale))[:2]
    return first.transform(np.eye(3), -origin), second.transform(np.eye(3), -origin)


def _rotation(angles: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", angles).as_matrix()


def create_task(
    plug: Path,
    socket: Path,
    out: Path,
    *,
    unit: str | None = None,
    plug_pose: Sequence[float] = (0.0,) * 6,
    axis: str = "+z",
    centre: Sequence[float] | None = None,
    turn: float = 0.0,
    force_limit: float = COLLISION_FORCE,
    friction: float = 0.2,
    scenario: Sequence[Path] = (),
    say: Callable[[str], None] = lambda words: None,
) -> dict[str, Any]:
    """Makes a task folder, and returns what was measured.

    Args:
        plug, socket, unit, plug_pose, axis, centre: see `read_parts`.
        out: the folder; it must not exist.
        turn: of the plug at the bottom [degrees], counter-clockwise as seen from outside; it is drawn turned.
        force_limit: more than that ends an episode [N].
        friction: of all surfaces.
        scenario: files of Drake model directives of what else stands there.
        say: is told what was found while it goes on.

    Raises:
        InputError: if the parts can't be used, in a sentence with the remedy; nothing is left then.
    """
    if out.exists():
        raise InputError(f"{out} already exists: name another folder with --out, or remove it")
    check_writable(out)
    _check_given(friction, scenario)
    parts = read_parts(plug, socket, unit, plug_pose, axis, centre)
    check_target(*parts)
    path = plan_motion(*parts, turn * DEGREE, CLEAR)
    clearance = measure_side_clearance(*parts)
    snapping = _snapping(*parts, path)
    say(f"{plug.name}: {_size(parts[0])}, {socket.name}: {_size(parts[1])}; the plug enters {1e3 * path.rim:.1f} mm")
    say(f"clearance between walls: {1e3 * clearance:.3f} mm" if np.isfinite(clearance) else "no walls face each other")
    with atomic_folder(out) as made:
        measured = _make(made, out.name, parts, path, clearance, snapping, force_limit, friction, scenario, say)
    return {"task": str(out), **measured, "page": str(out / "preview.html")}


def _check_given(friction: float, scenario: Sequence[Path]) -> None:
    """Raises an InputError for what would be found out only after minutes."""
    from guiderail.diagrams.envs.options import validate_options
    from guiderail.diagrams.tasks.part.file import FILE_NAME, Piece

    validate_options(Piece, {"file": "plug.obj", "friction": friction}, "a part")
    names = [file.name for file in scenario]
    for file in scenario:
        if not file.is_file():
            raise InputError(f"there is no scenario {file}")
        if file.suffix.lower() not in (".yaml", ".yml") or file.name == FILE_NAME:
            raise InputError(f"{file} is no scenario: that is a .yaml file of Drake model directives, not {FILE_NAME}")
        if names.count(file.name) > 1:
            raise InputError(f"two scenarios are called {file.name}, and both go into one folder: rename one")


def _snapping(plug: Part, socket: Part, path: InsertionMotion) -> frozenset[int]:
    """Numbers of the plug's bodies that overlap the socket on the way.

    Raises:
        InputError: if that is all there is of the plug: a rigid part that doesn't fit.
    """
    ways = find_obstructions(plug, socket, path)
    blocked = frozenset(i for i, (depth, _) in enumerate(ways) if depth > MAX_RESTING_OVERLAP)
    if blocked and len(blocked) == len(ways):
        depth, height = max(ways)
        raise InputError(
            f"the plug does not pass the socket: {1e3 * height:.1f} mm above the target they overlap by about "
            f"{1e3 * depth:.2g} mm; say with --turn and --centre by how much it turns about what, or draw what "
            "gives way as a body of its own"
        )
    return blocked


def _make(
    folder: Path,
    name: str,
    parts: tuple[Part, Part],
    path: InsertionMotion,
    clearance: float,
    snapping: frozenset[int],
    force_limit: float,
    friction: float,
    scenario: Sequence[Path],
    say: Callable[[str], None],
) -> dict[str, Any]:
    from guiderail.diagrams.tasks.part.file import write_task_file
    from guiderail.tools.parts.trial import demonstrate, insert, write_preview

    for part, of in zip(parts, ("plug", "socket"), strict=True):
        (folder / f"{of}.obj").write_text(obj_text(*_whole(part)), encoding="utf-8")
    for file in scenario:
        shutil.copy(file, folder / file.name)
    numbers = {"name": name, "force_limit": force_limit, "friction": friction, "scenario": scenario, "path": path}
    same, near = find_symmetries(*parts, path)
    numbers |= {"sides": same, "rim_sides": near}
    say(f"symmetry: {len(same)} of 7 candidate rotations and reflections, {len(near)} more approximately on the rim")
    contact, push, aligned = _choose_contact(folder, parts, numbers, clearance, snapping, say)
    file = _task_file(parts, contact, push, numbers)
    off = [insert(folder, file, offset=one, snapping=contact.snapping_pieces) for one in MISALIGNMENTS]
    say(
        f"misaligned by 1.5 mm: {'seated, but must be blocked' if any(t.success for t in off) else 'blocked (as required)'}"
    )
    penetration = max(trial.penetration for trial in (aligned, *off))
    succeeded, page = demonstrate(folder, file), folder / "preview.html"
    measured = {
        "clearance_mm": round(1e3 * clearance, 4) if np.isfinite(clearance) else None,
        "compliant": contact.compliant,
        "pieces": len(contact.pieces),
        "modulus": contact.modulus,
        "time_step_ms": None if contact.time_step is None else 1e3 * contact.time_step,
        "inserted": aligned.success,
        "inserted_1.5_mm_off": [trial.success for trial in off],
        "force": round(aligned.peak_force, 2),
        "penetration_mm": round(1e3 * aligned.penetration, 4),
        "penetration_pushed_on_the_rim_mm": round(1e3 * penetration, 4),
        "snap_mm": round(1e3 * aligned.snap, 4),
        "real_time_factor": round(min(trial.real_time_factor for trial in (aligned, *off)), 2),
        "demonstrations_seated": f"{succeeded} of 5",
    }
    file = file.model_copy(update={"measured": measured})
    write_task_file(folder, file)
    write_preview(page, folder, file, aligned)
    return measured


def _choose_contact(
    folder: Path,
    parts: tuple[Part, Part],
    numbers: dict[str, Any],
    clearance: float,
    snapping: frozenset[int],
    say: Callable[[str], None],
) -> tuple[Contact, float, Any]:
    """The contact geometry that inserts, by `rank`, with its push and its trial."""
    from guiderail.tools.parts.trial import insert

    allowed = 0.5 * clearance if np.isfinite(clearance) else 5e-5
    found: list[tuple[tuple[bool, bool, bool, float], Contact, float, Any]] = []
    for side, part in zip(("plug", "socket"), parts, strict=True):
        if snapping and side == "socket":
            continue  # what gives way is in the plug
        cut = [cut_into_convex_pieces(solid) for solid in make_solids(part)]
        if any(body is None for body in cut):
            say(f"{side}: too intricate to be cut into convex pieces")
            continue
        bodies = tuple(tuple(body or ()) for body in cut)
        for modulus, time_step in itertools.product(MODULI, TIME_STEPS):
            contact = Contact(side, bodies, modulus, modulus, snapping, time_step)
            trial, contact, push = _first_that_seats(folder, parts, contact, numbers)
            deepest = trial.penetration
            if trial.success:
                # Pressed on the rim it is deepest: there an edge meets an edge.
                file = _task_file(parts, contact, push, numbers)
                deepest = max(deepest, *(insert(folder, file, offset=one).penetration for one in MISALIGNMENTS))
            say(
                f"{side} compliant, {len(contact.pieces)} convex pieces, {modulus:.0e} Pa"
                f"{f', {1e3 * time_step:g} ms a step' if time_step else ''}: "
                f"{'seats' if trial.success else 'does not seat'}, {trial.peak_force:.1f} N, "
                f"{1e3 * deepest:.3f} mm deep, {trial.real_time_factor:.1f} × real time"
            )
            found.append((rank(trial.success, deepest, allowed, trial.real_time_factor), contact, push, trial))
            if found[-1][0][1]:
                break
        if found and found[-1][0][1] and found[-1][-1].real_time_factor >= FAST_ENOUGH:
            break
    if not found:
        raise InputError(
            "both parts are too intricate to be cut into convex pieces: leave out what never touches, such as threads, "
            "fillets and lettering, and export them again"
        )
    _, contact, push, trial = max(found, key=lambda one: one[0])
    _write_pieces(folder, parts, contact)
    return contact, push, trial


def rank(seats: bool, deepest: float, allowed: float, speed: float) -> tuple[bool, bool, bool, float]:
    """The larger the better: the fastest of what is nowhere too deep, or else the least deep that is fast enough.

    Args:
        seats: whether the plug was at the target.
        deepest, allowed: of one part in the other [m].
        speed: times real time.
    """
    good = seats and deepest <= allowed
    return seats, good, speed >= BEARABLE, speed if good else -deepest


def _first_that_seats(
    folder: Path,
    parts: tuple[Part, Part],
    contact: Contact,
    numbers: dict[str, Any],
) -> tuple[Any, Contact, float]:
    """The first trial that seats, over how far is pushed and how soft a snap is; the last one if none does."""
    from guiderail.tools.parts.trial import insert

    for soft in SNAP_MODULI if contact.snapping else (contact.modulus,):
        contact = replace(contact, snap_modulus=soft)
        _write_pieces(folder, parts, contact)
        for push in PUSHES if contact.snapping else PUSHES[:1]:
            file = _task_file(parts, contact, push, numbers)
            trial = insert(folder, file, snapping=contact.snapping_pieces)
            if trial.success:
                return trial, contact, push
    return trial, contact, push


def _write_pieces(folder: Path, parts: tuple[Part, Part], contact: Contact) -> None:
    for old in [*folder.glob("plug_*.obj"), *folder.glob("socket_*.obj")]:
        old.unlink()
    for file, _, solid in contact.pieces:
        (folder / file).write_text(obj_text(*to_arrays(solid)), encoding="utf-8")


def _task_file(parts: tuple[Part, Part], contact: Contact, push: float, numbers: dict[str, Any]) -> Any:
    from guiderail.diagrams.envs.options import validate_options
    from guiderail.diagrams.tasks.part.file import NAMESPACE, MotionNumbers, PartModel, PartTaskFile, Piece

    path, friction = numbers["path"], numbers["friction"]
    models = {}
    for part, name in zip(parts, ("plug", "socket"), strict=True):
        if contact.compliant == name:
            pieces = [
                Piece.model_validate({"file": file, "modulus": modulus, "friction": friction})
                for file, modulus, _ in contact.pieces
            ]
        else:
            pieces = [Piece.model_validate({"file": f"{name}.obj", "friction": friction})]
        vertices = _whole(part)[0]
        middle = part.bounds.mean(axis=0)
        models[name] = PartModel(
            source=part.path.name,
            visual=f"{name}.obj",
            mass=round(max(1e-3, DENSITY * sum(solid.volume() for solid in make_solids(part)) * 1e-9), 6),
            centre=tuple(np.round(middle, 6).tolist()),
            gyration=round(float(np.sqrt(((vertices - middle) ** 2).sum(axis=1).mean())), 6),
            pieces=tuple(pieces),
        )
    values: dict[str, Any] = dict(
        name=f"{NAMESPACE}/{_plain_name(numbers['name'])}",
        **models,
        scenario=tuple(file.name for file in numbers["scenario"]),
        motion=validate_options(
            MotionNumbers,
            {"travel": path.travel, "rim": path.rim, "turn": float(path.turn / DEGREE), "push": push},
            "a motion",
        ),
        force_limit=numbers["force_limit"],
        time_step=contact.time_step,
        sides=numbers["sides"],
        rim_sides=numbers["rim_sides"],
    )
    return validate_options(PartTaskFile, values, "a task of parts")


def _plain_name(name: str) -> str:
    return "".join(letter if letter.isalnum() or letter in "_.-" else "_" for letter in name)


def _whole(part: Part) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in part.bodies)])
    triangles = [t + start for (_, t), start in zip(part.bodies, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in part.bodies]), np.concatenate(triangles)


def _size(part: Part) -> str:
    return " × ".join(f"{1e3 * side:.1f}" for side in np.ptp(part.bounds, axis=0)) + " mm"


def ask_unit(paths: Sequence[Path], given: str | None) -> str | None:
    """The unit, asked for at a terminal where neither an argument nor the format says it."""
    if given is not None or all(find_unit(path, None) for path in paths) or not sys.stdin.isatty():
        return given
    if any(not path.is_file() for path in paths):
        return given  # which is said better where the files are read
    try:
        # Not by input(), whose question may go where a program reads the result.
        print(f"What is one unit of {paths[0].name}? ({', '.join(UNITS)}) [mm] ", end="", file=sys.stderr, flush=True)
        return input().strip() or "mm"
    except EOFError:
        return None  # as where nobody can be asked
