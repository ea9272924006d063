"""Published Cartesian motion limits of a Franka Emika Panda."""

from guiderail_hardware.models.motion_limits import MotionLimits

FRANKA_LIMITS = MotionLimits((1.7, 13.0, 6500.0), (2.5, 25.0, 12500.0))
"""Maximum speed, acceleration and jerk: linear [m/s, m/s², m/s³], then angular [rad/s, rad/s², rad/s³].

An FR3 has lower accelerations and jerks.
"""
