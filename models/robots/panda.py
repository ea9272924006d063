"""Franka Emika Panda."""

from pathlib import Path

from guiderail.models.robots.robot import Robot, register_robot

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
