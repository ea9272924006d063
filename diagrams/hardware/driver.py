"""What is to be known of the program that drives a robot and speaks on a bus."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from guiderail.diagrams.stations.station import CONTROL_PERIOD
from guiderail.models.control.joint_status import MALFORMED_STATUS, JointStatus

MICROSECOND = 1e-6  # [s]
STATUS_PERIOD = CONTROL_PERIOD / 4  # [s]: 5 ms, what drivers on LCM have; a control period is a multiple to the bit


@dataclass(frozen=True)
class Driver:
    """How the program that drives a robot speaks over LCM, and what it does by itself.

    Attributes:
        name: what Drake calls its ports.
        status_channel, command_channel: of the bus.
        status_type: its message, of the fields that `status_fields` names.
        status_fields: of position, velocity and external torque.
        external_torque_sign: what the last of these is multiplied by to be what the surroundings do to the arm.
        command_type: its message, with the field `joint_torque`.
        encode: from the time [s] and torques (n,) to a command.
        trips: external torques at which it stops by itself when it is controlled by torque, (n,) [Nm].
        has_command_timeout: whether it brings the arm to rest where commands stop; otherwise it needs a `SafetyMonitor`.
        hold_off: for how long after its first status it wants no command [s].
        period: at which commands are sent to it [s].
    """

    name: str
    status_channel: str
    command_channel: str
    status_type: Any
    status_fields: tuple[str, str, str]
    external_torque_sign: float
    command_type: Any
    encode: Callable[[float, np.ndarray], bytes]
    torque_reflex_limits: tuple[float, ...]
    has_command_timeout: bool
    hold_off: float = 0.25
    period: float = STATUS_PERIOD

    def decode(self, message: bytes) -> JointStatus:
        """What a message says; `MALFORMED_STATUS` where it can't be read."""
        try:
            status = self.status_type.decode(message)
            positions, velocities, external = (
                np.array(getattr(status, name), dtype=float) for name in self.status_fields
            )
        except (ValueError, struct.error, OverflowError):
            return MALFORMED_STATUS
        return JointStatus(status.utime * MICROSECOND, positions, velocities, self.external_torque_sign * external)

    def decode_command(self, message: bytes) -> np.ndarray | None:
        """The torques of a command [Nm]; None where it can't be read."""
        try:
            return np.array(self.command_type.decode(message).joint_torque, dtype=float)
        except (ValueError, struct.error, OverflowError):
            return None
