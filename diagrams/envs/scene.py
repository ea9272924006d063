"""Drawing of a task: the browser view, viewpoints, and the lines that a picture shows in addition to the robot."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, OutputPort

from guiderail.diagrams.envs.cameras import PUBLISH_PERIOD, open_meshcat


class View:
    """Browser view of a scene; it is not a subsystem of the diagram that simulates the scene.

    A diagram with Python systems is never freed, so a publisher inside it would keep its network port, thread and file
    descriptors open. A view that is deleted releases them.

    Attributes:
        meshcat: Meshcat page.
    """

    def __init__(self, query: OutputPort, meshcat: Meshcat | None = None):
        """Open the view of a scene graph's query port, on a new page if none is given.

        Raises:
            InputError: If the environment forbids Drake to open a network port.
        """
        self._query = query
        self.meshcat, self._visualizer = open_meshcat(meshcat)
        self._context = self._visualizer.CreateDefaultContext()
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


Viewpoint = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Positions of eye and target in the world [m]."""

ARM_VIEW: Viewpoint = ((1.05, -0.75, 0.55), (0.42, 0.0, 0.32))
TOOL_VIEW: Viewpoint = ((0.62, -0.085, 0.19), (0.55, 0.0, 0.172))


@dataclass(frozen=True)
class Scene:
    """Drawing of a task."""

    # Function from poses (n, O) of a trace or a demonstration to points (n, 3) in the world [m].
    to_world: Callable[[np.ndarray], np.ndarray]
    demonstrations: tuple[np.ndarray, ...] = ()  # poses (N, O) of each demonstration
    constraint: tuple[np.ndarray, ...] = ()  # corner points (k, 3) of each line that bounds the allowed region [m]
    viewpoint: Viewpoint | None = None  # viewpoint of a page
    # Viewpoints of a page with a whole arm, by name; the page opens with the first and offers all.
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
