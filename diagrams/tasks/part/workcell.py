"""A workcell of two meshes that somebody brought: a socket in the world, a plug in the tool."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from pydrake.geometry import SceneGraph
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, RigidBody

from guiderail.diagrams.stations.workcell import movable_frame
from guiderail.models.common.parsing import add_model, add_models

PLUG, SOCKET = "plug", "socket"
"""Names of the bodies, and of the SDF files that hold them."""


@dataclass(frozen=True)
class PartWorkcell:
    """A socket at its place and a plug in the tool; both meshes are drawn in the target frame, in which they are
    assembled.

    Args:
        plug_sdf, socket_sdf: paths of the models.
        place: where the target is in the world, (3,) [m].
        stiction_tolerance: how fast a contact that sticks may creep [m/s].
        scenario: files of Drake model directives of what else stands there.
    """

    plug_sdf: str
    socket_sdf: str
    place: tuple[float, float, float] = (0.55, 0.0, 0.15)
    stiction_tolerance: float = 1e-5
    scenario: Sequence[str] = ()

    @property
    def X_WT(self) -> RigidTransform:
        """The target: the plug in the nominal socket."""
        return RigidTransform(np.array(self.place))

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Adds the socket, on a frame that `set_socket_offset` moves, and what the scenario places."""
        plant.set_stiction_tolerance(self.stiction_tolerance)
        model = add_model(plant, self.socket_sdf)
        mount = plant.AddFrame(FixedOffsetFrame("socket_mount", plant.world_frame(), self.X_WT))
        plant.WeldFrames(mount, plant.GetFrameByName(SOCKET, model))
        for file in self.scenario:
            add_models(plant, file)

    def add_workpiece(self, plant: MultibodyPlant, tool_centre: Frame) -> RigidBody:
        """Adds the plug, on a frame that `set_grasp_offset` moves."""
        model = add_model(plant, self.plug_sdf)
        grasp = plant.AddFrame(FixedOffsetFrame("grasp", tool_centre, RigidTransform()))
        plug = plant.GetBodyByName(PLUG, model)
        plant.WeldFrames(grasp, plug.body_frame())
        return plug

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Nothing: every piece of the plug may meet every piece of the socket."""

    def set_socket_offset(self, plant: MultibodyPlant, plant_context, X_TTactual: RigidTransform) -> None:
        """Moves the socket so that the plug seats at X_TTactual instead of at the target."""
        movable_frame(plant, "socket_mount").SetPoseInParentFrame(plant_context, self.X_WT @ X_TTactual)

    def set_grasp_offset(self, plant: MultibodyPlant, plant_context, X_PPlug: RigidTransform) -> None:
        """Moves the plug in the tool."""
        movable_frame(plant, "grasp").SetPoseInParentFrame(plant_context, X_PPlug)
