"""End effectors: the connector tool and a gripper with two parallel fingers."""

import math
from pathlib import Path

from pydrake.math import RigidTransform, RotationMatrix

from guiderail.models.robots.robot import EndEffector, JointDrives, register_end_effector

# A bayonet is locked by a quarter turn, from 90 degrees to 0. The tool is mounted at half of this angle, so that the
# quarter turn is centered in the range of every robot's last joint.
MOUNT_ANGLE = math.pi / 4  # half of the quarter turn [rad]

CONNECTOR_TOOL = register_end_effector(
    EndEffector(
        name="connector_tool",
        title="connector tool",
        model=Path(__file__).parent / "connector_tool.urdf",
        mount_frame="tool_body",
        tool_center="tool_center",
        bodies=("tool_body", "tool_center"),
        X_FlangeMount=RigidTransform(RotationMatrix.MakeZRotation(-MOUNT_ANGLE), [0.0, 0.0, 0.0]),
        source="this project's own design",
    )
)

PARALLEL_GRIPPER = register_end_effector(
    EndEffector(
        name="parallel_gripper",
        title="gripper with two parallel fingers",
        model=Path(__file__).parent / "parallel_gripper.urdf",
        mount_frame="gripper_body",
        tool_center="tool_center",
        bodies=("gripper_body", "left_finger", "right_finger", "tool_center"),
        joints=("left_finger_joint",),
        opening={"left_finger_joint": 0.04, "right_finger_joint": 0.04},
        # One drive moves both fingers.
        drives=JointDrives(stiffness=(5000.0,), inertia=(0.12,)),
        source="this project's own design",
    )
)
