"""Connector tool: a rigid tool that holds a connector's back shell."""

import math
from pathlib import Path

from pydrake.math import RigidTransform, RotationMatrix

from guiderail.models.robots.robot import EndEffector, register_end_effector

# A bayonet is locked by a quarter turn, from 90 degrees to 0. With the tool turned back by half of it, the quarter turn
# is in the middle of the last joint's range for every robot.
HALF_TURN_ANGLE = math.pi / 4  # [rad]

CONNECTOR_TOOL = register_end_effector(
    EndEffector(
        name="connector_tool",
        title="connector tool",
        model=Path(__file__).parent / "connector_tool.urdf",
        mount_frame="tool_body",
        tool_center="tool_center",
        bodies=("tool_body", "tool_center"),
        X_FlangeMount=RigidTransform(RotationMatrix.MakeZRotation(-HALF_TURN_ANGLE), [0.0, 0.0, 0.0]),
        source="this project's own design",
    )
)
