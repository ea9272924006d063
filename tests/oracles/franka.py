"""Published limits of a Franka Emika Panda, which tests compare with."""

from guiderail.models.control.motion_constraints import MotionLimits

FRANKA_LIMITS = MotionLimits((1.7, 13.0, 6500.0), (2.5, 25.0, 12500.0))
"""Limits of the Cartesian motion; an FR3 has lower accelerations and jerks."""
