"""Workcell of the grid clamp: a table with holes and a clamp in the tool, both with an offset that can be set."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant

from guiderail.diagrams.stations.workcell import MovableWorkcell, exclude_contacts
from guiderail.models.objects.grid_clamp.geometry import CLAMP_SDF, TABLE_SDF, GridClampDimensions
from guiderail.models.objects.grid_clamp.sdf import FRICTION, folder_of
from guiderail.models.objects.grid_clamp.surfaces import clamp_surfaces, table_surfaces
from guiderail.models.objects.surfaces import Surface

STICTION_TOLERANCE = 1e-5
"""Largest creep of a sticking contact [m/s].

A clamp that stands next to its holes, pressed with 27 N and pushed sideways with 2 N, a third of the friction limit,
drifts at 0.18 mm/s with Drake's default of 1e-3, and at 0.004 mm/s with this value. Over an episode of 10 s this drift
decides whether the clamp slips in by itself or stands still.
"""
SEATED_HEIGHT = 0.5e-3  # [m] height below which a clamp has snapped in
SEATED_OFFSET = 1.0e-3  # [m] largest lateral offset of a seated clamp
HOLES = tuple(f"hole_{number}" for number in range(5))
PEGS = tuple(f"peg_{number}" for number in range(5))
# All pairs of surfaces except a peg and its own hole, bead and lip, and pad and slab.
FILTERED_PAIRS = [
    *(((hole,), tuple(peg for peg in PEGS if peg[-1] != hole[-1])) for hole in HOLES),
    (HOLES, ("bead", "pad")),
    (("lip",), (*PEGS, "pad")),
    (("slab",), (*PEGS, "bead")),
]


@dataclass(frozen=True)
class GridClampWorkcell(MovableWorkcell):
    """Table in front of the robot's base; the target frame's axes are the world's."""

    fixture: ClassVar[str] = "table"
    workpiece: ClassVar[str] = "clamp"
    dimensions: GridClampDimensions = field(default_factory=GridClampDimensions)  # dimensions of clamp and table
    p_WG: tuple[float, float, float] = (0.55, 0.0, 0.15)  # center of the middle hole in the table's face, (3,) [m]
    friction: float = FRICTION  # friction coefficient of pegs, holes and the table's face

    @property
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal table, X_WG."""
        return RigidTransform(np.array(self.p_WG))

    @property
    def X_FT(self) -> RigidTransform:
        """Pose of the seated clamp on the table, X_GT."""
        return RigidTransform([0.0, 0.0, -self.dimensions.peg_length])

    def sdf(self, body: str) -> Path:
        """Return the path of the SDF file of table or clamp."""
        return folder_of(self.dimensions, self.friction) / (TABLE_SDF if body == self.fixture else CLAMP_SDF).name

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the table, and set the plant's stiction tolerance."""
        plant.set_stiction_tolerance(STICTION_TOLERANCE)
        super().add_fixture(plant)

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Allow contacts of each peg and its hole, bead and lip, and pad and slab only."""
        exclude_contacts(plant, scene_graph, "table", "clamp", FILTERED_PAIRS)

    def fixture_surfaces(self) -> list[Surface]:
        """Return the collision surfaces of the table, in G."""
        return table_surfaces(self.dimensions, self.friction)

    def workpiece_surfaces(self) -> list[Surface]:
        """Return the collision surfaces of the clamp, in its frame."""
        return clamp_surfaces(self.dimensions, self.friction)

    def is_seated(self, clamp: np.ndarray) -> bool:
        """Return True if a clamp with X_GClamp, as position and rotation vector (6,), has snapped in."""
        return bool(
            clamp[2] - self.X_FT.translation()[2] < SEATED_HEIGHT and np.hypot(clamp[0], clamp[1]) < SEATED_OFFSET
        )
