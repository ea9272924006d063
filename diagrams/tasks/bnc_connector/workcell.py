"""The BNC connector's workcell: a jack in the world, a plug in the tool, and offsets of both that a reset can draw."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydrake.geometry import Box, SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, Frame, RigidBody
from pydrake.systems.framework import Context

from guiderail.diagrams.stations.workcell import exclude_contacts, movable_frame
from guiderail.models.common.parsing import add_model
from guiderail.models.objects.bnc_connector.geometry import JACK_SDF, PLUG_SDF, BncDimensions
from guiderail.models.objects.bnc_connector.sdf import FRICTION, MARGIN, folder_of
from guiderail.models.objects.bnc_connector.surfaces import jack_surfaces, plug_surfaces
from guiderail.models.objects.surfaces import Surface

# The pairs that never meet in a connector of these dimensions, or whose part of the contact another surface carries.
FILTERED_PAIRS = [
    (("lug_0", "lug_1", "pad"), ("bore",)),
    (("barrel", "pad"), ("slots",)),
    (("lug_0", "lug_1", "barrel"), ("seat",)),
]

# The task board is seen and not touched; the locked plug's mouth lies a little below the jack's bottom.
BOARD, BOARD_CLEARANCE, BOARD_COLOUR = (0.16, 0.20, 0.012), 0.001, [0.90, 0.89, 0.86, 1.0]  # [m]
LOCKED_HEIGHT = 0.6e-3  # [m]
LOCKED_ANGLE = np.deg2rad(4.0)
LOCKED_BESIDE = 1.0e-3  # [m] a plug that is as low and as turned beside the jack is not locked

# A jack has two equal sides: half a turn about its axis changes the signs of what lies across it.
HALF_TURN = np.array([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])  # of a pose's x, y, z, Rz, Ry, Rx
HALF_TURN_OF_WRENCH = np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class BncWorkcell:
    """A jack in front of the robot's base, turned so that the target frame's axes are the world's.

    Args:
        dimensions: of the connector.
        p_WJ: where the jack stands, (3,) [m].
        friction: of the connector's metal.
        margin: from which on Drake feels the jack's metal before it is touched [m]; MuJoCo has none.
        equal_area: whether the polygons that stand for barrel and bore in Drake have the circles' areas; otherwise the
            barrel's lies inside of its circle and the bore's around it, and the plug drops in from farther off.
    """

    dimensions: BncDimensions = field(default_factory=BncDimensions)
    p_WJ: tuple[float, float, float] = (0.55, 0.0, 0.15)
    friction: float = FRICTION
    margin: float = MARGIN
    equal_area: bool = False

    @property
    def X_WJ(self) -> RigidTransform:
        """The nominal jack."""
        return RigidTransform(RotationMatrix.MakeZRotation(self.dimensions.detent_angle), np.array(self.p_WJ))

    @property
    def X_JT(self) -> RigidTransform:
        """The locked plug on the jack."""
        return RigidTransform(
            RotationMatrix.MakeZRotation(-self.dimensions.detent_angle), [0.0, 0.0, self.dimensions.locked_height]
        )

    @property
    def X_WT(self) -> RigidTransform:
        """The target: the plug locked on the nominal jack."""
        return self.X_WJ @ self.X_JT

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Adds the jack, on a frame that `set_jack_offset` moves, and a board under it to look at."""
        model = add_model(plant, self._folder() / JACK_SDF.name)
        mount = plant.AddFrame(FixedOffsetFrame("jack_mount", plant.world_frame(), self.X_WJ))
        plant.WeldFrames(mount, plant.GetFrameByName("jack", model))
        depth, width, thickness = BOARD
        below = RigidTransform(np.array(self.p_WJ) - [0.0, 0.0, BOARD_CLEARANCE + thickness / 2])
        plant.RegisterVisualGeometry(plant.world_body(), below, Box(depth, width, thickness), "board", BOARD_COLOUR)

    def add_workpiece(self, plant: MultibodyPlant, tool_centre: Frame) -> RigidBody:
        """Adds the plug, on a frame that `set_grasp_offset` moves."""
        model = add_model(plant, self._folder() / PLUG_SDF.name)
        grasp = plant.AddFrame(FixedOffsetFrame("grasp", tool_centre, RigidTransform()))
        plug = plant.GetBodyByName("plug", model)
        plant.WeldFrames(grasp, plug.body_frame())
        return plug

    def _folder(self) -> Path:
        return folder_of(self.dimensions, self.friction, self.margin, self.equal_area)

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Leaves the barrel to the bore, the lugs to the slots and the pad to the seat."""
        exclude_contacts(plant, scene_graph, "jack", "plug", FILTERED_PAIRS)

    def fixture_surfaces(self) -> list[Surface]:
        """What of the jack touches, in J."""
        return jack_surfaces(self.dimensions, self.friction)

    def workpiece_surfaces(self) -> list[Surface]:
        """What of the plug touches, in its frame."""
        return plug_surfaces(self.dimensions, self.friction)

    def set_jack_offset(self, plant: MultibodyPlant, plant_context: Context, X_TTactual: RigidTransform) -> None:
        """Moves the jack so that the plug locks at X_TTactual instead of at the target."""
        X_WJ = self.X_WT @ X_TTactual @ self.X_JT.inverse()
        movable_frame(plant, "jack_mount").SetPoseInParentFrame(plant_context, X_WJ)

    def set_grasp_offset(self, plant: MultibodyPlant, plant_context: Context, X_PPlug: RigidTransform) -> None:
        """Moves the plug in the tool."""
        movable_frame(plant, "grasp").SetPoseInParentFrame(plant_context, X_PPlug)

    def plug_in_locked_frame(self, plant: MultibodyPlant, plant_context: Context) -> RigidTransform:
        """Where the plug is as seen from where it locks, offsets included: the identity when it is locked."""
        X_JPlug = plant.GetFrameByName("plug").CalcPose(plant_context, plant.GetFrameByName("jack"))
        return self.X_JT.inverse() @ X_JPlug

    def locks(self, plug: np.ndarray) -> bool:
        """Whether a plug at `plug`, X_JPlug as position and rotation vector (6,), is locked and on the jack's axis.

        The rotation vector of an upright plug is its turn about z.
        """
        return bool(
            abs(plug[2] - self.dimensions.locked_height) < LOCKED_HEIGHT
            and abs(plug[5] + self.dimensions.detent_angle) < LOCKED_ANGLE
            and np.hypot(plug[0], plug[1]) < LOCKED_BESIDE
        )

    @staticmethod
    def is_locked(X_LockedPlug: RigidTransform) -> bool:
        """Whether a plug seen from where it locks is locked: within 0.6 mm and 4 degrees along and about the axis.

        The lugs are then past the apex, where only a torque brings them back.
        """
        yaw = RollPitchYaw(X_LockedPlug.rotation()).yaw_angle()
        return bool(abs(X_LockedPlug.translation()[2]) < LOCKED_HEIGHT and abs(yaw) < LOCKED_ANGLE)
