"""Insertion task from two mesh files: contact geometry, motion, success criterion, demonstrations and measurements."""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.diagrams.tasks.options import COLLISION_FORCE, FORCE_LIMITS
from guiderail.models.common.arrays import as_number, as_numbers, as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import DEGREE, MM, POSE_SIZE
from guiderail.tools.files import atomic_folder, check_new
from guiderail_parts.contact import MISALIGNMENTS, Choice, Contact, choose_contact, cpu_time
from guiderail_parts.geometry.assembly_check import (
    MAX_FLANK_SLOPE,
    MAX_RESTING_OVERLAP,
    MAX_SHRINK,
    MAX_WALL_SLOPE,
    InsertionMotion,
    check_target,
    compute_center_of_mass,
    compute_radius_of_gyration,
    find_obstructions,
    find_symmetries,
    measure_side_clearance,
    plan_motion,
)
from guiderail_parts.geometry.assembly_check import shrink as shrink_part
from guiderail_parts.geometry.demonstrator import NUM_DEMONSTRATIONS, TOUCH
from guiderail_parts.geometry.mesh_file import UNITS, Part, find_unit, find_units, load_part, obj_text
from guiderail_parts.geometry.obj_file import read_obj
from guiderail_parts.geometry.preparation import MIN_YAW, ContactSurface, choose_tolerance, decimate, prepare_surfaces

if TYPE_CHECKING:
    from guiderail_parts.task_file import MotionNumbers, PartTaskFile, SearchNumbers

AXES = {"+x": (1, 0, 0), "-x": (-1, 0, 0), "+y": (0, 1, 0), "-y": (0, -1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1)}
DENSITY = 2700.0  # assumed density of the parts, here of aluminum [kg/m³]; a gantry has no gravity
START_HEIGHT = 3.0 * MM  # height of the plug above the rim at the start [m]
MAX_GAP = 1.0 * MM  # largest gap between the bounding boxes of assembled parts [m]
MAX_TURN = 180.0  # largest rotation at the bottom, either way [degrees]
MAX_PITCH = 0.1  # largest advance per turn, either way [m]
MAX_SEARCH_TURN = 10.0  # largest unknown turn of the socket [degrees]
COMMANDED_TURN = 1.5  # bound of the commanded turn, as a multiple of the unknown turn of the socket
MAX_SEATED_TURN = 20.0  # largest turn of a seated plug if the insertion has no turn [degrees]
MAX_EPISODES = 100  # largest number of episodes of each policy for each setting of a calibration
ROUNDING = 1e-6  # numbers of task.yaml are rounded to this length [m]
MAX_CENTER = 1.0  # largest distance of the insertion axis from the plug's center of mass [m]


def read_parts(
    plug: Path, socket: Path, unit: str | None, plug_pose: Sequence[float], axis: str, center: Sequence[float] | None
) -> tuple[Part, Part]:
    """Return both parts in the target frame: z points out of the socket, the origin is at the plug's lower end.

    Args:
        plug: Mesh file of the part in the tool.
        socket: Mesh file of the part in the world.
        unit: Unit of a file whose format does not state its unit; None if both formats state the unit.
        plug_pose: Motion of the plug's mesh to the assembled pose: [x y z] in the socket's unit, and rotations
            [rx ry rz] about the fixed axes x, y and z, in this order [degrees].
        axis: Direction in which the plug is removed, in the coordinates of the socket's file; a key of `AXES`.
        center: Point (3,) on the axis, in the coordinates and unit of the socket's file; None for the plug's center of
            mass.

    Raises:
        InputError: If a file cannot be used, an argument is invalid, or the parts are not assembled.
    """
    if axis not in AXES:
        raise InputError(
            f"--axis is one of {', '.join(AXES)}, not {axis!r}: the direction in which the plug is removed"
        )
    pose = as_numbers(plug_pose, "--plug-pose")
    if pose.shape != (POSE_SIZE,) or not np.isfinite(pose).all():
        raise InputError(f"--plug-pose is {POSE_SIZE} finite numbers, not {brief(plug_pose)}")
    point = None if center is None else as_numbers(center, "--center")
    if point is not None and point.shape != (3,):
        raise InputError(f"--center is 3 numbers, not {brief(center)}")
    units = find_units((plug, socket), unit)
    if None in units:
        raise InputError(
            f"{(plug, socket)[units.index(None)].name} does not say its unit: give --unit {', '.join(UNITS)}"
        )
    plug_part, socket_part = (load_part(path, str(known)) for path, known in zip((plug, socket), units, strict=True))
    scale = UNITS[str(units[1])]
    plug_part = plug_part.transform(Rotation.from_euler("xyz", pose[3:] * DEGREE).as_matrix(), pose[:3] * scale)
    z = np.array(AXES[axis], dtype=float)
    x = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.5 else np.array([0.0, 1.0, 0.0])
    to_target = np.stack([x, np.cross(z, x), z])
    plug_part, socket_part = (part.transform(to_target, np.zeros(3)) for part in (plug_part, socket_part))
    gaps = np.maximum(plug_part.bounds[0] - socket_part.bounds[1], socket_part.bounds[0] - plug_part.bounds[1])
    if not gaps.max() <= MAX_GAP:
        raise InputError(
            f"the parts are {1e3 * gaps.max():.4g} mm apart: draw them assembled in one frame, or place the plug with "
            "--plug-pose"
        )
    origin = np.array([*compute_center_of_mass(plug_part)[:2], plug_part.bounds[0, 2]])
    if point is not None:
        on_axis = (to_target @ (point * scale))[:2]
        if not np.linalg.norm(on_axis - origin[:2]) <= MAX_CENTER:
            raise InputError(f"--center {point.tolist()} is not near the plug: give a point on the axis of insertion")
        origin[:2] = on_axis
    return plug_part.transform(np.eye(3), -origin), socket_part.transform(np.eye(3), -origin)


def create_task(
    plug: Path | str,
    socket: Path | str,
    out: Path | str,
    *,
    unit: str | None = None,
    plug_pose: Sequence[float] = (0.0,) * 6,
    axis: str = "+z",
    center: Sequence[float] | None = None,
    turn: float = 0.0,
    pitch: float = 0.0,
    search_turn: float = 0.0,
    shrink: float = 0.0,
    force_limit: float = COLLISION_FORCE,
    friction: float = 0.2,
    scenario: Sequence[Path | str] = (),
    hard_episodes: int = 10,
    only_insert: bool = False,
    log: Callable[[str], None] = lambda sentence: None,
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
        turn: Rotation of the plug at the bottom [degrees], counterclockwise seen from outside. The mesh files have the
            pose of the plug after this rotation.
        pitch: Advance of a screw per full turn during `turn` [m], positive if it is right-handed.
        search_turn: Largest unknown turn of the socket [degrees]; if positive, actions also turn the plug, for example
            to find the teeth of gears.
        shrink: Distance by which the plug's surface is moved inwards [m].
        force_limit: Contact force that ends an episode as a collision [N].
        friction: Friction coefficient of all surfaces.
        scenario: Files of Drake model directives (.dmd.yaml) of the surroundings.
        hard_episodes: Largest number of episodes of each baseline policy for each setting in the calibration of
            `difficulty=hard`; 0: no calibration.
        only_insert: True to stop after the scripted insertions and to delete the folder, for benchmarks.
        log: Function called with a sentence on each intermediate result.

    Raises:
        InputError: If `out` exists, an argument is invalid, the parts cannot be used, or none of the demonstrations
            that are checked in time seats the plug. After an error, no new folder is left.
    """
    plug, socket, out = _as_path(plug, "the plug"), _as_path(socket, "the socket"), _as_path(out, "--out")
    scenarios = [_as_path(file, "--scenario") for file in scenario]
    hard_episodes = as_whole(hard_episodes, "--hard-episodes", 0, MAX_EPISODES)
    check_new(out, "folder with --out, or remove it")
    _check_arguments(turn, pitch, search_turn, shrink, force_limit, friction, scenarios)
    start = cpu_time()
    parts = read_parts(plug, socket, unit, plug_pose, axis, center)
    for part in parts:
        if str(part.repair):
            log(f"{part.path.name}: {part.repair}")
    if shrink:
        parts = shrink_part(parts[0], shrink), parts[1]
        log(f"{plug.name}: its surface is moved inwards by {1e3 * shrink:g} mm (--shrink)")
    check_target(*parts)
    path = plan_motion(*parts, turn * DEGREE, START_HEIGHT, advance=abs(pitch * turn) / 360.0)
    clearance = measure_side_clearance(*parts, MAX_FLANK_SLOPE if pitch else MAX_WALL_SLOPE)
    log(f"{plug.name}: {_size(parts[0])}, {socket.name}: {_size(parts[1])}; the plug enters {1e3 * path.rim:.1f} mm")
    log(f"clearance between walls: {1e3 * clearance:.3f} mm" if np.isfinite(clearance) else "no walls face each other")
    tolerance = choose_tolerance(clearance)
    (lean_plug, plug_deviation), (lean_socket, socket_deviation) = (decimate(part, tolerance) for part in parts)
    overlap = plug_deviation + socket_deviation
    snapping = _snapping(lean_plug, lean_socket, path, overlap)
    yaw = max(MIN_YAW, (1.0 + COMMANDED_TURN) * search_turn * DEGREE)
    largest = max(plug_deviation, socket_deviation)
    both = prepare_surfaces(lean_plug, lean_socket, path, tolerance, largest, snapping, yaw)
    surfaces = dict(zip(("plug", "socket"), both, strict=True))
    deviation = max(part.repair.moved + surface.deviation for part, surface in zip(parts, both, strict=True))
    counts = ", ".join(
        f"{name} {sum(len(triangles) for _, triangles in part.bodies)} → {surface.num_triangles}"
        for part, (name, surface) in zip(parts, surfaces.items(), strict=True)
    )
    log(f"triangles: {counts}; {_describe_deviation(1e3 * deviation, 1e3 * clearance)}")
    # Symmetry augmentation leaves turns unchanged, but a reflection reverses the turn that the policy searches for.
    sides = ((), ()) if search_turn else find_symmetries(lean_plug, lean_socket, path, overlap)
    log(f"symmetry: {len(sides[0])} of 7 candidate rotations and reflections, {len(sides[1])} more on the rim")
    prepared = {
        "clearance_mm": round(1e3 * clearance, 4) if np.isfinite(clearance) else None,
        "deviation_mm": round(1e3 * deviation, 4),
        "repair": "; ".join(text for part in parts if (text := str(part.repair))) or "none",
        "triangles": [surface.num_triangles for surface in surfaces.values()],
        "preparation_s": _seconds_since(start),
    }
    values = {"name": out.name, "force_limit": force_limit, "friction": friction, "path": path, "sides": sides}
    values.update(scenario=tuple(file.name for file in scenarios), search_turn=search_turn)
    with atomic_folder(out) as folder:
        for file in scenarios:
            shutil.copy(file, folder / file.name)
        for name, surface in surfaces.items():
            (folder / f"{name}.obj").write_text(obj_text(*surface.visual), encoding="utf-8")
        make_file = partial(_task_file, parts, surfaces, values)
        choice = choose_contact(folder, surfaces, make_file, tolerance, clearance, log)
        task = make_file(choice.contact, choice.push)
        measured, search, first_contact = _measure(folder, task, choice, prepared, start, log)
        if not only_insert:
            task = task.model_copy(update={"search": search, "motion": _touching_at(task, first_contact, log)})
            from guiderail_parts.trial import add_contact_map, add_convex_pieces

            task = add_contact_map(folder, task, log)
            if not (scenarios or choice.contact.snapping):
                task = add_convex_pieces(folder, task, surfaces, tolerance, log)
            measured = _write_task(folder, task, choice, measured, hard_episodes, start, log)
    if only_insert:
        shutil.rmtree(out)
        return measured
    return {"task": str(out), **measured, "page": str(out / "preview.html")}


def _seconds_since(start: float) -> float:
    """Return the CPU time since `start`, a result of `cpu_time`, rounded to 0.01 s [s]."""
    return round(cpu_time() - start, 2)


def _describe_deviation(deviation: float, clearance: float | None) -> str:
    """Return the deviation as text, compared with the clearance if it is known and finite, both in millimeters."""
    text = f"deviation from the drawing at most {deviation:.4f} mm"
    if clearance is not None and np.isfinite(clearance) and deviation > 0.1 * clearance:
        text += f", which is more than a tenth of the clearance ({0.1 * clearance:.4f} mm)"
    return text


def _as_path(path: Path | str, what: str) -> Path:
    if not isinstance(path, str | os.PathLike):
        raise InputError(f"{what} must be the path of a file or folder, not {brief(path)}")
    return Path(path)


def _check_arguments(
    turn: float,
    pitch: float,
    search_turn: float,
    shrink: float,
    force_limit: float,
    friction: float,
    scenario: Sequence[Path],
) -> None:
    """Refuse invalid arguments at once; later steps would refuse them only after minutes."""
    values = {"turn": turn, "pitch": pitch, "search-turn": search_turn, "shrink": shrink, "force-limit": force_limit}
    for name, value in values.items():
        as_number(value, f"--{name}")
    if not abs(turn) <= MAX_TURN:
        raise InputError(f"--turn is at most {MAX_TURN:g} degrees either way, not {turn:g}")
    if not abs(pitch) <= MAX_PITCH:
        raise InputError(f"--pitch is at most {1e3 * MAX_PITCH:g} mm either way, not {1e3 * pitch:g}")
    if pitch and not turn:
        raise InputError("--pitch is the advance of a screw per full turn: give --turn, too")
    if pitch * turn > 0.0:
        raise InputError(
            "a right-handed screw (--pitch above 0) enters with --turn below 0, clockwise seen from outside, and a "
            f"left-handed one the other way round, not --pitch {1e3 * pitch:g} with --turn {turn:g}"
        )
    if not 0.0 <= search_turn <= MAX_SEARCH_TURN:
        raise InputError(f"--search-turn is from 0 to {MAX_SEARCH_TURN:g} degrees, not {search_turn:g}")
    if not FORCE_LIMITS[0] <= force_limit <= FORCE_LIMITS[1]:
        raise InputError("--force-limit is from {:g} to {:g} N, not {:g}".format(*FORCE_LIMITS, force_limit))
    if not 0.0 <= shrink <= MAX_SHRINK:
        raise InputError(f"--shrink is from 0 to {1e3 * MAX_SHRINK:g} mm, not {1e3 * shrink:g}")
    from guiderail.diagrams.envs.options import validate_options
    from guiderail_parts.task_file import Piece, is_plain_path

    validate_options(Piece, {"file": "plug.obj", "friction": friction}, "a part")
    names = [file.name for file in scenario]
    for file in scenario:
        if not file.is_file():
            raise InputError(f"there is no scenario {file}")
        if not file.name.endswith(".dmd.yaml"):
            raise InputError(f"{file} is not a scenario: name a .dmd.yaml file of Drake model directives")
        if "," in file.name:
            raise InputError(f"{file} has a comma in its name, which separates scenarios: rename it")
        if not is_plain_path(file.name):
            raise InputError(
                f"a scenario's name is letters, digits, blanks and _.()+-, not first a dot, and not {brief(file.name)}"
            )
        if names.count(file.name) > 1:
            raise InputError(f"two scenarios are called {file.name}, and both go into one folder: rename one")


def _snapping(plug: Part, socket: Part, path: InsertionMotion, deviation: float) -> frozenset[int]:
    """Return the indices of the plug's snapping bodies, which overlap the socket during the motion.

    `deviation` is the largest overlap caused by the decimation of both parts [m].

    Raises:
        InputError: If all bodies overlap: such a plug is a rigid part that does not fit.
    """
    overlaps = find_obstructions(plug, socket, path)
    blocked = frozenset(i for i, (depth, _) in enumerate(overlaps) if depth > MAX_RESTING_OVERLAP + deviation)
    if blocked and len(blocked) == len(overlaps):
        depth, height = max(overlaps)
        raise InputError(
            f"the plug does not pass the socket: {1e3 * height:.1f} mm above the target they overlap by about "
            f"{1e3 * depth:.2g} mm; give the direction in which it is removed with --axis (+y for files whose y points "
            "up), its rotation with --turn and --center, or draw the part that deflects as a separate body"
        )
    return blocked


def _measure(
    folder: Path,
    file: PartTaskFile,
    choice: Choice,
    prepared: dict[str, Any],
    start: float,
    log: Callable[[str], None],
) -> tuple[dict[str, Any], SearchNumbers, float | None]:
    """Return the measurements of the chosen contact, the numbers of the scripted search, and the first contact [m].

    The first contact is None if no misaligned plug was blocked.
    """
    from guiderail.diagrams.stations.station import PLANT_PERIOD
    from guiderail.diagrams.tasks.contact_probe import MAX_DRAG_ERROR, SPEEDS, drag
    from guiderail_parts.task import rim_contact, write_workcell
    from guiderail_parts.task_file import SearchNumbers
    from guiderail_parts.trial import insert, measure_first_contact, measure_lever_sign

    inserted_s, contact, aligned = _seconds_since(start), choice.contact, choice.aligned
    misaligned = choice.misaligned or tuple(
        insert(folder, file, offset=xy, snapping=contact.snapping_pieces) for xy in MISALIGNMENTS
    )
    if not choice.push:
        log(
            "nothing stops the plug at the seated pose, so the motion does not push: check the seated pose "
            "(--plug-pose), unless the hole is a through hole"
        )
    trials = (aligned, *misaligned)
    is_blocked = all(trial.is_blocked for trial in misaligned)
    result = "blocked (as required)" if is_blocked else "at the height of the target, but must be blocked"
    log(f"misaligned by 1.5 mm: {result}")
    deviation = prepared["deviation_mm"] + round(1e3 * contact.deviation, 4)
    if contact.deviation:
        total = _describe_deviation(deviation, prepared["clearance_mm"])
        log(f"{contact.compliant}: with its pieces, {total}")
    penetration, clearance = 1e3 * max(trial.penetration for trial in trials), prepared["clearance_mm"]
    if clearance is not None and penetration > 0.5 * clearance:
        log(f"penetration of {penetration:.3f} mm is more than half the clearance ({0.5 * clearance:.3f} mm)")
    contact_on_rim = rim_contact(file)
    ratio = drag(write_workcell(folder, file), contact_on_rim, SPEEDS[0], time_step=file.time_step)
    if np.isnan(ratio):
        log("a plug displaced along x does not stand on the rim, so the drag there was not measured")
    elif abs(ratio / contact_on_rim.friction - 1.0) > MAX_DRAG_ERROR:
        step = 1e3 * (file.time_step or PLANT_PERIOD)
        log(
            f"on the rim, drag / normal force is {ratio:.2f} at {1e3 * SPEEDS[0]:g} mm/s and {step:g} ms a step, and "
            f"the friction {contact_on_rim.friction:g}: the contact has not converged. The task can be trained; before "
            "numbers are quoted, check the policy at shorter steps and in another engine (guiderail converge)"
        )
    measured = {
        **prepared,
        "deviation_mm": round(deviation, 4),
        "preparation_s": round(prepared["preparation_s"] + choice.seconds, 2),
        "compliant": contact.compliant,
        "pieces": len(contact.pieces),
        "modulus": contact.modulus,
        "time_step_ms": None if contact.time_step is None else 1e3 * contact.time_step,
        "inserted": aligned.success,
        "blocked_1.5_mm_off": [trial.is_blocked for trial in misaligned],
        "force": round(aligned.peak_force, 2),
        "penetration_mm": round(1e3 * aligned.penetration, 4),
        "penetration_pushed_on_the_rim_mm": round(penetration, 4),
        "snap_mm": round(1e3 * aligned.snap, 4),
        "real_time_factor": round(min(trial.real_time_factor for trial in trials), 2),
        "drag": round(ratio, 3) if np.isfinite(ratio) else None,
        "inserted_s": inserted_s,
    }
    sign = measure_lever_sign([(xy, trial.recording) for xy, trial in zip(MISALIGNMENTS, misaligned, strict=True)])
    return measured, SearchNumbers.model_validate({"lever_sign": sign}), measure_first_contact(misaligned)


def _touching_at(file: PartTaskFile, first_contact: float | None, log: Callable[[str], None]) -> MotionNumbers:
    """Return the motion with the measured first contact [m]; unchanged if it is None or out of range."""
    if first_contact is None:
        log("no misaligned plug is blocked, so the height of the first contact is that at which the meshes overlap")
        return file.motion
    motion, rim = file.motion, file.motion.first_contact
    lowest = TOUCH + (motion.advance or 0.5 * file.tolerance.height)
    height = round(float(np.clip(first_contact, lowest + ROUNDING, rim)), 6)
    log(f"first contact: {1e3 * height:.2f} mm above the target; the meshes overlap from {1e3 * rim:.2f} mm")
    return motion.model_copy(update={"first_contact": height})


def _write_task(
    folder: Path,
    file: PartTaskFile,
    choice: Choice,
    measured: dict[str, Any],
    hard_episodes: int,
    start: float,
    log: Callable[[str], None],
) -> dict[str, Any]:
    """Write demonstrations, task file and preview page; return `measured` with the results of the demonstrations."""
    from guiderail_parts.difficulty import calibrate, force_limit_of
    from guiderail_parts.task_file import write_task_file
    from guiderail_parts.trial import demonstrate, num_components, write_preview

    # The friction of a plug that is pressed harder than an insertion needs holds it on the rim.
    environment = file.recommended.environment | {"force_limit": force_limit_of(file, measured["force"])}
    file = file.model_copy(update={"recommended": file.recommended.model_copy(update={"environment": environment})})
    duration = float(file.motion.plan_search()[0][-1])
    factor = max(measured["real_time_factor"], 0.01)  # rounding may make it 0
    log(f"recording demonstrations: about {NUM_DEMONSTRATIONS * duration / factor:.0f} s")
    succeeded, checked = demonstrate(folder, file)
    if not succeeded:
        raise InputError(
            f"none of the {checked} checked demonstrations seats the plug: check --plug-pose, --axis, "
            "--center and --turn, or give a larger --force-limit"
        )
    if succeeded < checked:
        log(
            f"only {succeeded} of {checked} checked demonstrations seat the plug: check clearance, friction and the "
            "axis if no policy learns the task"
        )
    unchecked = NUM_DEMONSTRATIONS - checked
    if unchecked:
        log(f"{unchecked} of {NUM_DEMONSTRATIONS} demonstrations are not checked: the others took too much CPU time")
    measured["demonstrations_seated"] = f"{succeeded} of {checked}" + (f", {unchecked} unchecked" if unchecked else "")
    measured["total_s"] = _seconds_since(start)
    # Stored, because finding the number of components again takes every training some seconds.
    fitted = file.demonstrations.model_copy(update={"components": num_components(folder, file)})
    file = file.model_copy(update={"measured": measured, "demonstrations": fitted})
    write_task_file(folder, file)
    mesh = read_obj(folder / file.plug.visual)
    radius = float(np.hypot(*mesh.vertices[mesh.triangles].reshape(-1, 3)[:, :2].T).max())
    if hard_episodes:
        log("calibrating difficulty=hard: several times as long as the demonstrations; --hard-episodes 0 leaves it out")
    file = calibrate(folder, file, radius, hard_episodes, log)
    if "hard" in file.measured:
        file.measured["hard"]["seconds"] = round(_seconds_since(start) - measured["total_s"], 2)
    write_task_file(folder, file)
    write_preview(folder / "preview.html", folder, file, choice.aligned)
    return file.measured


def _task_file(
    parts: tuple[Part, Part], surfaces: dict[str, ContactSurface], values: dict[str, Any], contact: Contact, push: float
) -> PartTaskFile:
    from guiderail.diagrams.envs.options import validate_options
    from guiderail_parts.task_file import NAMESPACE, MotionNumbers, PartModel, PartTaskFile, Piece, Tolerance

    path, friction = values["path"], values["friction"]
    models = {}
    for part, (name, surface) in zip(parts, surfaces.items(), strict=True):
        pieces = [{"file": f"{name}_surface.obj", "friction": friction}]
        if contact.compliant == name:
            pieces = [{"file": file, "modulus": modulus, "friction": friction} for file, modulus in contact.files]
        models[name] = PartModel(
            source=part.path.name,
            visual=f"{name}.obj",
            mass=round(max(1e-3, DENSITY * surface.volume), 6),
            center=tuple(np.round(compute_center_of_mass(part), 6).tolist()),
            gyration=round(compute_radius_of_gyration(part), 6),
            pieces=tuple(Piece.model_validate(piece) for piece in pieces),
            convex=(),
        )
    content: dict[str, Any] = dict(
        name=f"{NAMESPACE}/" + re.sub(r"[^\w.-]", "_", values["name"]),
        **models,
        scenario=values["scenario"],
        motion=validate_options(
            MotionNumbers,
            {
                "travel": path.travel,
                "first_contact": path.rim,  # until the trial insertions measure it
                "turn": float(path.turn / DEGREE),
                "advance": path.advance,
                "search_turn": values["search_turn"],
                "push": push,
            },
            "a motion",
        ),
        # Without a rotation at the bottom, the limit is wide: either the walls fix the plug's turn, or any turn fits.
        tolerance=Tolerance.model_validate({} if path.turn else {"turn": MAX_SEATED_TURN}),
        force_limit=values["force_limit"],
        time_step=contact.time_step,
        sides=values["sides"][0],
        rim_sides=values["sides"][1],
        **_turning(values["search_turn"]),
    )
    return validate_options(PartTaskFile, content, "a task of parts")


def _turning(search_turn: float) -> dict[str, Any]:
    """Return the values of a task file for actions that also turn the plug; empty without an unknown turn."""
    if not search_turn:
        return {}
    from guiderail_parts.task_file import PartTaskFile

    lateral, turn = PartTaskFile.model_fields["bounds"].default, COMMANDED_TURN * search_turn * DEGREE
    lower, upper = ((*row[:3], sign * turn, *row[4:]) for row, sign in ((lateral.lower, -1.0), (lateral.upper, 1.0)))
    return {"action_dims": (0, 1, 3), "bounds": {"lower": lower, "upper": upper}}


def _size(part: Part) -> str:
    return " × ".join(f"{1e3 * side:.1f}" for side in np.ptp(part.bounds, axis=0)) + " mm"


def ask_unit(paths: Sequence[Path], given: str | None) -> str | None:
    """Return the `given` unit; if it is None and the format of a file defines none, ask for it on a terminal."""
    if given is not None or all(find_unit(path, None) for path in paths) or not sys.stdin.isatty():
        return given
    if any(not path.is_file() for path in paths):
        return given  # reading the files raises a clearer error later
    try:
        # The prompt is written to standard error, because a program may parse standard output.
        print(f"What is one unit of {paths[0].name}? ({', '.join(UNITS)}) [mm] ", end="", file=sys.stderr, flush=True)
        return input().strip() or "mm"
    except EOFError:
        return None
