"""Robots and end effectors: data, models, mounting and inverse kinematics."""
