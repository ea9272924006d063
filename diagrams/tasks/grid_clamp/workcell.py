"""The grid clamp's workcell: a table with holes, a clamp in the tool, and offsets of both that a reset can draw."""

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
"""How fast a contact that sticks may creep [m/s]. With Drake's 1e-3 a clamp that stands beside its holes, pressed with
27 N and pushed sideways with 2 N, a third of what friction bears, drifts at 0.18 mm/s; so, at 0.004 mm/s. Over an
episode of 10 s that is the difference between slipping in by itself and standing still."""
SEATED = 0.5e-3  # [m] a clamp that is lower than this has snapped in
SEATED_BESIDE = 1.0e-3  # [m] a clamp that is as low beside its holes has not
HOLES = tuple(f"hole_{number}" for number in range(5))
PEGS = tuple(f"peg_{number}" for number in range(5))
# A peg meets its own hole, the bead the lip, the pad the slab: nothing else.
FILTERED_PAIRS = [
    *(((hole,), tuple(peg for peg in PEGS if peg[-1] != hole[-1])) for hole in HOLES),
    (HOLES, ("bead", "pad")),
    (("lip",), (*PEGS, "pad")),
    (("slab",), (*PEGS, "bead")),
]


@dataclass(frozen=True)
class GridClampWorkcell:
    """A table in front of the robot's base; the target frame's axes are the world's.

    Args:
        dimensions: of clamp and table.
        p_WG: the middle hole's centre in the table's face, (3,) [m].
        friction: of pegs, holes and the table's face.
    """

    dimensions: GridClampDimensions = field(default_factory=GridClampDimensions)
    p_WG: tuple[float, float, float] = (0.55, 0.0, 0.15)
    friction: float = FRICTION

    @property
    def X_WG(self) -> RigidTransform:
        """The nominal table."""
        return RigidTransform(np.array(self.p_WG))

    @property
    def X_GT(self) -> RigidTransform:
        """The clamp that has snapped in."""
        return RigidTransform([0.0, 0.0, -self.dimensions.peg_length])

    @property
    def X_WT(self) -> RigidTransform:
        """The target: the clamp that has snapped into the nominal table."""
        return self.X_WG @ self.X_GT

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Adds the table, on a frame that `set_table_offset` moves; says how still a contact of the plant is."""
        plant.set_stiction_tolerance(STICTION_TOLERANCE)
        model = add_model(plant, folder_of(self.dimensions, self.friction) / TABLE_SDF.name)
        mount = plant.AddFrame(FixedOffsetFrame("table_mount", plant.world_frame(), self.X_WG))
        plant.WeldFrames(mount, plant.GetFrameByName("table", model))

    def add_workpiece(self, plant: MultibodyPlant, tool_centre: Frame) -> RigidBody:
        """Adds the clamp, on a frame that `set_grasp_offset` moves."""
        model = add_model(plant, folder_of(self.dimensions, self.friction) / CLAMP_SDF.name)
        grasp = plant.AddFrame(FixedOffsetFrame("grasp", tool_centre, RigidTransform()))
        clamp = plant.GetBodyByName("clamp", model)
        plant.WeldFrames(grasp, clamp.body_frame())
        return clamp

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Leaves each peg to its hole, the bead to the lip and the pad to the slab."""
        exclude_contacts(plant, scene_graph, "table", "clamp", FILTERED_PAIRS)

    def fixture_surfaces(self) -> list[Surface]:
        """What of the table touches, in G."""
        return table_surfaces(self.dimensions, self.friction)

    def workpiece_surfaces(self) -> list[Surface]:
        """What of the clamp touches, in its frame."""
        return clamp_surfaces(self.dimensions, self.friction)

    def set_table_offset(self, plant: MultibodyPlant, plant_context: Context, X_TTactual: RigidTransform) -> None:
        """Moves the table so that the clamp snaps in at X_TTactual instead of at the target."""
        X_WG = self.X_WT @ X_TTactual @ self.X_GT.inverse()
        movable_frame(plant, "table_mount").SetPoseInParentFrame(plant_context, X_WG)

    def set_grasp_offset(self, plant: MultibodyPlant, plant_context: Context, X_PClamp: RigidTransform) -> None:
        """Moves the clamp in the tool."""
        movable_frame(plant, "grasp").SetPoseInParentFrame(plant_context, X_PClamp)

    def clamp_in_target(self, plant: MultibodyPlant, plant_context: Context) -> RigidTransform:
        """Where the clamp is as seen from where it snaps in, offsets included: the identity when it has."""
        X_GClamp = plant.GetFrameByName("clamp").CalcPose(plant_context, plant.GetFrameByName("table"))
        return self.X_GT.inverse() @ X_GClamp

    def is_seated(self, clamp: np.ndarray) -> bool:
        """Whether a clamp at `clamp`, X_GClamp as position and rotation vector (6,), has snapped in."""
        return bool(clamp[2] - self.X_GT.translation()[2] < SEATED and np.hypot(clamp[0], clamp[1]) < SEATED_BESIDE)
