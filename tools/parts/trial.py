"""Scripted insertions on a gantry: trials of a contact geometry, demonstrations, and the preview of a task."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydrake.geometry import MeshcatAnimation, Rgba, SurfaceTriangle, TriangleSurfaceMesh
from pydrake.math import RigidTransform
from pydrake.systems.framework import EventStatus

from guiderail.diagrams.envs.meshcat_page import MeshcatPage
from guiderail.diagrams.envs.recording import DrivenStation, along, drive_along
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.diagrams.tasks.part.file import PartTaskFile
from guiderail.diagrams.tasks.part.task import PartInsertion, write_workcell
from guiderail.diagrams.tasks.part.workcell import PLUG, SOCKET
from guiderail.models.common.errors import InputError
from guiderail.models.objects.bnc_connector.demonstrations import NAMES
from guiderail.models.parts.assembly_check import find_nearest_on_surface
from guiderail.models.parts.demonstrator import (
    NUM_DEMONSTRATIONS,
    demonstrator_motions,
    plan_search,
    plan_straight_insertion,
)
from guiderail.models.primitives import Demonstrations
from guiderail.systems.recorder import Recording
from guiderail.systems.support.drake_poses import pose_to_transform

_VERTICES = 8  # number of vertices of a contact surface, those of the highest pressure, for which depth is measured
_INTERVAL = 4  # simulator steps between two measurements of depth


@dataclass(frozen=True)
class Trial:
    """Result of a scripted insertion.

    Attributes:
        success: Whether the plug reached the target.
        pose: Final pose of the plug in the socket, position and rotation vector (6,) [m, rad].
        peak_force: Largest contact force [N].
        penetration: Largest penetration of the parts [m], without snapping pieces.
        snap: Largest penetration of snapping pieces [m].
        real_time_factor: Simulated time per CPU time.
        recording: Poses, wrench and force at the control steps.
    """

    success: bool
    pose: np.ndarray
    peak_force: float
    penetration: float
    snap: float
    real_time_factor: float
    recording: Recording


class Depths:
    """Penetration of the parts, measured from Drake's contact surfaces.

    A contact surface lies in the surface of the rigid part; the depth of a vertex is its distance from the surface of
    the compliant part.

    Attributes:
        deepest: Largest penetration so far [m], without snapping pieces.
        deepest_snap: Largest penetration of snapping pieces so far [m].
        seconds: CPU time of the measurements [s].
    """

    def __init__(self, station: GantryStation, surfaces: dict[str, np.ndarray], snapping: set[str]):
        """Construct the measurement.

        Args:
            station: Station with the parts.
            surfaces: Triangles (T, 3, 3) [m] of each compliant body by name, in its own frame.
            snapping: Names of geometries that overlap on purpose.
        """
        self._station, self._surfaces, self._snapping = station, surfaces, snapping
        self.deepest = self.deepest_snap = 0.0
        self.seconds = 0.0

    def monitor(self, root_context: Any) -> EventStatus:
        """Measure the current contacts."""
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
                X_BW = body.EvalPoseInWorld(context).inverse()
                inside = X_BW.multiply(points.T).T
                snaps = any(inspector.GetName(one).split("::")[-1] in self._snapping for one in ids)
                depth = float(find_nearest_on_surface(inside, self._surfaces[body.name()])[1].max())
                if snaps:
                    self.deepest_snap = max(self.deepest_snap, depth)
                else:
                    self.deepest = max(self.deepest, depth)
        self.seconds += time.process_time() - start
        return EventStatus.DidNothing()


def insert(
    folder: Path,
    file: PartTaskFile,
    *,
    offset: tuple[float, float] = (0.0, 0.0),
    motion: tuple[np.ndarray, np.ndarray] | None = None,
    snapping: frozenset[str] = frozenset(),
    measure_depth: bool = True,
) -> Trial:
    """Move the plug along a scripted motion on a gantry, and return the result.

    Args:
        folder: Folder with the meshes.
        file: Task file, which need not be written yet.
        offset: Offset (x, y) of the socket [m].
        motion: Times and poses; straight in by default.
        snapping: Names of pieces, such as `piece_1` of the plug, that overlap the socket on purpose.
        measure_depth: Whether penetration is measured, which takes longer than the simulation.
    """
    numbers = file.motion
    times, poses = (
        plan_straight_insertion(numbers.travel, numbers.rim, file.turn, numbers.push) if motion is None else motion
    )
    workcell = write_workcell(folder, file)
    station = GantryStation(workcell, time_step=file.time_step)
    driven = DrivenStation(station, along(times, poses), num_samples=round(times[-1] / CONTROL_PERIOD))
    workcell.set_fixture_offset(station.plant, driven.plant_context, RigidTransform([*offset, 0.0]))
    compliant = {
        name: triangles_of(folder / part.visual)
        for name, part in ((PLUG, file.plug), (SOCKET, file.socket))
        if part.pieces[0].modulus is not None
    }
    depths = Depths(station, compliant, set(snapping))
    driven.start(poses[0])
    if measure_depth:
        steps = [0]

        def monitor(root_context: Any) -> EventStatus:
            steps[0] += 1
            return depths.monitor(root_context) if steps[0] % _INTERVAL == 0 else EventStatus.DidNothing()

        driven.simulator.set_monitor(monitor)
    start = time.process_time()
    recording = driven.run()
    spent = time.process_time() - start - depths.seconds
    pose = _plug_pose(driven)
    return Trial(
        success=_is_seated(file, pose),
        pose=pose,
        peak_force=float(recording["contact_force"].max()),
        penetration=depths.deepest,
        snap=depths.deepest_snap,
        real_time_factor=float(times[-1] / max(spent, 1e-9)),
        recording=recording,
    )


def _plug_pose(driven: DrivenStation) -> np.ndarray:
    """Return the pose of the plug in the socket, position and rotation vector (6,) [m, rad]."""
    plant = driven.station.plant
    X = plant.GetFrameByName(PLUG).CalcPose(driven.plant_context, plant.GetFrameByName(SOCKET))
    rotation = X.rotation().ToAngleAxis()
    return np.concatenate([X.translation(), rotation.angle() * rotation.axis()])


def _is_seated(file: PartTaskFile, pose: np.ndarray) -> bool:
    task: Any = type("Task", (PartInsertion,), {"file": file})
    return bool(task.is_seated(pose))


def triangles_of(path: Path) -> np.ndarray:
    """Return the triangles (T, 3, 3) [m] of an OBJ file of a task folder."""
    vertices, corners = [], []
    for line in path.read_text(encoding="utf-8").splitlines():
        kind, *rest = line.split()
        if kind == "v":
            vertices.append([float(one) for one in rest])
        elif kind == "f":
            corners.append([int(one.split("/")[0]) - 1 for one in rest])
    return np.array(vertices)[np.array(corners)]


_SOLID = {"plug": Rgba(0.85, 0.65, 0.25, 1.0), "socket": Rgba(0.62, 0.64, 0.68, 0.45)}
_SCALE = 10.0  # enlarges parts of some centimeters, which are too close to the page's camera


def write_preview(page: Path, folder: Path, file: PartTaskFile, trial: Trial) -> None:
    """Write the page of a trial: the parts, and hidden at first the contact pieces, each in its own color."""
    try:
        meshcat = MeshcatPage(is_served=False)
    except RuntimeError as error:
        raise InputError(f"the preview can't be made ({error}): set DRAKE_ALLOW_NETWORK=meshcat") from error
    rng = np.random.default_rng(2)
    for name, part in (("plug", file.plug), ("socket", file.socket)):
        _show(meshcat, f"/{name}/seen", folder / part.visual, _SOLID[name])
        for piece in part.pieces:
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
    corners = _SCALE * triangles_of(file).reshape(-1, 3)
    triangles = [SurfaceTriangle(3 * i, 3 * i + 1, 3 * i + 2) for i in range(len(corners) // 3)]
    meshcat.SetObject(path, TriangleSurfaceMesh(triangles, list(corners)), color)


MAX_SESSIONS = 3  # sessions of five attempts, until five attempts have seated the plug


def demonstrate(folder: Path, file: PartTaskFile) -> int:
    """Write the demonstrations; return how many of them seat the plug."""
    numbers = file.motion
    script = plan_search(numbers.travel, numbers.rim, file.turn, numbers.push, numbers.press)
    times = CONTROL_PERIOD * np.arange(round(script[0][-1] / CONTROL_PERIOD) + 1)
    seated: list[np.ndarray] = []
    others: list[np.ndarray] = []
    for seed in range(MAX_SESSIONS):
        for motion in demonstrator_motions(seed, script, numbers.rim - numbers.press - 1e-3, times):
            if len(seated) < NUM_DEMONSTRATIONS:
                (seated if _seats(folder, file, times, motion) else others).append(motion)
    chosen = (seated + others)[:NUM_DEMONSTRATIONS]
    Demonstrations([times] * len(chosen), chosen, NAMES).save(folder / file.demonstrations.file)
    return len(seated)


def _seats(folder: Path, file: PartTaskFile, times: np.ndarray, motion: np.ndarray) -> bool:
    driven, _ = drive_along(GantryStation(write_workcell(folder, file), time_step=file.time_step), times, motion)
    return _is_seated(file, _plug_pose(driven))
