"""Gripper with two parallel fingers."""

from pathlib import Path

from guiderail.models.robots.robot import EndEffector, JointDrives, register_end_effector

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
