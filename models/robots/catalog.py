"""Arms and end effectors of this package: KUKA LBR iiwa 14 R820, Franka Emika Panda, UR5e, connector tool, gripper."""

import math
from pathlib import Path

from pydrake.math import RigidTransform, RotationMatrix

from guiderail.models.robots.robot import EndEffector, JointDrives, Robot, register_end_effector, register_robot

IIWA14 = register_robot(
    Robot(
        name="iiwa14",
        title="KUKA LBR iiwa 14 R820",
        model=Path(__file__).parent / "iiwa14.urdf",
        base_frame="iiwa_link_0",
        flange_frame="iiwa_flange",
        joints=tuple(f"iiwa_joint_{number}" for number in range(1, 8)),
        home=(0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0),
        tool_turn=math.pi,
        # Joint torque feedback reduces the apparent inertia of the rotors. With the full inertia, the pose under
        # Cartesian impedance control would lag far behind its command.
        apparent_rotor_inertia=0.1,
        # Most of the inertia is rotor inertia, because a rotor turns 100 or 160 times as fast as its joint.
        drives=JointDrives(
            stiffness=(8000.0, 8000.0, 8000.0, 6000.0, 4000.0, 3000.0, 2000.0),
            inertia=(7.4, 7.4, 5.4, 5.4, 1.9, 1.5, 1.2),
        ),
        # From here, joint 7 can turn by the 122 degrees of tilt in pouring.
        level_posture=(-0.3, 0.6, 0.2, -1.6, -0.2, -0.7, -0.7),
        source=(
            "KUKA's data sheet: kinematics, limits; masses, inertias, rotors and gears as in public models of the arm; "
            "joint damping is a guess"
        ),
    )
)


PANDA = register_robot(
    Robot(
        name="panda",
        title="Franka Emika Panda",
        model=Path(__file__).parent / "panda.urdf",
        base_frame="panda_link0",
        flange_frame="panda_flange",
        joints=tuple(f"panda_joint{number}" for number in range(1, 8)),
        home=(0.0, 0.2, 0.0, -2.1, 0.0, 2.3, 0.0),
        tool_turn=0.0,
        # A guess: the arm has joint torque feedback like the iiwa, but its apparent inertia is not published.
        apparent_rotor_inertia=0.25,
        source=(
            "Franka's interface specifications: kinematics, limits; Gaz et al., IEEE RA-L 4(4), 2019: masses, centers "
            "of mass, inertias; Franka's reflected rotor inertias of the FR3, its successor; joint damping is a guess"
        ),
    )
)


UR5E = register_robot(
    Robot(
        name="ur5e",
        title="Universal Robots UR5e",
        model=Path(__file__).parent / "ur5e.urdf",
        base_frame="ur5e_base",
        flange_frame="ur5e_flange",
        joints=tuple(
            f"ur5e_{name}_joint" for name in ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
        ),
        home=(-0.25, -1.4, 1.85, -2.02, -1.57, 0.0),
        tool_turn=-math.pi / 2,
        # Without joint torque sensors, the motor torque accelerates the whole rotor inertia.
        apparent_rotor_inertia=1.0,
        drives=JointDrives(
            stiffness=(8000.0, 8000.0, 8000.0, 3000.0, 3000.0, 3000.0),
            inertia=(4.0, 4.0, 2.5, 0.25, 0.25, 0.25),
        ),
        # Posture with the elbow up.
        level_posture=(-0.24, -1.11, 1.54, -0.43, 1.33, 2.34),
        source=(
            "Universal Robots' Denavit-Hartenberg parameters, masses, centers of mass, inertias and limits; rotor "
            "inertias and joint damping are guesses"
        ),
    )
)


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
