"""Drawing of a task: cameras, the browser view, viewpoints, and the lines that are drawn next to the robot."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import (
    ClippingRange,
    ColorRenderCamera,
    DepthRange,
    DepthRenderCamera,
    LightParameter,
    MakeRenderEngineVtk,
    Meshcat,
    MeshcatVisualizer,
    MeshcatVisualizerParams,
    RenderCameraCore,
    RenderEngineVtkParams,
    Role,
)
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.meshcat import ContactVisualizer, ContactVisualizerParams
from pydrake.multibody.plant import ContactResults
from pydrake.systems.framework import Context, DiagramBuilder, EventStatus, OutputPort
from pydrake.systems.sensors import CameraInfo, RgbdSensor

from guiderail.diagrams.envs.meshcat_page import MeshcatPage
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError

_OBSERVATION_RENDERER, _PICTURE_RENDERER = "vtk", "vtk_picture"
PUBLISH_PERIOD = 1 / 50  # simulated time between two publications of a browser view [s]
# Scale of the drawn contacts: 20 N and 2 Nm have the length of a hand.
NEWTONS_PER_METER, NEWTON_METERS_PER_METER = 200.0, 20.0


# Observations have Drake's default light, from the camera. Pictures have a white background and light from above, which
# shows edges better.
_LIGHTS = [
    LightParameter(type="directional", frame="camera", direction=[0.3, 0.2, 1.0], intensity=0.7),
    LightParameter(type="directional", frame="world", direction=[-0.2, 0.3, -1.0], intensity=0.5),
]
_PARAMETERS = {
    _OBSERVATION_RENDERER: RenderEngineVtkParams(),
    _PICTURE_RENDERER: RenderEngineVtkParams(default_clear_color=[1.0, 1.0, 1.0], lights=_LIGHTS),
}


@dataclass(frozen=True)
class Camera:
    """Camera that is fixed in the world or in a frame of the plant, such as a wrist camera."""

    size: tuple[int, int]  # width and height of its image [pixels]
    vertical_fov: float  # vertical field of view [rad]
    # Pose of the camera in the world, or in `frame`; C has x to the right, y down and z into the picture.
    X_WC: RigidTransform
    frame: str | None = None  # name of the frame of the plant that carries the camera; None: the world

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return the pixel coordinates (n, 2), from the upper left corner, of points (n, 3) in the world [m].

        Raises:
            InputError: If the camera is not fixed in the world.
        """
        if self.frame is not None:
            raise InputError(
                f"a camera that moves with the frame {self.frame!r} has no fixed pose to project points of the world "
                "with: use a camera that is fixed in the world"
            )
        p_C = self.X_WC.inverse() @ np.asarray(points, float).T
        focal = 0.5 * self.size[1] / np.tan(0.5 * self.vertical_fov)
        return (focal * p_C[:2] / p_C[2]).T + 0.5 * np.array(self.size)


def look_at(eye: np.ndarray, target: np.ndarray) -> RigidTransform:
    """Return the pose X_WC of a camera at `eye` (3,) that looks at `target` (3,), with a level horizon.

    Raises:
        InputError: If the camera looks straight up or down, where no horizon is level, or the two points are equal.
    """
    if not np.hypot(target[0] - eye[0], target[1] - eye[1]) > 0.0:
        raise InputError(f"a camera at {eye} cannot look at {target} with a level horizon: write its pose instead")
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return RigidTransform(RotationMatrix(np.stack([right, np.cross(forward, right), forward], axis=1)), eye)


def front_camera(target: np.ndarray, distance: float, height: float) -> Camera:
    """Return a camera that looks slightly down at `target` (3,) from the side opposite the arm; lengths in m."""
    X_WC = look_at(target + np.array([0.8 * distance, -0.6 * distance, height]), target)
    return Camera((640, 480), np.deg2rad(30.0), X_WC)


def add_camera(
    builder: DiagramBuilder, station: Any, name: str, camera: Camera, *, is_picture: bool = False
) -> OutputPort:
    """Add a camera in a station's scene and return the port of its color image, an `ImageRgba8U`.

    With `is_picture`, the scene is lit for a picture instead of an observation. An image is rendered only when the port
    is evaluated.

    Raises:
        InputError: If the station has no scene, this machine lacks the library that renders without a display, or the
            station's plant lacks the camera's frame.
    """
    query, scene_graph = scene_of(station), station.scene_graph
    check_rendering()
    parent, X_PC = scene_graph.world_frame_id(), camera.X_WC
    if camera.frame is not None:
        if not station.plant.HasFrameNamed(camera.frame):
            raise InputError(f"this station has no frame {camera.frame!r} for a camera: choose another observation")
        carrier = station.plant.GetFrameByName(camera.frame)
        parent = station.plant.GetBodyFrameIdOrThrow(carrier.body().index())
        X_PC = carrier.GetFixedPoseInBodyFrame() @ camera.X_WC
    # Mesa and Triton, a dependency of PyTorch with CUDA, load different versions of LLVM. If Triton's is loaded second,
    # the process ends with a segmentation fault. PyTorch imports Triton late, with its compiler.
    with suppress(ImportError):
        import_module("triton")
    renderer = _PICTURE_RENDERER if is_picture else _OBSERVATION_RENDERER
    if not scene_graph.HasRenderer(renderer):
        scene_graph.AddRenderer(renderer, MakeRenderEngineVtk(_PARAMETERS[renderer]))
    clipping = ClippingRange(0.01, 10.0)
    info = CameraInfo(*camera.size, camera.vertical_fov)
    core = RenderCameraCore(renderer, info, clipping, RigidTransform())
    sensor = RgbdSensor(
        parent_id=parent,
        X_PB=X_PC,
        color_camera=ColorRenderCamera(core, show_window=False),
        depth_camera=DepthRenderCamera(core, DepthRange(0.02, 9.0)),
    )
    return add_system(builder, name, sensor, query).color_image_output_port()


def add_picture(builder: DiagramBuilder, station: Any, camera: Camera | None, task: str) -> None:
    """Add the camera for pictures of a task and export its image; `task` is the name of the task.

    Raises:
        InputError: If the task has no camera, the station has no scene, or as `add_camera`.
    """
    if camera is None:
        raise InputError(
            f"{task} has no camera: leave out render_mode='rgb_array' or --image, or give its scene() a camera"
        )
    builder.ExportOutput(add_camera(builder, station, "picture", camera, is_picture=True), "rgb_image")


def scene_of(station: Any) -> OutputPort:
    """Return the query port of a station's scene.

    Raises:
        InputError: If the station exports no scene, such as a real robot.
    """
    if not station.HasOutputPort("query"):
        raise InputError(
            "this station has no port `query` for pictures: let its `finish` export it, or choose another station, or "
            "another observation and no render_mode"
        )
    return station.GetOutputPort("query")


def contact_results_of(station: Any) -> OutputPort | None:
    """Return the port of a station's contact results; None without a simulation of Drake."""
    return station.GetOutputPort("contact_results") if station.HasOutputPort("contact_results") else None


def check_rendering() -> None:
    """Check that EGL is installed, because without it Drake would abort the process.

    Raises:
        InputError: If EGL is missing; the message names the package to install.
    """
    try:
        ctypes.CDLL("libEGL.so.1")
    except OSError:
        raise InputError(
            "images need libEGL.so.1, which this machine lacks: install it (Debian, Ubuntu: apt install libegl1), or "
            "use observation='state' without render_mode='rgb_array'"
        ) from None


def contact_visualizer(meshcat: Meshcat) -> ContactVisualizer:
    """Return Drake's visualizer of contact forces, with a scale for contacts of a tool."""
    return ContactVisualizer(
        meshcat,
        ContactVisualizerParams(
            publish_period=PUBLISH_PERIOD,
            newtons_per_meter=NEWTONS_PER_METER,
            newton_meters_per_meter=NEWTON_METERS_PER_METER,
            radius=0.001,
        ),
    )


def contact_forces(results: ContactResults) -> np.ndarray:
    """Return points [m] and forces [N] of all contacts in the world, (k, 6), the largest force first."""
    rows = []
    for index in range(results.num_point_pair_contacts()):
        pair = results.point_pair_contact_info(index)
        rows.append(np.concatenate([pair.contact_point(), pair.contact_force()]))
    for index in range(results.num_hydroelastic_contacts()):
        surface = results.hydroelastic_contact_info(index)
        rows.append(np.concatenate([surface.contact_surface().centroid(), surface.F_Ac_W().translational()]))
    rows.sort(key=lambda row: -float(np.linalg.norm(row[3:])))
    return np.array(rows).reshape(-1, 6)


def open_meshcat(meshcat: Meshcat | None = None) -> tuple[Meshcat, MeshcatVisualizer]:
    """Open a browser view on this machine, on a new page if none is given; return the page and its visualizer.

    Raises:
        InputError: If a new page cannot be opened, for example because `DRAKE_ALLOW_NETWORK` forbids Meshcat.
    """
    try:
        meshcat = meshcat or MeshcatPage()
    except RuntimeError as error:
        is_missing = "is missing" in str(error)
        hint = "install it" if is_missing else "set DRAKE_ALLOW_NETWORK=meshcat"
        raise InputError(f"the browser view can't be opened ({error}): {hint}, or leave render_mode out") from error
    parameters = MeshcatVisualizerParams(role=Role.kIllustration, publish_period=PUBLISH_PERIOD)
    return meshcat, MeshcatVisualizer(meshcat, parameters)


def add_meshcat(builder: DiagramBuilder, query: OutputPort, contact_results: OutputPort | None = None) -> Meshcat:
    """Add a browser view to a diagram, with contact forces if their port is given, and return its page.

    Raises:
        InputError: As `open_meshcat`.
    """
    meshcat, visualizer = open_meshcat()
    add_system(builder, "meshcat", visualizer, query)
    if contact_results is not None:
        contacts = builder.AddNamedSystem("contact_visualizer", contact_visualizer(meshcat))
        builder.Connect(contact_results, contacts.contact_results_input_port())
        builder.Connect(query, contacts.query_object_input_port())
    return meshcat


class View:
    """Browser view of a scene; it is not a subsystem of the diagram that simulates the scene.

    A diagram with Python systems is never freed, so a publisher inside it would keep its network port, thread and file
    descriptors open. A view that is deleted releases them.

    Attributes:
        meshcat: Meshcat page.
    """

    def __init__(self, query: OutputPort, meshcat: Meshcat | None = None, contact_results: OutputPort | None = None):
        """Open the view of a scene graph's query port, on a new page if none is given.

        With the port of the plant's contact results, the view also draws the forces of the contacts.

        Raises:
            InputError: As `open_meshcat`.
        """
        self._query = query
        self.meshcat, self._visualizer = open_meshcat(meshcat)
        self._context = self._visualizer.CreateDefaultContext()
        self._contact_results = contact_results
        if contact_results is not None:
            self._contacts = contact_visualizer(self.meshcat)
            self._contacts_context = self._contacts.CreateDefaultContext()
        self._published = -1.0  # time of the last publication [s]

    def follow(self, context: Context) -> EventStatus:
        """Publish every `PUBLISH_PERIOD`; a `Simulator` calls this function as its monitor, with the root context."""
        elapsed = context.get_time() - self._published
        # The time of a new episode restarts at zero. The tolerance for rounding is far below a simulation step.
        if elapsed < 0 or elapsed > PUBLISH_PERIOD - 1e-6:
            self.publish(context)
        return EventStatus.DidNothing()

    def publish(self, context: Context) -> None:
        """Publish the scene of a root context."""
        self._published = context.get_time()
        self._context.SetTime(self._published)
        scene = self._query.Eval(self._query.get_system().GetMyContextFromRoot(context))
        self._visualizer.query_object_input_port().FixValue(self._context, scene)
        self._visualizer.ForcedPublish(self._context)
        if self._contact_results is not None:
            station = self._contact_results.get_system()
            results = self._contact_results.Eval(station.GetMyContextFromRoot(context))
            self._contacts_context.SetTime(self._published)
            self._contacts.contact_results_input_port().FixValue(self._contacts_context, results)
            self._contacts.ForcedPublish(self._contacts_context)


Viewpoint = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Positions of eye and target in the world [m]."""

ARM_VIEW: Viewpoint = ((1.05, -0.75, 0.55), (0.42, 0.0, 0.32))
TOOL_VIEW: Viewpoint = ((0.62, -0.085, 0.19), (0.55, 0.0, 0.172))


@dataclass(frozen=True)
class Scene:
    """Drawing of a task."""

    # Function from poses (n, O) of a trace or a demonstration to points (n, 3) in the world [m].
    to_world: Callable[[np.ndarray], np.ndarray]
    camera: Camera | None = None  # camera of `render_mode="rgb_array"`; None if the task has no picture
    demonstrations: tuple[np.ndarray, ...] = ()  # poses (N, O) of each demonstration
    constraint: tuple[np.ndarray, ...] = ()  # corner points (k, 3) of each line that bounds the allowed region [m]
    viewpoint: Viewpoint | None = None  # viewpoint of a page
    # Viewpoints of a page with a whole arm, by name; the page opens with the first one, and a user can select any.
    arm_views: Mapping[str, Viewpoint] = field(default_factory=dict)
    line_radius: float = 0.0015  # radius of a drawn path [m]


def in_plane(poses: np.ndarray) -> np.ndarray:
    """Return points (n, 3) of poses (n, O): (x, y, 0) if O is 2, otherwise the first three numbers."""
    poses = np.asarray(poses)
    if poses.shape[1] >= 3:
        return poses[:, :3]
    return np.column_stack([poses, np.zeros(len(poses))])


def in_frame(X_WT: RigidTransform) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function from poses (n, 6) in T to points (n, 3) in the world."""
    return lambda poses: X_WT.multiply(np.asarray(poses)[:, :3].T).T


def viewpoint(eye: np.ndarray, target: np.ndarray) -> Viewpoint:
    """Return the viewpoint of an eye (3,) and a target (3,)."""
    return (float(eye[0]), float(eye[1]), float(eye[2])), (float(target[0]), float(target[1]), float(target[2]))


def box_edges(lower: ArrayLike, upper: ArrayLike) -> list[np.ndarray]:
    """Return the twelve edges of a box from corner `lower` (3,) to corner `upper` (3,), (2, 3) each."""
    (left, front, low), (right, back, high) = np.array([lower, upper], dtype=float)
    square = np.array([[left, front], [right, front], [right, back], [left, back], [left, front]])
    rings = [np.column_stack([square, np.full(5, height)]) for height in (low, high)]
    sides = [ring[i : i + 2] for ring in rings for i in range(4)]
    return sides + [np.array([[x, y, low], [x, y, high]]) for x, y in square[:4]]
