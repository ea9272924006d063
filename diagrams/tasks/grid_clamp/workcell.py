"""Workcell of the grid clamp: a table with holes and a clamp in the tool, both with an offset that can be set."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, RigidBody
from pydrake.systems.framework import Context

from guiderail.diagrams.stations.workcell import exclude_contacts, movable_frame
from guiderail.models.common.parsing import add_model
from guiderail.models.objects.grid_clamp.geometry import CLAMP_SDF, TABLE_SDF, GridClampDimensions
from guiderail.models.objects.grid_clamp.sdf import FRICTION, folder_of
from guiderail.models.objects.grid_clamp.surfaces import clamp_surfaces, table_surfaces
from guiderail.models.objects.surfaces import Surface

STICTION_TOLERANCE = 1e-5
"""Largest creep of a sticking contact [m/s].

A clamp that stands next to its holes, pressed with 27 N and pushed sideways with 2 N, a third of the friction limit,
drifts at 0.18 mm/s with Drake's 1e-3, and at 0.004 mm/s with this value. Over an episode of 10 s it decides between
slipping in by itself and standing still.
"""
SEATED_HEIGHT = 0.5e-3  # [m] height below which a clamp has snapped in
SEATED_OFFSET = 1.0e-3  # [m] largest lateral offset of a seated clamp
HOLES = tuple(f"hole_{number}" for number in range(5))
PEGS = tuple(f"peg_{number}" for number in range(5))
# Contacts: a peg and its own hole, bead and lip, pad and slab.
FILTERED_PAIRS = [
    *(((hole,), tuple(peg for peg in PEGS if peg[-1] != hole[-1])) for hole in HOLES),
    (HOLES, ("bead", "pad")),
    (("lip",), (*PEGS, "pad")),
    (("slab",), (*PEGS, "bead")),
]


@dataclass(frozen=True)
class GridClampWorkcell:
    """Table in front of the robot's base; the target frame's axes are the world's.

    Attributes:
        dimensions: Dimensions of clamp and table.
        p_WG: Centre of the middle hole in the table's face, (3,) [m].
        friction: Friction coefficient of pegs, holes and the table's face.
    """

    dimensions: GridClampDimensions = field(default_factory=GridClampDimensions)
    p_WG: tuple[float, float, float] = (0.55, 0.0, 0.15)
    friction: float = FRICTION

    @property
    def X_WG(self) -> RigidTransform:
        """Pose of the nominal table."""
        return RigidTransform(np.array(self.p_WG))

    @property
    def X_GT(self) -> RigidTransform:
        """Pose of the seated clamp on the table."""
        return RigidTransform([0.0, 0.0, -self.dimensions.peg_length])

    @property
    def X_WT(self) -> RigidTransform:
        """Pose of the target: the clamp seated on the nominal table."""
        return self.X_WG @ self.X_GT

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the table, on a frame that `set_table_offset` moves, and set the plant's stiction tolerance."""
        plant.set_stiction_tolerance(STICTION_TOLERANCE)
        model = add_model(plant, folder_of(self.dimensions, self.friction) / TABLE_SDF.name)
        mount = plant.AddFrame(FixedOffsetFrame("table_mount", plant.world_frame(), self.X_WG))
        plant.WeldFrames(mount, plant.GetFrameByName("table", model))

    def add_workpiece(self, plant: MultibodyPlant, tool_center: Frame) -> RigidBody:
        """Add the clamp, on a frame that `set_grasp_offset` moves."""
        model = add_model(plant, folder_of(self.dimensions, self.friction) / CLAMP_SDF.name)
        grasp = plant.AddFrame(FixedOffsetFrame("grasp", tool_center, RigidTransform()))
        clamp = plant.GetBodyByName("clamp", model)
        plant.WeldFrames(grasp, clamp.body_frame())
        return clamp

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Allow contacts of each peg and its hole, bead and lip, and pad and slab only."""
        exclude_contacts(plant, scene_graph, "table", "clamp", FILTERED_PAIRS)

    def fixture_surfaces(self) -> list[Surface]:
        """Return the collision surfaces of the table, in G."""
        return table_surfaces(self.dimensions, self.friction)

    def workpiece_surfaces(self) -> list[Surface]:
        """Return the collision surfaces of the clamp, in its frame."""
        return clamp_surfaces(self.dimensions, self.friction)

    def set_table_offset(self, plant: MultibodyPlant, plant_context: Context, X_TTactual: RigidTransform) -> None:
        """Move the table so that the clamp snaps in at X_TTactual instead of at the target."""
        X_WG = self.X_WT @ X_TTactual @ self.X_GT.inverse()
        movable_frame(plant, "table_mount").SetPoseInParentFrame(plant_context, X_WG)

    def set_grasp_offset(self, plant: MultibodyPlant, plant_context: Context, X_PClamp: RigidTransform) -> None:
        """Move the clamp in the tool."""
        movable_frame(plant, "grasp").SetPoseInParentFrame(plant_context, X_PClamp)

    def clamp_in_target(self, plant: MultibodyPlant, plant_context: Context) -> RigidTransform:
        """Return the clamp's pose in the frame of the seated clamp, offsets included: the identity when seated."""
        X_GClamp = plant.GetFrameByName("clamp").CalcPose(plant_context, plant.GetFrameByName("table"))
        return self.X_GT.inverse() @ X_GClamp

    def is_seated(self, clamp: np.ndarray) -> bool:
        """Return True if a clamp with X_GClamp, as position and rotation vector (6,), has snapped in."""
        return bool(
            clamp[2] - self.X_GT.translation()[2] < SEATED_HEIGHT and np.hypot(clamp[0], clamp[1]) < SEATED_OFFSET
        )
