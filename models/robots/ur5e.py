"""Universal Robots UR5e."""

import math
from pathlib import Path

from guiderail.models.robots.robot import JointDrives, Robot, register_robot

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
