"""Workcell of two meshes: a socket in the world and a plug in the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from guiderail.diagrams.stations.workcell import MovableWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.common.parsing import add_models
from guiderail.models.objects.surfaces import Hull, Surface

PLUG, SOCKET = "plug", "socket"
"""Names of the bodies, and of their SDF files without the suffix."""


@dataclass(frozen=True)
class PartWorkcell(MovableWorkcell):
    """Socket in the world and plug in the tool; the vertices of the assembled parts are given in the target frame."""

    fixture: ClassVar[str] = SOCKET
    workpiece: ClassVar[str] = PLUG
    folder: Path  # folder with the SDF files of plug and socket
    place: tuple[float, float, float] = (0.55, 0.0, 0.15)  # position of the target in the world, (3,) [m]
    stiction_tolerance: float = 1e-5  # largest creep of a sticking contact [m/s]
    scenario: Sequence[str] = ()  # paths of Drake model directives of further objects
    # Names of the files of the convex pieces of plug and socket, for MuJoCo.
    convex: tuple[tuple[str, ...], tuple[str, ...]] = ((), ())
    friction: float = 0.2  # friction coefficient of the convex pieces

    @property
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal socket, equal to that of the target."""
        return RigidTransform(np.array(self.place))

    @property
    def X_FT(self) -> RigidTransform:
        """Pose of the target on the socket, the identity."""
        return RigidTransform()

    def sdf(self, body: str) -> Path:
        """Return the path of the SDF file of plug or socket."""
        return self.folder / f"{body}.sdf"

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the socket and the objects of the scenario."""
        plant.set_stiction_tolerance(self.stiction_tolerance)
        super().add_fixture(plant)
        for file in self.scenario:
            add_models(plant, file)

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Filter nothing: every piece of the plug may touch every piece of the socket."""

    def fixture_surfaces(self) -> list[Surface]:
        """Return the convex pieces of the socket.

        Raises:
            InputError: If the socket has no convex pieces, so that the plug would touch nothing.
        """
        return self._surfaces(SOCKET, self.convex[1])

    def workpiece_surfaces(self) -> list[Surface]:
        """Return the convex pieces of the plug; raises like `fixture_surfaces`."""
        return self._surfaces(PLUG, self.convex[0])

    def _surfaces(self, body: str, files: Sequence[str]) -> list[Surface]:
        if not files:
            raise InputError(
                f"the {body} in {self.folder} has no convex pieces, which MuJoCo needs: choose station='gantry'"
            )
        return [
            Surface(f"{body}_{number}", "parts", Hull(read_vertices(self.folder / file)), self.friction)
            for number, file in enumerate(files)
        ]


def read_vertices(path: Path) -> np.ndarray:
    """Return the vertices (V, 3) [m] of an OBJ file."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return np.array([line.split()[1:4] for line in lines if line.startswith("v ")], dtype=float)
