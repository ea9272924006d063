"""Reflexes of a Franka, for its simulator: the conditions under which the robot aborts a motion by itself."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

MAX_TORQUE_STEP = 1.0  # largest change of a commanded torque within 1 ms [Nm]; libfranka's `kMaxTorqueRate`
ROUNDING = 1e-6  # largest rounding error of a torque on the network [Nm]


class Reflex(IntEnum):
    """Reason of a reflex; the value is its place in libfranka's list of errors."""

    JOINT_POSITION_LIMITS_VIOLATION = 0
    JOINT_VELOCITY_VIOLATION = 3
    JOINT_REFLEX = 6
    CARTESIAN_REFLEX = 7
    CONTROLLER_TORQUE_DISCONTINUITY = 29


class ReflexDetector:
    """Detector of reflexes of a motion with commanded torques.

    Args:
        lower: Lower limits of the joint positions (7,) [rad].
        upper: Upper limits of the joint positions (7,) [rad].
        speed: Limits of the joint velocities (7,) [rad/s].
    """

    def __init__(self, lower: np.ndarray, upper: np.ndarray, speed: np.ndarray):
        self._lower, self._upper, self._speed = lower, upper, speed
        self._max_torque, self._max_wrench = np.full(7, np.inf), np.full(6, np.inf)
        self._last_command = np.zeros(7)

    def set_thresholds(self, torque: np.ndarray, wrench: np.ndarray) -> None:
        """Set the thresholds of the external joint torques (7,) [Nm] and of the external wrench (6,) [N, Nm]."""
        self._max_torque, self._max_wrench = np.asarray(torque), np.asarray(wrench)

    def begin(self) -> None:
        """Begin a motion; its first commanded torque may differ from zero by `MAX_TORQUE_STEP`."""
        self._last_command = np.zeros(7)

    def detect(
        self,
        command: np.ndarray,
        position: np.ndarray,
        velocity: np.ndarray,
        external_torque: np.ndarray,
        external_wrench: np.ndarray,
    ) -> Reflex | None:
        """Return the reason of a reflex in this millisecond, or None; of several reasons, return the first one checked.

        Args:
            command: Commanded torque without gravity (7,) [Nm].
            position: Joint positions (7,) [rad].
            velocity: Joint velocities (7,) [rad/s].
            external_torque: External joint torques (7,) [Nm].
            external_wrench: External wrench at the tool center, in the axes of its thresholds (6,): force [N], then
                torque [Nm].
        """
        step = np.abs(command - self._last_command)
        self._last_command = np.array(command)
        within = {  # NaN is not within a limit
            Reflex.CONTROLLER_TORQUE_DISCONTINUITY: step <= MAX_TORQUE_STEP + ROUNDING,
            Reflex.JOINT_POSITION_LIMITS_VIOLATION: (position >= self._lower) & (position <= self._upper),
            Reflex.JOINT_VELOCITY_VIOLATION: np.abs(velocity) <= self._speed,
            Reflex.JOINT_REFLEX: np.abs(external_torque) <= self._max_torque,
            Reflex.CARTESIAN_REFLEX: np.abs(external_wrench) <= self._max_wrench,
        }
        return next((reason for reason, is_within in within.items() if not is_within.all()), None)
