"""Scripted insertions: trials of a contact geometry in two engines, demonstrations, and the preview of a task."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import MeshcatAnimation, Rgba, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform
from pydrake.systems.framework import EventStatus

from guiderail.diagrams.envs.meshcat_page import MeshcatPage
from guiderail.diagrams.envs.recording import DrivenStation, drive_along, linear_motion
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.options import MIN_CONTACT_FORCE, control_steps
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import MissingSiblingError, load_plugin, require_sibling
from guiderail.models.common.transforms import DEGREE, POSE_NAMES
from guiderail.models.control.wrench import center_of_pressure
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.mixture import fit_mixture
from guiderail.systems.recorder import Recording
from guiderail.systems.support.drake_multibody import pose_to_transform, transform_to_vector
from guiderail_parts.contact_map import measure_contact_map
from guiderail_parts.geometry.demonstrator import demonstrator_motions, socket_offsets, socket_turns
from guiderail_parts.geometry.drake_check import piece_text
from guiderail_parts.geometry.obj_file import read_obj
from guiderail_parts.geometry.preparation import CUT_SECONDS, ContactSurface, cut_bodies
from guiderail_parts.geometry.solids import SurfaceLocator
from guiderail_parts.isolation import IsolatedError, run_isolated
from guiderail_parts.task import PLUG, SOCKET, write_workcell
from guiderail_parts.task_file import PartModel, PartTaskFile

_VERTICES = 8  # number of vertices with the highest pressure at which the depth of a contact surface is measured
_AT_REST = 1.0  # time before the end of a motion from which the plug counts as resting [s]
_BLOCKED, _BLOCKED_TIME = 8e-3, 0.5  # a trial ends if the command is this far below the plug [m] for this time [s]
_INTERVAL = 4  # simulator steps between two measurements of depth


@dataclass(frozen=True)
class Trial:
    """Result of a scripted insertion."""

    success: bool  # True if the plug reached the target
    is_blocked: bool  # True if the plug always stayed above the target by more than the height tolerance
    pose: np.ndarray  # final pose of the plug in the socket, position and rotation vector (6,) [m, rad]
    lowest: float  # smallest height of the plug above the target [m]
    peak_force: float  # largest contact force [N]
    penetration: float  # largest penetration of the parts [m], without snapping pieces
    resting_penetration: float  # largest penetration at the end of the motion, while the resting plug is pushed [m]
    snap: float  # largest penetration of snapping pieces [m]
    real_time_factor: float  # ratio of simulated time to CPU time; the simulation of a blocked plug ends early
    recording: Recording  # recorded signals, `SIGNALS` of `guiderail.diagrams.envs.recording`


class Depths:
    """Penetration of the parts, measured from Drake's contact surfaces.

    A contact surface lies in the surface of the rigid part; the depth of a vertex is its distance from the surface of
    the compliant part.

    Attributes:
        deepest: Largest penetration so far [m], without snapping pieces.
        deepest_at_rest: Largest penetration while the plug is at rest [m], without snapping pieces.
        deepest_snap: Largest penetration of snapping pieces so far [m].
        seconds: CPU time of the measurements [s].
    """

    def __init__(
        self, station: GantryStation, surfaces: dict[str, SurfaceLocator], snapping: set[str], rest_from: float
    ):
        """Construct the measurement.

        Args:
            station: Station with the parts.
            surfaces: Surface [m] of each compliant body by name, in its own frame.
            snapping: Names of geometries that overlap on purpose.
            rest_from: Time from which the plug rests, although it is still pushed [s].
        """
        self._station, self._surfaces, self._snapping = station, surfaces, snapping
        self._rest_from = rest_from
        self.deepest = self.deepest_at_rest = self.deepest_snap = 0.0
        self.seconds = 0.0

    def monitor(self, root_context: Any) -> EventStatus:
        """Measure the current contacts, as the simulator's monitor."""
        start = time.process_time()
        plant = self._station.plant
        context = plant.GetMyContextFromRoot(root_context)
        results = plant.get_contact_results_output_port().Eval(context)
        inspector = self._station.scene_graph.model_inspector()
        for number in range(results.num_hydroelastic_contacts()):
            surface = results.hydroelastic_contact_info(number).contact_surface()
            mesh = surface.tri_mesh_W() if surface.is_triangle() else surface.poly_mesh_W()
            field = surface.tri_e_MN() if surface.is_triangle() else surface.poly_e_MN()
            pressures = np.array([field.EvaluateAtVertex(i) for i in range(mesh.num_vertices())])
            points = np.array([mesh.vertex(int(i)) for i in np.argsort(pressures)[-_VERTICES:]])
            ids = (surface.id_M(), surface.id_N())
            for geometry in ids:
                body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
                if body.name() not in self._surfaces:
                    continue
                points_B = body.EvalPoseInWorld(context).inverse().multiply(points.T).T
                depth = float(self._surfaces[body.name()].find_nearest(points_B.reshape(-1, 3))[1].max())
                if any(inspector.GetName(geometry_id).split("::")[-1] in self._snapping for geometry_id in ids):
                    self.deepest_snap = max(self.deepest_snap, depth)
                else:
                    self.deepest = max(self.deepest, depth)
                    if root_context.get_time() >= self._rest_from:
                        self.deepest_at_rest = max(self.deepest_at_rest, depth)
        self.seconds += time.process_time() - start
        return EventStatus.DidNothing()


def insert(
    folder: Path,
    file: PartTaskFile,
    *,
    offset: tuple[float, float] = (0.0, 0.0),
    snapping: frozenset[str] = frozenset(),
) -> Trial:
    """Insert the plug straight on a gantry, and return the result.

    Args:
        folder: Folder with the meshes.
        file: Task file, which need not be written yet.
        offset: Offset (x, y) of the socket [m].
        snapping: Names of pieces, such as `piece_1` of the plug, that overlap the socket on purpose.
    """
    times, poses = file.motion.plan_straight_insertion()
    workcell = write_workcell(folder, file)
    station = GantryStation(workcell, time_step=file.time_step)
    driven = DrivenStation(station, linear_motion(times, poses), num_samples=round(times[-1] / CONTROL_PERIOD))
    workcell.set_fixture_offset(station.plant, driven.plant_context, RigidTransform([*offset, 0.0]))
    compliant = {}
    for name, part in ((PLUG, file.plug), (SOCKET, file.socket)):
        if part.pieces[0].modulus is not None:
            mesh = read_obj(folder / part.visual)
            compliant[name] = SurfaceLocator(mesh.vertices, mesh.triangles)
    depths = Depths(station, compliant, set(snapping), times[-1] - _AT_REST)
    driven.start(poses[0])
    steps, blocked, lowest = 0, 0, np.inf

    def monitor(root_context: Any) -> EventStatus:
        nonlocal steps, blocked, lowest
        steps += 1
        if steps % _INTERVAL:
            return EventStatus.DidNothing()
        depths.monitor(root_context)
        now = root_context.get_time()
        # A plug that stays far above its command is blocked. Stop then, because the rest would simulate slowly.
        height = _plug_pose(driven)[2]
        lowest = min(lowest, height)
        blocked = blocked + 1 if height - np.interp(now, times, poses[:, 2]) > _BLOCKED else 0
        if blocked * _INTERVAL * station.plant.time_step() < _BLOCKED_TIME:
            return EventStatus.DidNothing()
        return EventStatus.ReachedTermination(station, "blocked")

    driven.simulator.set_monitor(monitor)
    start = time.process_time()
    recording = driven.run()
    driven.simulator.clear_monitor()  # Drake never frees the diagram, and the monitor holds the surfaces in memory
    spent = time.process_time() - start - depths.seconds
    pose = _plug_pose(driven)
    lowest = float(min(lowest, pose[2]))
    return Trial(
        success=file.tolerance.accepts(pose),
        is_blocked=lowest > file.tolerance.height,
        pose=pose,
        lowest=lowest,
        peak_force=float(recording["impedance_force"].max()),
        penetration=depths.deepest,
        resting_penetration=depths.deepest_at_rest,
        snap=depths.deepest_snap,
        real_time_factor=float(driven.context.get_time() / max(spent, 1e-9)),
        recording=recording,
    )


def _plug_pose(driven: DrivenStation) -> np.ndarray:
    """Return the pose of the plug in the socket, position and rotation vector (6,) [m, rad]."""
    plant = driven.station.plant
    return transform_to_vector(plant.GetFrameByName(PLUG).CalcPose(driven.plant_context, plant.GetFrameByName(SOCKET)))


def measure_lever_sign(pushed: Sequence[tuple[tuple[float, float], Recording]]) -> int:
    """Return 1 if the center of pressure of a misaligned plug lies towards the socket's axis, otherwise -1.

    `pushed` has the offset (x, y) of the socket [m] and the recording of each trial.
    """
    towards = 0.0
    for offset, recording in pushed:
        levers = [center_of_pressure(wrench, MIN_CONTACT_FORCE) for wrench in recording["wrench"]]
        towards += float(np.sum(np.asarray(levers) @ np.asarray(offset)))
    return 1 if towards > 0.0 else -1


def measure_first_contact(trials: Sequence[Trial]) -> float | None:
    """Return the height at which a misaligned plug first touches the socket [m]; None if no trial was blocked.

    It is the median over the blocked `trials`. Meshes can overlap in height long before the parts touch.
    """
    heights = [
        recording["pose"][touches.argmax(), 2]
        for recording in (trial.recording for trial in trials if trial.is_blocked)
        if (touches := np.asarray(recording["wrench"])[:, 2] >= MIN_CONTACT_FORCE).any()
    ]
    return float(np.median(heights)) if heights else None


CONTACT_MAP = "contact_map.csv"  # name of the file in a task folder


def add_contact_map(folder: Path, file: PartTaskFile, log: Callable[[str], None]) -> PartTaskFile:
    """Measure the contact map, write it into the folder, and return the task file that names it.

    The file is returned unchanged if the plug never touches the socket.
    """
    station = GantryStation(write_workcell(folder, file), time_step=file.time_step)
    contact_map = measure_contact_map(station, file.motion)
    if contact_map is None:
        log("no contact map: the plug never touched the socket, so a general policy does not know where the socket is")
        return file
    contact_map.save(folder / CONTACT_MAP)
    log(f"contact map: {len(contact_map.positions)} samples")
    return file.model_copy(update={"search": file.search.model_copy(update={"contact_map": CONTACT_MAP})})


_SOLID = {"plug": Rgba(0.85, 0.65, 0.25, 1.0), "socket": Rgba(0.62, 0.64, 0.68, 0.45)}
_SCALE = 10.0  # magnification, because the page's camera cannot get close to small parts


def write_preview(page: Path, folder: Path, file: PartTaskFile, trial: Trial) -> None:
    """Write a page that animates a trial: the parts and, initially hidden, the contact pieces in different colors.

    The meshes are those of `file` in `folder`.

    Raises:
        InputError: If the environment forbids Drake to open a network port.
    """
    try:
        meshcat = MeshcatPage(is_served=False)
    except RuntimeError as error:
        raise InputError(f"the preview can't be made ({error}): set DRAKE_ALLOW_NETWORK=meshcat") from error
    rng = np.random.default_rng(2)
    for name, part in (("plug", file.plug), ("socket", file.socket)):
        _show(meshcat, f"/{name}/seen", folder / part.visual, _SOLID[name])
        for piece in part.pieces:
            if not piece.file.endswith(".obj"):
                continue  # Meshcat cannot render tetrahedra
            color = Rgba(*rng.uniform(0.25, 0.95, 3), 1.0)
            _show(meshcat, f"/{name}/contact/{Path(piece.file).stem}", folder / piece.file, color)
        meshcat.SetProperty(f"/{name}/contact", "visible", False)
    animation = MeshcatAnimation(frames_per_second=1.0 / CONTROL_PERIOD)
    poses: Any = trial.recording["pose"]
    for frame, pose in enumerate(poses):
        X = pose_to_transform(pose)
        animation.SetTransform(frame, "/plug", RigidTransform(X.rotation(), _SCALE * X.translation()))
    meshcat.SetAnimation(animation)
    size = _SCALE * file.motion.travel
    meshcat.SetCameraPose(np.array([3.0, -4.0, 3.5]) * size, np.array([0.0, 0.0, 0.5 * size]))
    page.write_text(meshcat.StaticHtml(), encoding="utf-8")


def _show(meshcat: Any, path: str, file: Path, color: Any) -> None:
    mesh = read_obj(file)
    corners = _SCALE * mesh.vertices[mesh.triangles].reshape(-1, 3)
    triangles = [SurfaceTriangle(3 * i, 3 * i + 1, 3 * i + 2) for i in range(len(corners) // 3)]
    meshcat.SetObject(path, TriangleSurfaceMesh(triangles, list(corners)), color)


DEMONSTRATION_SECONDS = 40.0  # CPU time after which demonstrations are written unchecked [s]
MAX_SESSIONS = 3  # largest number of attempts at each demonstration; the first that seats the plug is used


def demonstrate(folder: Path, file: PartTaskFile) -> tuple[int, int]:
    """Write the demonstrations; return the number that seat the plug, and the number that were checked in time."""
    numbers, script = file.motion, file.motion.plan_search()
    times = CONTROL_PERIOD * np.arange(round(script[0][-1] / CONTROL_PERIOD) + 1)
    press_from = numbers.first_contact - numbers.press - 1e-3
    search_turn = numbers.search_turn * DEGREE
    sessions = [demonstrator_motions(seed, script, press_from, times, search_turn) for seed in range(MAX_SESSIONS)]
    sockets = np.column_stack([socket_offsets(), socket_turns(search_turn)])
    start = time.process_time()
    chosen: list[np.ndarray] = []
    seated = checked = 0
    for attempts, socket in zip(zip(*sessions, strict=True), sockets, strict=True):
        is_checked = False
        for motion in attempts:
            in_time = time.process_time() - start < DEMONSTRATION_SECONDS
            is_checked = is_checked or in_time
            if in_time and _seats(folder, file, times, motion, socket):
                chosen.append(motion)
                seated += 1
                break
        else:
            chosen.append(attempts[0])
        checked += is_checked
    Demonstrations([times] * len(chosen), chosen, POSE_NAMES).save(folder / file.demonstrations.file)
    return seated, checked


def num_components(folder: Path, file: PartTaskFile) -> int:
    """Return the number of components of the demonstrations' mixture, by the Bayesian information criterion."""
    recorded = Demonstrations.load(folder / file.demonstrations.file)
    resampled = recorded.resampled(control_steps(recorded))
    return len(fit_mixture(resampled.times[0], np.stack(resampled.outputs), components=None, seed=0).weights)


def _seats(folder: Path, file: PartTaskFile, times: np.ndarray, motion: np.ndarray, socket: np.ndarray) -> bool:
    """Return True if a motion seats the plug in a socket at (x, y, Rz) [m, rad]."""
    in_socket = motion.copy()  # on a gantry, moving the plug by the inverse is equivalent to displacing the socket
    cosine, sine = np.cos(socket[2]), np.sin(socket[2])
    in_socket[:, :2] = (motion[:, :2] - socket[:2]) @ np.array([[cosine, -sine], [sine, cosine]])
    in_socket[:, 3] -= socket[2]
    driven, _ = drive_along(GantryStation(write_workcell(folder, file), time_step=file.time_step), times, in_socket)
    return file.tolerance.accepts(_plug_pose(driven))


CHECK_SECONDS = 30  # largest CPU time of the insertions in MuJoCo [s]
OFFSET = 3.5e-3  # lateral offset at which the socket must block the plug [m]


def add_convex_pieces(
    folder: Path,
    file: PartTaskFile,
    surfaces: dict[str, ContactSurface],
    tolerance: float,
    log: Callable[[str], None],
) -> PartTaskFile:
    """Return the task file with the names of both parts' convex pieces; unchanged if cutting or an insertion fails.

    It is also unchanged if guiderail-mujoco is not installed.

    If the contact geometry of a part consists of convex pieces, they are used. Otherwise pieces are cut from its
    surface and written; they may exceed the surface by twice the `tolerance` [m]. A sentence on the result is logged.
    """
    written: list[Path] = []
    changes: dict[str, PartModel] = {}
    try:
        require_sibling("mujoco", "station=mujoco")
        for name, model in (("plug", file.plug), ("socket", file.socket)):
            names = [piece.file for piece in model.pieces if piece.modulus is not None and piece.file.endswith(".obj")]
            if len(names) < len(model.pieces):
                cut = run_isolated(cut_bodies, surfaces[name], tolerance, cpu_seconds=CUT_SECONDS)
                if cut is None:
                    raise IsolatedError(f"the {name} is too intricate for convex pieces")
                names = [f"{name}_convex_{number}.obj" for number in range(len(cut[0]))]
                for new, piece in zip(names, cut[0], strict=True):
                    written.append(folder / new)
                    written[-1].write_text(piece_text(piece), encoding="utf-8")
            changes[name] = model.model_copy(update={"convex": tuple(names)})
        changed = file.model_copy(update=changes)
        (is_seated, _), (_, is_blocked) = run_isolated(
            lambda: [insert_in_mujoco(folder, changed, offset) for offset in (0.0, OFFSET)], cpu_seconds=CHECK_SECONDS
        )
        if not is_seated or not is_blocked:
            raise IsolatedError(
                "an aligned plug does not seat" if not is_seated else "a misaligned plug is not blocked"
            )
    except (IsolatedError, MissingSiblingError) as error:
        log(f"station=mujoco is not offered: {error}")
        for path in written:
            path.unlink(missing_ok=True)
        return file
    log(f"station=mujoco: inserted ({' + '.join(str(len(model.convex)) for model in changes.values())} convex pieces)")
    return changed


def insert_in_mujoco(folder: Path, file: PartTaskFile, offset: float = 0.0) -> tuple[bool, bool]:
    """Insert the plug straight on `station=mujoco`, at an `offset` along x [m]; return the flags seated and blocked.

    A seated plug is at the target at the end. A blocked plug always stays above the target by more than the height
    tolerance. If the plug is pushed down next to the target, both flags are False. The task file need not be written
    yet.
    """
    times, poses = file.motion.plan_straight_insertion()
    poses[:, 0] += offset
    station = load_plugin("station", "mujoco", "mujoco")(write_workcell(folder, file), time_step=file.time_step)
    _, recording = drive_along(station, times, poses)
    x, y, z, Rz, Ry, Rx = recording["pose"][-1]
    is_seated = file.tolerance.accepts(np.array([x, y, z, Rx, Ry, Rz]))  # tilts are small
    return is_seated, bool(np.min(recording["pose"][:, 2]) > file.tolerance.height)
