"""How a task is drawn: what belongs into a picture besides the robot, and where to look from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Meshcat, MeshcatVisualizer
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, EventStatus, OutputPort

from guiderail.diagrams.envs.cameras import PUBLISH_PERIOD, open_meshcat


class View:
    """Publishes a scene from beside the diagram that simulates it.

    A diagram with Python in it is never freed, and whatever publishes from inside it would keep its port, its thread
    and its descriptors as long. A view is nobody's subsystem: they are given back when nobody has it any more.

    Attributes:
        meshcat: the page.
    """

    meshcat: Meshcat

    def __init__(self, query: OutputPort, meshcat: Meshcat | None = None):
        """
        Args:
            query: of a scene graph inside a diagram.
            meshcat: a page that is there already; a new one unless given.

        Raises:
            InputError: if the environment forbids Drake to open a port at all.
        """
        self._query = query
        visualizer: MeshcatVisualizer
        self.meshcat, visualizer = open_meshcat(meshcat)
        self._visualizer = visualizer
        self._context = visualizer.CreateDefaultContext()
        self._published = -1.0  # s, when it was last

    def follow(self, context: Context) -> EventStatus:
        """Publishes often enough for the eye; a `Simulator`'s monitor, called with the root context."""
        elapsed = context.get_time() - self._published
        # The clock of an episode begins anew; steps of the simulation are far longer than what rounding makes of them.
        if elapsed < 0 or elapsed > PUBLISH_PERIOD - 1e-6:
            self.publish(context)
        return EventStatus.DidNothing()

    def publish(self, context: Context) -> None:
        """Shows what a root context says."""
        self._published = context.get_time()
        self._context.SetTime(self._published)
        scene = self._query.Eval(self._query.get_system().GetMyContextFromRoot(context))
        self._visualizer.query_object_input_port().FixValue(self._context, scene)
        self._visualizer.ForcedPublish(self._context)


Viewpoint = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Where to look from, and where to look at, in the world [m]."""

ARM_VIEW: Viewpoint = ((1.05, -0.75, 0.55), (0.42, 0.0, 0.32))
TOOL_VIEW: Viewpoint = ((0.62, -0.085, 0.19), (0.55, 0.0, 0.172))


@dataclass(frozen=True)
class Scene:
    """How a task is drawn.

    Attributes:
        to_world: takes poses (n, O) of a trace or a demonstration to points (n, 3) in the world [m].
        demonstrations: poses (N, O) of each demonstration.
        constraint: corner points (k, 3) of each line that bounds what is allowed.
        viewpoint: where a page looks from.
        arm_views: the same where a whole arm does it, by name; a page opens with the first and offers them all.
        line_radius: how thick a path is drawn [m].
    """

    to_world: Callable[[np.ndarray], np.ndarray]
    demonstrations: tuple[np.ndarray, ...] = ()
    constraint: tuple[np.ndarray, ...] = ()
    viewpoint: Viewpoint | None = None
    arm_views: Mapping[str, Viewpoint] = field(default_factory=dict)
    line_radius: float = 0.0015


def in_plane(poses: np.ndarray) -> np.ndarray:
    """Points (n, 3): (x, y) at height zero, or the position of a pose of six numbers."""
    poses = np.asarray(poses)
    if poses.shape[1] >= 3:
        return poses[:, :3]
    return np.column_stack([poses, np.zeros(len(poses))])


def in_frame(X_WT: RigidTransform) -> Callable[[np.ndarray], np.ndarray]:
    """Takes poses (n, 6) that are given in T to points (n, 3) in the world."""
    return lambda poses: X_WT.multiply(np.asarray(poses)[:, :3].T).T


def viewpoint(eye: np.ndarray, target: np.ndarray) -> Viewpoint:
    """A viewpoint of two points (3,)."""
    return (float(eye[0]), float(eye[1]), float(eye[2])), (float(target[0]), float(target[1]), float(target[2]))


def box_edges(lower: ArrayLike, upper: ArrayLike) -> list[np.ndarray]:
    """The twelve edges (2, 3) of a box by its corners (3,) each: a path that turns sharply is drawn side by side."""
    (left, front, low), (right, back, high) = np.array([lower, upper], dtype=float)
    square = np.array([[left, front], [right, front], [right, back], [left, back], [left, front]])
    rings = [np.column_stack([square, np.full(5, height)]) for height in (low, high)]
    sides = [ring[i : i + 2] for ring in rings for i in range(4)]
    return sides + [np.array([[x, y, low], [x, y, high]]) for x, y in square[:4]]
