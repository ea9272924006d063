"""Robots and end effectors: data, models, mounting and inverse kinematics."""

DEFAULT_ROBOT = "iiwa14"
DEFAULT_END_EFFECTOR = "connector_tool"
