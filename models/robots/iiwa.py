"""KUKA LBR iiwa 14 R820."""

import math
from pathlib import Path

from guiderail.models.robots.robot import JointDrives, Robot, register_robot

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
