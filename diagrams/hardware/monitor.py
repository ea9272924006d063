"""Whoever stands by at a robot, and stops it where the program that commands it is gone."""

from __future__ import annotations

import struct
from collections import deque
from enum import IntEnum

import numpy as np
from pydrake.common.value import Value
from pydrake.lcm import DrakeLcmInterface
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.lcm import SerializerInterface

from guiderail.diagrams.hardware.driver import Driver
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES, Heartbeat, JointStatus, damping_torque
from guiderail.systems.torque_safety_limiter import ZERO_TORQUE_TIME, SafetyLimits

_WORD = struct.Struct(">q?")


def word_channel(command_channel: str) -> str:
    """Of what a deputy says."""
    return command_channel + "_MONITOR"


class WordSerializer(SerializerInterface):
    """Reads a deputy's words; what can't be read counts as none."""

    def __init__(self) -> None:
        SerializerInterface.__init__(self)

    def CreateDefaultValue(self) -> Value:
        """No word yet."""
        return Value[object]()

    def Deserialize(self, buffer: bytes, abstract_value: Value) -> None:
        """A message as a `Heartbeat`."""
        if len(buffer) == _WORD.size:
            abstract_value.set_value(Heartbeat(*_WORD.unpack(bytes(buffer))))


class MonitorState(IntEnum):
    """What a deputy does: nobody commands; somebody does; it damps; it says that there is no torque."""

    IDLE = 0
    WATCHING = 1
    DAMPING = 2
    RESTING = 3


class SafetyMonitor:
    """Listens to a robot's statuses and commands, and brings the arm to rest where commands stop.

    A driver may repeat the last torque for ever when the program that sent it is killed, or when its commands get lost.
    So this belongs on the driver's machine, in a process of its own. It has the robot's clock: nothing here waits. What
    it does it says with every status, so that whoever commands stops as well, and stops where there is no deputy any
    more.

    Attributes:
        duty: what it does now.
    """

    def __init__(
        self,
        lcm: DrakeLcmInterface,
        driver: Driver,
        plant: MultibodyPlant,
        limits: SafetyLimits,
        silence: float | None = None,
    ):
        """
        Args:
            lcm: the robot's bus.
            driver: of the arm.
            plant: the arm with what it carries and nothing else, finalized; only its inertia is used.
            limits: of the torques, and how a stop damps.
            silence: of the commands, beyond which it acts [s]; some of them may be lost unless given.
        """
        self.duty = MonitorState.IDLE
        self._lcm, self._driver, self._plant, self._limits = lcm, driver, plant, limits
        self._silence = MAX_MISSED_MESSAGES * driver.period if silence is None else silence
        self._context = plant.CreateDefaultContext()
        self._now = self._commanded_at = self._since = -np.inf
        self._has_torque = False
        self._words = 0
        self._mine: deque[bytes] = deque(maxlen=64)
        lcm.Subscribe(driver.command_channel, self._hear_command)
        lcm.Subscribe(driver.status_channel, self._hear_status)

    def _hear_command(self, message: bytes) -> None:
        if message in self._mine:
            return
        torque = self._driver.decode_command(message)
        if torque is None:
            return
        self._commanded_at, self._has_torque = self._now, bool(np.any(torque))
        if self.duty == MonitorState.IDLE:
            self.duty = MonitorState.WATCHING

    def _hear_status(self, message: bytes) -> None:
        status = self._driver.decode(message)
        if not status.is_readable or not np.isfinite(status.values()).all():
            return
        if len(status.positions) != self._plant.num_positions() or len(status.velocities) != len(status.positions):
            return
        if self._now - self._silence <= status.time < self._now:
            return  # another one overtook it
        if self.duty == MonitorState.WATCHING and (status.time < self._now or not np.isfinite(self._now)):
            self._commanded_at = status.time  # the robot's clock went back, or only began
            if self._now - status.time > self._silence and self._has_torque:
                self.duty, self._since = (
                    MonitorState.DAMPING,
                    status.time,
                )  # a torque may be on its way that is of another time
        self._now = status.time
        self._act(status)
        self._words += 1
        is_acting = self.duty in (MonitorState.DAMPING, MonitorState.RESTING)
        self._lcm.Publish(word_channel(self._driver.command_channel), _WORD.pack(self._words, is_acting))

    def _act(self, status: JointStatus) -> None:
        if self.duty == MonitorState.WATCHING and self._now - self._commanded_at > self._silence:
            self.duty, self._since = (MonitorState.DAMPING if self._has_torque else MonitorState.IDLE), self._now
        if self.duty in (MonitorState.DAMPING, MonitorState.RESTING) and self._now < self._since:
            self._since = self._now
        if self.duty == MonitorState.DAMPING and self._now - self._since >= self._limits.damping_time:
            self.duty, self._since = MonitorState.RESTING, self._now
        if self.duty == MonitorState.RESTING and self._now - self._since > ZERO_TORQUE_TIME:
            self.duty = MonitorState.IDLE
        if self.duty not in (MonitorState.DAMPING, MonitorState.RESTING):
            return
        torque = np.zeros(len(status.positions))
        if self.duty == MonitorState.DAMPING:
            self._plant.SetPositions(self._context, status.positions)
            M = self._plant.CalcMassMatrix(self._context)
            limits = np.array(self._limits.torque)
            damping = damping_torque(M, status.velocities, self._limits.decay_time, period=self._driver.period)
            torque = np.clip(damping, -limits, limits)
        message = self._driver.encode(self._now, torque)
        self._mine.append(message)
        self._lcm.Publish(self._driver.command_channel, message)
