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
from guiderail.models.common.parsing import add_models

PLUG, SOCKET = "plug", "socket"
"""Names of the bodies, and of the SDF files that hold them."""


@dataclass(frozen=True)
class PartWorkcell(MovableWorkcell):
    """Socket in the world and plug in the tool; both meshes are in the target frame, in which they are assembled.

    Attributes:
        folder: Folder with the SDF files of plug and socket.
        place: Position of the target in the world, (3,) [m].
        stiction_tolerance: Largest creep of a sticking contact [m/s].
        scenario: Paths of Drake model directives of further objects.
    """

    fixture: ClassVar[str] = SOCKET
    workpiece: ClassVar[str] = PLUG
    folder: Path
    place: tuple[float, float, float] = (0.55, 0.0, 0.15)
    stiction_tolerance: float = 1e-5
    scenario: Sequence[str] = ()

    @property
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal socket, which is the target's."""
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
