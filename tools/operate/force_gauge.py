"""The contact's force on a page: an arrow beside the part, and a bar that fills up to the limit."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydrake.geometry import Box, Cylinder, MeshcatCone, Rgba
from pydrake.math import RotationMatrix

from guiderail.diagrams.scene import Viewpoint

PATH = "/guiderail/force"
ASIDE, UPWARDS, LENGTH, THICKNESS = 0.3, 0.05, 0.3, 0.012  # of the way from the camera to what it looks at
WARNING = 0.7  # of the limit, from which on it is red
CALM, RED, TROUGH = (0.1, 0.5, 0.9, 1.0), (0.9, 0.15, 0.1, 1.0), (0.35, 0.35, 0.35, 0.25)
LEAST = 1e-3  # of full length: what has no length at all has no direction either


class ForceGauge:
    """Solid objects, as browsers draw lines a pixel wide; beside the part, or they would be inside of it."""

    def __init__(self, meshcat: Any, view: Viewpoint, limit: float):
        """
        Args:
            meshcat: the page.
            view: of its camera; the gauge is as large as suits the distance of what it looks at.
            limit: force of a full bar, and of an arrow of full length [N].
        """
        self._meshcat, self._limit = meshcat, limit
        eye, target = (np.array(point) for point in view)
        way = target - eye
        size = float(np.linalg.norm(way))
        right = np.cross(way, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._length, thickness = LENGTH * size, THICKNESS * size
        low = target - [0.0, 0.0, UPWARDS * size]
        self._tail, self._foot = low + ASIDE * size * right, low - ASIDE * size * right
        self._head = 4.0 * thickness
        meshcat.SetObject(f"{PATH}/shaft", Cylinder(thickness, 1.0), Rgba(*CALM))
        meshcat.SetObject(f"{PATH}/head", MeshcatCone(self._head, 2.5 * thickness, 2.5 * thickness), Rgba(*CALM))
        meshcat.SetObject(f"{PATH}/bar", Box(3.0 * thickness, 3.0 * thickness, 1.0), Rgba(*CALM))
        meshcat.SetObject(f"{PATH}/trough", Box(3.5 * thickness, 3.5 * thickness, self._length), Rgba(*TROUGH))
        meshcat.SetTransform(f"{PATH}/trough", _pose(np.eye(3), self._foot + [0.0, 0.0, 0.5 * self._length]))
        self.show(np.zeros(3))

    def show(self, force: np.ndarray) -> None:
        """Draws a force (3,) in the world [N]; what is beyond the limit is as long as the limit."""
        size = float(np.linalg.norm(force))
        share = float(np.clip(size / self._limit, LEAST, 1.0))
        R = RotationMatrix.MakeFromOneVector(force if size > 0.0 else [0.0, 0.0, 1.0], 2).matrix()
        along = R[:, 2] * share * self._length
        self._meshcat.SetTransform(f"{PATH}/shaft", _pose(R, self._tail + 0.5 * along, share * self._length))
        # A cone's point is its origin, and it opens along z: turned about, and as far ahead as it is high.
        tip = self._tail + along + R[:, 2] * self._head
        self._meshcat.SetTransform(f"{PATH}/head", _pose(R @ np.diag([1.0, -1.0, -1.0]), tip))
        height = share * self._length
        self._meshcat.SetTransform(f"{PATH}/bar", _pose(np.eye(3), self._foot + [0.0, 0.0, 0.5 * height], height))
        for part in ("shaft", "head", "bar"):
            colour = RED if size > WARNING * self._limit else CALM
            self._meshcat.SetProperty(f"{PATH}/{part}/<object>", "color", list(colour))


def _pose(R: np.ndarray, p: np.ndarray, length: float = 1.0) -> np.ndarray:
    """A pose (4, 4) of what is a metre long in z and becomes `length` [m]."""
    X = np.eye(4)
    X[:3, :3] = R @ np.diag([1.0, 1.0, length])
    X[:3, 3] = p
    return X
