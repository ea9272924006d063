"""A bolted-on tool that holds a connector's back shell."""

from __future__ import annotations

import math
from pathlib import Path

from pydrake.math import RigidTransform, RotationMatrix

from guiderail.models.robots.robot import EndEffector, register_end_effector

# A bayonet is locked by a quarter turn, from 90 degrees to 0: with the tool turned back by half of that, the quarter
# turn lies in the middle of the last joint's range, whatever the robot.
HALF_OF_TURN = math.pi / 4  # [rad]

CONNECTOR_TOOL = register_end_effector(
    EndEffector(
        name="connector_tool",
        title="connector tool",
        model=Path(__file__).parent / "connector_tool.urdf",
        mount_frame="tool_body",
        tool_centre="tool_centre",
        bodies=("tool_body", "tool_centre"),
        X_FlangeMount=RigidTransform(RotationMatrix.MakeZRotation(-HALF_OF_TURN), [0.0, 0.0, 0.0]),
        source="this project's own design",
    )
)
