"""Insertion task from two mesh files: contact geometry, motion, success criterion and demonstrations, all measured."""

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
    compute_center_of_mass,
    find_obstructions,
    make_solids,
    measure_side_clearance,
    plan_motion,
)
from guiderail.models.parts.convex_decomposition import cut_into_convex_pieces, to_arrays
from guiderail.models.parts.mesh_file import UNITS, Part, find_unit, load_part, obj_text
from guiderail.models.parts.symmetry import find_symmetries
from guiderail.tools.datasets.paths import check_new
from guiderail.tools.files import atomic_folder

AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
MODULI = (2e9, 1e10, 3e10)  # moduli of the compliant part [Pa], tried in this order until it is stiff enough
SNAP_MODULI = (2e7, 5e7, 5e6)  # moduli of a body that has to deflect [Pa]
PUSHES = (4.0 * MM, 8.0 * MM, 14.0 * MM)  # commanded depth below the target; the first that seats the plug is used
MISALIGNMENTS = ((1.5 * MM, 0.0), (0.0, 1.5 * MM))  # offsets (x, y) at which the socket must block the plug
TIME_STEPS = (None, 0.005)  # time steps of the simulation [s]: the default, and half of it against deep penetration
FAST_ENOUGH = 4.0  # real-time factor from which the other part is not tried as the compliant one
MIN_SPEED = 2.0  # real-time factor below which less penetration does not count
DENSITY = 2700.0  # density of a part, that of aluminum [kg/m³]; a gantry is weightless
CLEAR = 3.0 * MM  # height of the start above the rim
MAX_GAP = 1.0 * MM  # between the bounding boxes of parts that are assembled
MAX_TURN = 360.0  # largest rotation at the bottom, either way [degrees]
MAX_FORCE = 1e4  # largest force limit [N]
MAX_CENTER = 1.0  # largest distance of the axis from the plug's own [m]


@dataclass(frozen=True)
class Contact:
    """Contact geometry: the compliant part and its convex pieces.

    Attributes:
        compliant: Name of the compliant part, "plug" or "socket".
        bodies: Convex pieces of each of its bodies.
        modulus: Modulus of the bodies that do not snap [Pa].
        snap_modulus: Modulus of the snapping bodies [Pa].
        snapping: Indices of the snapping bodies.
        time_step: Time step of the simulation [s]; the default if None.
    """

    compliant: str
    bodies: tuple[tuple[Any, ...], ...]
    modulus: float
    snap_modulus: float
    snapping: frozenset[int]
    time_step: float | None = None

    @property
    def pieces(self) -> list[tuple[str, float, Any]]:
        """File, modulus [Pa] and solid of each piece."""
        pieces = []
        for number, body in enumerate(self.bodies):
            modulus = self.snap_modulus if number in self.snapping else self.modulus
            pieces += [(modulus, solid) for solid in body]
        return [(f"{self.compliant}_{i}.obj", modulus, solid) for i, (modulus, solid) in enumerate(pieces)]

    @property
    def snapping_pieces(self) -> frozenset[str]:
        """Names of the snapping geometries."""
        numbers = [number for number, body in enumerate(self.bodies) for _ in body]
        return frozenset(f"piece_{i}" for i, number in enumerate(numbers) if number in self.snapping)


def read_parts(
    plug: Path, socket: Path, unit: str | None, plug_pose: Sequence[float], axis: str, center: Sequence[float] | None
) -> tuple[Part, Part]:
    """Return both parts in the target frame: z points out of the socket, the origin is at the plug's lower end.

    Args:
        plug: Mesh file of the part in the tool.
        socket: Mesh file of the part in the world.
        unit: Unit of both files; None if their formats state it.
        plug_pose: Motion of the plug's mesh to the assembled pose: [x y z] in the files' unit, [rx ry rz] in degrees.
        axis: Direction in which the plug is removed, in the socket's file.
        center: Point on the axis, in the socket's file; the plug's center of mass by default.

    Raises:
        InputError: If a file cannot be used, or an argument is invalid.
    """
    if axis not in AXES:
        raise InputError(
            f"--axis is one of {', '.join(AXES)}, not {axis!r}: the direction in which the plug is removed"
        )
    units = [find_unit(path, unit) for path in (plug, socket)]
    if None in units:
        raise InputError(
            f"{(plug, socket)[units.index(None)].name} does not say its unit: give --unit {', '.join(UNITS)}"
        )
    first, second = (load_part(path, str(known)) for path, known in zip((plug, socket), units, strict=True))
    scale = UNITS[str(units[1])]
    first = first.transform(_rotation(np.asarray(plug_pose[3:]) * DEGREE), np.asarray(plug_pose[:3]) * scale)
    z = np.array(AXES[axis], dtype=float)
    x = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.5 else np.array([0.0, 1.0, 0.0])
    to_target = np.stack([x, np.cross(z, x), z])
    first, second = (part.transform(to_target, np.zeros(3)) for part in (first, second))
    _refuse_separate(first, second)
    origin = np.array([*compute_center_of_mass(first)[:2], first.bounds[0, 2]])
    if center is not None:
        on_axis = (to_target @ (np.asarray(center, dtype=float) * scale))[:2]
        if not np.linalg.norm(on_axis - origin[:2]) <= MAX_CENTER:
            raise InputError(f"--center {list(center)} is not near the plug: give a point on the axis of insertion")
        origin[:2] = on_axis
    return first.transform(np.eye(3), -origin), second.transform(np.eye(3), -origin)


def _refuse_separate(plug: Part, socket: Part) -> None:
    """Raise InputError if the bounding boxes of the assembled parts are apart."""
    gaps = np.maximum(plug.bounds[0] - socket.bounds[1], socket.bounds[0] - plug.bounds[1])
    if not gaps.max() <= MAX_GAP:
        raise InputError(
            f"the parts are {1e3 * gaps.max():.4g} mm apart: draw them assembled in one frame, or place the plug with "
            "--plug-pose"
        )


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
    center: Sequence[float] | None = None,
    turn: float = 0.0,
    force_limit: float = COLLISION_FORCE,
    friction: float = 0.2,
    scenario: Sequence[Path] = (),
    say: Callable[[str], None] = lambda sentence: None,
) -> dict[str, Any]:
    """Create a task folder and return its measured properties.

    Args:
        plug: See `read_parts`.
        socket: See `read_parts`.
        unit: See `read_parts`.
        plug_pose: See `read_parts`.
        axis: See `read_parts`.
        center: See `read_parts`.
        out: Folder; it must not exist.
        turn: Rotation of the plug at the bottom [degrees], counterclockwise seen from outside; drawn turned.
        force_limit: Contact force that ends an episode as a collision [N].
        friction: Friction coefficient of all surfaces.
        scenario: Files of Drake model directives of the surroundings.
        say: Called with a sentence on each intermediate result.

    Raises:
        InputError: If the parts cannot be used; no folder is left then.
    """
    check_new(out, "folder with --out, or remove it")
    _check_arguments(plug_pose, turn, force_limit, friction, scenario)
    parts = read_parts(plug, socket, unit, plug_pose, axis, center)
    check_target(*parts)
    path = plan_motion(*parts, turn * DEGREE, CLEAR)
    clearance = measure_side_clearance(*parts)
    snapping = _snapping(*parts, path)
    say(f"{plug.name}: {_size(parts[0])}, {socket.name}: {_size(parts[1])}; the plug enters {1e3 * path.rim:.1f} mm")
    say(f"clearance between walls: {1e3 * clearance:.3f} mm" if np.isfinite(clearance) else "no walls face each other")
    with atomic_folder(out) as folder:
        measured = _write_task(folder, out.name, parts, path, clearance, snapping, force_limit, friction, scenario, say)
    return {"task": str(out), **measured, "page": str(out / "preview.html")}


def _check_arguments(
    plug_pose: Sequence[float], turn: float, force_limit: float, friction: float, scenario: Sequence[Path]
) -> None:
    """Raise InputError for arguments that would be refused only after minutes."""
    if not np.isfinite(plug_pose).all():
        raise InputError(f"--plug-pose is finite, not {list(plug_pose)}")
    if not abs(turn) <= MAX_TURN:
        raise InputError(f"--turn is at most {MAX_TURN:g} degrees either way, not {turn:g}")
    if not 0.0 < force_limit <= MAX_FORCE:
        raise InputError(f"--force-limit is positive and at most {MAX_FORCE:g} N, not {force_limit:g}")
    from guiderail.diagrams.envs.options import validate_options
    from guiderail.diagrams.tasks.part.file import FILE_NAME, Piece

    validate_options(Piece, {"file": "plug.obj", "friction": friction}, "a part")
    names = [file.name for file in scenario]
    for file in scenario:
        if not file.is_file():
            raise InputError(f"there is no scenario {file}")
        if file.suffix.lower() not in (".yaml", ".yml") or file.name == FILE_NAME:
            raise InputError(f"{file} is not a scenario: name a .yaml file of Drake model directives, not {FILE_NAME}")
        if names.count(file.name) > 1:
            raise InputError(f"two scenarios are called {file.name}, and both go into one folder: rename one")


def _snapping(plug: Part, socket: Part, path: InsertionMotion) -> frozenset[int]:
    """Return the indices of the plug's bodies that overlap the socket on the way.

    Raises:
        InputError: If all bodies do: the plug is a rigid part that does not fit.
    """
    ways = find_obstructions(plug, socket, path)
    blocked = frozenset(i for i, (depth, _) in enumerate(ways) if depth > MAX_RESTING_OVERLAP)
    if blocked and len(blocked) == len(ways):
        depth, height = max(ways)
        raise InputError(
            f"the plug does not pass the socket: {1e3 * height:.1f} mm above the target they overlap by about "
            f"{1e3 * depth:.2g} mm; give its rotation with --turn and --center, or draw the part that deflects as a "
            "separate body"
        )
    return blocked


def _write_task(
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

    for part, part_name in zip(parts, ("plug", "socket"), strict=True):
        (folder / f"{part_name}.obj").write_text(obj_text(*_merge_bodies(part)), encoding="utf-8")
    for file in scenario:
        shutil.copy(file, folder / file.name)
    numbers = {"name": name, "force_limit": force_limit, "friction": friction, "scenario": scenario, "path": path}
    exact, approximate = find_symmetries(*parts, path)
    numbers |= {"sides": exact, "rim_sides": approximate}
    say(f"symmetry: {len(exact)} of 7 candidate rotations and reflections, {len(approximate)} more on the rim")
    contact, push, aligned = _choose_contact(folder, parts, numbers, clearance, snapping, say)
    file = _task_file(parts, contact, push, numbers)
    misaligned = [insert(folder, file, offset=xy, snapping=contact.snapping_pieces) for xy in MISALIGNMENTS]
    is_blocked = not any(trial.success for trial in misaligned)
    say(f"misaligned by 1.5 mm: {'blocked (as required)' if is_blocked else 'seated, but must be blocked'}")
    penetration = max(trial.penetration for trial in (aligned, *misaligned))
    succeeded, page = demonstrate(folder, file), folder / "preview.html"
    if not succeeded:
        raise InputError(
            "none of the 5 scripted demonstrations seats the plug: check --plug-pose, --axis, --center and --turn, or "
            "give a larger --force-limit"
        )
    measured = {
        "clearance_mm": round(1e3 * clearance, 4) if np.isfinite(clearance) else None,
        "compliant": contact.compliant,
        "pieces": len(contact.pieces),
        "modulus": contact.modulus,
        "time_step_ms": None if contact.time_step is None else 1e3 * contact.time_step,
        "inserted": aligned.success,
        "inserted_1.5_mm_off": [trial.success for trial in misaligned],
        "force": round(aligned.peak_force, 2),
        "penetration_mm": round(1e3 * aligned.penetration, 4),
        "penetration_pushed_on_the_rim_mm": round(1e3 * penetration, 4),
        "snap_mm": round(1e3 * aligned.snap, 4),
        "real_time_factor": round(min(trial.real_time_factor for trial in (aligned, *misaligned)), 2),
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
    """Return the best contact geometry by `rank`, with its push depth and its trial."""
    from guiderail.tools.parts.trial import insert

    allowed = 0.5 * clearance if np.isfinite(clearance) else 5e-5
    candidates: list[tuple[tuple[bool, bool, bool, float], Contact, float, Any]] = []
    for side, part in zip(("plug", "socket"), parts, strict=True):
        if snapping and side == "socket":
            continue  # the snapping bodies belong to the plug
        cut = [cut_into_convex_pieces(solid) for solid in make_solids(part)]
        if any(body is None for body in cut):
            say(f"{side}: too intricate for convex pieces")
            continue
        bodies = tuple(tuple(body or ()) for body in cut)
        for modulus, time_step in itertools.product(MODULI, TIME_STEPS):
            contact = Contact(side, bodies, modulus, modulus, snapping, time_step)
            trial, contact, push = _first_that_seats(folder, parts, contact, numbers)
            deepest = trial.penetration
            if trial.success:
                # Penetration is largest on the rim, where edges meet.
                file = _task_file(parts, contact, push, numbers)
                deepest = max(deepest, *(insert(folder, file, offset=xy).penetration for xy in MISALIGNMENTS))
            say(
                f"{side} compliant, {len(contact.pieces)} convex pieces, {modulus:.0e} Pa"
                f"{f', {1e3 * time_step:g} ms a step' if time_step else ''}: "
                f"{'seats' if trial.success else 'does not seat'}, {trial.peak_force:.1f} N, "
                f"penetration {1e3 * deepest:.3f} mm, {trial.real_time_factor:.1f} × real time"
            )
            candidates.append((rank(trial.success, deepest, allowed, trial.real_time_factor), contact, push, trial))
            if candidates[-1][0][1]:
                break
        if candidates and candidates[-1][0][1] and candidates[-1][-1].real_time_factor >= FAST_ENOUGH:
            break
    if not candidates:
        raise InputError(
            "both parts are too intricate for convex pieces: remove details without contact, such as threads and "
            "lettering, and export them again"
        )
    _, contact, push, trial = max(candidates, key=lambda candidate: candidate[0])
    _write_pieces(folder, parts, contact)
    return contact, push, trial


def rank(seats: bool, deepest: float, allowed: float, speed: float) -> tuple[bool, bool, bool, float]:
    """Return a sort key, larger is better: the fastest without deep penetration, else the least penetration.

    Args:
        seats: Whether the plug reached the target.
        deepest: Largest penetration [m].
        allowed: Largest allowed penetration [m].
        speed: Real-time factor; below `MIN_SPEED` penetration counts less.
    """
    is_shallow = seats and deepest <= allowed
    return seats, is_shallow, speed >= MIN_SPEED, speed if is_shallow else -deepest


def _first_that_seats(
    folder: Path,
    parts: tuple[Part, Part],
    contact: Contact,
    numbers: dict[str, Any],
) -> tuple[Any, Contact, float]:
    """Return the first trial over snap moduli and push depths that seats the plug; the last one if none does."""
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
        vertices = _merge_bodies(part)[0]
        middle = part.bounds.mean(axis=0)
        models[name] = PartModel(
            source=part.path.name,
            visual=f"{name}.obj",
            mass=round(max(1e-3, DENSITY * sum(solid.volume() for solid in make_solids(part)) * 1e-9), 6),
            center=tuple(np.round(middle, 6).tolist()),
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


def _merge_bodies(part: Part) -> tuple[np.ndarray, np.ndarray]:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in part.bodies)])
    triangles = [t + start for (_, t), start in zip(part.bodies, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in part.bodies]), np.concatenate(triangles)


def _size(part: Part) -> str:
    return " × ".join(f"{1e3 * side:.1f}" for side in np.ptp(part.bounds, axis=0)) + " mm"


def ask_unit(paths: Sequence[Path], given: str | None) -> str | None:
    """Return the unit; ask for it on a terminal if neither an argument nor the format states it."""
    if given is not None or all(find_unit(path, None) for path in paths) or not sys.stdin.isatty():
        return given
    if any(not path.is_file() for path in paths):
        return given  # the reader of the files has the better message
    try:
        # The prompt goes to standard error: standard output may be read by a program.
        print(f"What is one unit of {paths[0].name}? ({', '.join(UNITS)}) [mm] ", end="", file=sys.stderr, flush=True)
        return input().strip() or "mm"
    except EOFError:
        return None
