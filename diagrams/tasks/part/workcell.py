"""Workcell of two meshes: a socket in the world and a plug in the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, RigidBody
from pydrake.systems.framework import Context

from guiderail.diagrams.stations.workcell import movable_frame
from guiderail.models.common.parsing import add_model, add_models

PLUG, SOCKET = "plug", "socket"
"""Names of the bodies, and of the SDF files that hold them."""


@dataclass(frozen=True)
class PartWorkcell:
    """Socket in the world and plug in the tool; both meshes are in the target frame, in which they are assembled.

    Attributes:
        plug_sdf: Path of the plug's model.
        socket_sdf: Path of the socket's model.
        place: Position of the target in the world, (3,) [m].
        stiction_tolerance: Largest creep of a sticking contact [m/s].
        scenario: Paths of Drake model directives of further objects.
    """

    plug_sdf: str
    socket_sdf: str
    place: tuple[float, float, float] = (0.55, 0.0, 0.15)
    stiction_tolerance: float = 1e-5
    scenario: Sequence[str] = ()

    @property
    def X_WT(self) -> RigidTransform:
        """Pose of the target: the plug in the nominal socket."""
        return RigidTransform(np.array(self.place))

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the socket, on a frame that `set_socket_offset` moves, and the objects of the scenario."""
        plant.set_stiction_tolerance(self.stiction_tolerance)
        model = add_model(plant, self.socket_sdf)
        mount = plant.AddFrame(FixedOffsetFrame("socket_mount", plant.world_frame(), self.X_WT))
        plant.WeldFrames(mount, plant.GetFrameByName(SOCKET, model))
        for file in self.scenario:
            add_models(plant, file)

    def add_workpiece(self, plant: MultibodyPlant, tool_center: Frame) -> RigidBody:
        """Add the plug, on a frame that `set_grasp_offset` moves."""
        model = add_model(plant, self.plug_sdf)
        grasp = plant.AddFrame(FixedOffsetFrame("grasp", tool_center, RigidTransform()))
        plug = plant.GetBodyByName(PLUG, model)
        plant.WeldFrames(grasp, plug.body_frame())
        return plug

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Filter nothing: every piece of the plug may touch every piece of the socket."""

    def set_socket_offset(self, plant: MultibodyPlant, plant_context: Context, X_TTactual: RigidTransform) -> None:
        """Move the socket so that the plug seats at X_TTactual instead of at the target."""
        movable_frame(plant, "socket_mount").SetPoseInParentFrame(plant_context, self.X_WT @ X_TTactual)

    def set_grasp_offset(self, plant: MultibodyPlant, plant_context: Context, X_PPlug: RigidTransform) -> None:
        """Move the plug in the tool."""
        movable_frame(plant, "grasp").SetPoseInParentFrame(plant_context, X_PPlug)
