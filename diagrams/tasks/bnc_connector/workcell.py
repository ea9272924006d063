"""Workcell of the BNC connector: a jack in the world and a plug in the tool, both with an offset that can be set."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
from pydrake.geometry import Box, SceneGraph
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant

from guiderail.diagrams.stations.workcell import MovableWorkcell, exclude_contacts
from guiderail.models.objects.bnc_connector.geometry import JACK_SDF, PLUG_SDF, BncDimensions
from guiderail.models.objects.bnc_connector.sdf import FRICTION, MARGIN, folder_of, jack_surfaces, plug_surfaces
from guiderail.models.objects.surfaces import Surface

# Surfaces of jack and plug that cannot touch in a connector of these dimensions, or whose contact another pair carries.
FILTERED_PAIRS = [
    (("lug_0", "lug_1", "pad"), ("bore",)),
    (("barrel", "pad"), ("slots",)),
    (("lug_0", "lug_1", "barrel"), ("seat",)),
]

# The task board has no collision geometry, because the locked plug's mouth reaches slightly below the jack's bottom.
BOARD, BOARD_CLEARANCE, BOARD_COLOR = (0.16, 0.20, 0.012), 0.001, [0.90, 0.89, 0.86, 1.0]  # [m]
LOCKED_HEIGHT = 0.6e-3  # [m] largest deviation of a locked plug along the jack's axis
LOCKED_ANGLE = np.deg2rad(4.0)  # [rad] largest deviation of a locked plug about the jack's axis
LOCKED_OFFSET = 1.0e-3  # [m] largest lateral offset of a locked plug

# Signs after half a turn about the jack's axis, under which the jack is symmetric.
HALF_TURN = np.array([-1.0, -1.0, 1.0, 1.0, -1.0, -1.0])  # pose [x y z Rz Ry Rx]
HALF_TURN_OF_WRENCH = np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class BncWorkcell(MovableWorkcell):
    """Jack in front of the robot's base, turned so that the target frame's axes are the world's."""

    fixture: ClassVar[str] = "jack"
    workpiece: ClassVar[str] = "plug"
    dimensions: BncDimensions = field(default_factory=BncDimensions)  # dimensions of the connector
    p_WJ: tuple[float, float, float] = (0.55, 0.0, 0.15)  # position of the jack, (3,) [m]
    friction: float = FRICTION  # friction coefficient of the connector's metal
    margin: float = MARGIN  # distance at which contact with the jack begins in Drake [m]; not used in MuJoCo
    # True if the polygons of barrel and bore in Drake have the areas of their circles. Otherwise the barrel's polygon
    # lies inside its circle and the bore's outside, and the plug drops in at larger offsets.
    equal_area: bool = False

    @property
    def X_WF(self) -> RigidTransform:
        """Pose of the nominal jack, X_WJ."""
        return RigidTransform(RotationMatrix.MakeZRotation(self.dimensions.detent_angle), np.array(self.p_WJ))

    @property
    def X_FT(self) -> RigidTransform:
        """Pose of the locked plug on the jack, X_JT."""
        return RigidTransform(
            RotationMatrix.MakeZRotation(-self.dimensions.detent_angle), [0.0, 0.0, self.dimensions.locked_height]
        )

    def sdf(self, body: str) -> Path:
        """Return the path of the SDF file of jack or plug."""
        name = JACK_SDF.name if body == self.fixture else PLUG_SDF.name
        return folder_of(self.dimensions, self.friction, self.margin, self.equal_area) / name

    def add_fixture(self, plant: MultibodyPlant) -> None:
        """Add the jack, and a board under it without collision geometry."""
        super().add_fixture(plant)
        depth, width, thickness = BOARD
        below = RigidTransform(np.array(self.p_WJ) - [0.0, 0.0, BOARD_CLEARANCE + thickness / 2])
        plant.RegisterVisualGeometry(plant.world_body(), below, Box(depth, width, thickness), "board", BOARD_COLOR)

    def filter_contacts(self, plant: MultibodyPlant, scene_graph: SceneGraph) -> None:
        """Allow only contacts of barrel with bore, lugs with slots, and pad with seat."""
        exclude_contacts(plant, scene_graph, "jack", "plug", FILTERED_PAIRS)

    def fixture_surfaces(self) -> list[Surface]:
        """Return the collision surfaces of the jack, in J."""
        return jack_surfaces(self.dimensions, self.friction)

    def workpiece_surfaces(self) -> list[Surface]:
        """Return the collision surfaces of the plug, in its frame."""
        return plug_surfaces(self.dimensions, self.friction)

    def locks(self, plug: np.ndarray) -> bool:
        """Return True if a plug is locked and on the jack's axis, given X_JPlug as position and rotation vector (6,).

        For an upright plug, `plug[5]` is the turn about z.
        """
        return bool(
            abs(plug[2] - self.dimensions.locked_height) < LOCKED_HEIGHT
            and abs(plug[5] + self.dimensions.detent_angle) < LOCKED_ANGLE
            and np.hypot(plug[0], plug[1]) < LOCKED_OFFSET
        )

    @staticmethod
    def is_locked(X_LockedPlug: RigidTransform) -> bool:
        """Return True if a plug is within 0.6 mm of the locked pose along its axis, and 4 degrees about it.

        The lugs are then past the apex of the slots, and only a torque unlocks the plug.
        """
        yaw = RollPitchYaw(X_LockedPlug.rotation()).yaw_angle()
        return bool(abs(X_LockedPlug.translation()[2]) < LOCKED_HEIGHT and abs(yaw) < LOCKED_ANGLE)
