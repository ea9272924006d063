"""Drivers on LCM: the messages of an iiwa and of a Panda, and the bus that carries them."""

from __future__ import annotations

import secrets
import struct
import time as wall_time
from collections import deque
from dataclasses import astuple, replace
from functools import partial
from ipaddress import IPv4Address
from typing import Any, ClassVar
from urllib.parse import urlsplit

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status, lcmt_panda_command, lcmt_panda_status
from pydrake.lcm import DrakeLcm, DrakeLcmInterface

from guiderail.models.common.errors import InputError, brief
from guiderail_hardware.drivers.driver import STATUS_PERIOD, CommandCallback, Driver, register_driver
from guiderail_hardware.models.joint_status import (
    MALFORMED_STATUS,
    MAX_MISSED_MESSAGES,
    MAX_SENDERS,
    Heartbeat,
    JointStatus,
)
from guiderail_hardware.models.message_sequence import StatusSequence
from guiderail_hardware.systems.heartbeat_monitor import FORGET_TIME

PROVIDERS = ("udpm", "mpudpm", "tcpq", "memq")
MAX_WAIT = 3600.0  # longest wait for messages [s]; LCM counts milliseconds in 32 bits
MICROSECOND = 1e-6  # unit of a message's time [s]
HEAD_FORMAT = ">8sq"  # first fields of a status or command: message type, time [µs]
HEAD_SIZE = struct.calcsize(HEAD_FORMAT)
HEARTBEAT_FORMAT = struct.Struct(">q?qq")
# A safety monitor counts as ended if more than this number of other monitors' heartbeats arrived after its own last
# heartbeat. `MAX_SENDERS` monitors send this number of heartbeats in `FORGET_TIME`.
MAX_HEARTBEATS_MISSED = MAX_SENDERS * round(FORGET_TIME / STATUS_PERIOD)


def open_bus(url: str) -> DrakeLcm:
    """Open the LCM bus at `url`, LCM's default if empty.

    `DrakeLcm` accepts any URL; messages to an unusable URL are lost without an error.

    Raises:
        InputError: If the URL is unusable.
    """
    if not url:
        return DrakeLcm()
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise InputError(f"{brief(url)} is no URL of LCM: {error}") from None
    if url.partition("://")[0] not in PROVIDERS or "://" not in url:  # LCM distinguishes upper and lower case
        raise InputError(f"{brief(url)} is no URL of LCM, such as udpm://239.255.76.67:7667?ttl=0 or memq://")
    if parts.scheme in ("udpm", "mpudpm") and host is not None:
        try:
            is_group = IPv4Address(host).is_multicast
        except ValueError:
            is_group = False
        if not is_group or port == 0:
            raise InputError(f"{brief(url)}: LCM's messages go to a multicast address, 224.0.0.0 to 239.255.255.255")
    return DrakeLcm(url)


def handlers_are_safe() -> bool:
    """Return True if Drake holds the global interpreter lock (GIL) when it calls a Python message handler.

    Bindings made with nanobind (Drake 1.58 was tried) create the handler's argument without the GIL while a simulator
    reads the bus, which ends the process.
    """
    return not type(DrakeLcmInterface.__dict__["Subscribe"]).__module__.startswith("nanobind")


def check_handlers() -> None:
    """Check that messages can be received.

    Raises:
        InputError: If a message handler in Python would end the process.
    """
    if not handlers_are_safe():
        raise InputError(
            "this version of Drake calls Python's handlers of LCM messages without the interpreter's lock, which "
            "ends the process: for a robot or a simulated driver use drake 1.51 (constraints.txt)"
        )


class MessageCounter:
    """Counter of the messages of a channel; consecutive messages of the same type and time count once.

    Attributes:
        count: Number of messages that differ from their predecessor in type or time.
        repeats: Number of messages that equal their predecessor in type and time.
        head: Type and time of the newest message, which identify it.
    """

    def __init__(self) -> None:
        self.count = self.repeats = 0
        self.head = b""

    def add(self, message: bytes) -> None:
        """Count one message."""
        if message[:HEAD_SIZE] != self.head:
            self.head, self.count = message[:HEAD_SIZE], self.count + 1
        else:
            self.repeats += 1


class LcmDriver(Driver):
    """Driver with LCM messages as statuses and commands.

    Attributes:
        lcm: The bus.
        statuses: Counter of the statuses.
    """

    status_channel: ClassVar[str]  # channel of the statuses
    command_channel: ClassVar[str]  # channel of the commands
    status_type: ClassVar[Any]  # message class of the statuses
    status_fields: ClassVar[tuple[str, str, str]]  # fields of `status_type`: position, velocity and external torque
    external_torque_sign: ClassVar[float]  # 1 for torques of the surroundings on the arm, −1 for the reactions
    command_type: ClassVar[Any]  # message class of the commands, with the field `joint_torque`

    def __init__(self, lcm: DrakeLcmInterface | str = ""):
        """Open the connection on a bus; `lcm` is an object or a URL.

        Raises:
            InputError: If the URL is unusable.
        """
        super().__init__(lcm if isinstance(lcm, str) else "")
        self.lcm = open_bus(lcm) if isinstance(lcm, str) else lcm
        self.statuses = MessageCounter()
        self._status: JointStatus | None = None  # newest status
        self._sequence = StatusSequence(self.period)
        self._num_contested = 0  # foreign commands after the first command of this program
        # By sender: newest heartbeat, number of its channel, and value of `_num_heartbeats` when it arrived. The last
        # entry belongs to the sender of the last heartbeat.
        self._heartbeats: dict[int, tuple[Heartbeat, int, int]] = {}
        self._num_heartbeats = 0  # heartbeats received from all senders
        self._number = 0  # number of the channel of this program's heartbeat
        self._written: deque[bytes] = deque(maxlen=64)  # this program's own commands, which the bus returns
        self._listeners: list[CommandCallback] = []
        if handlers_are_safe():
            self.lcm.Subscribe(self.command_channel, self._on_command)
            for number in range(MAX_SENDERS):
                self.lcm.Subscribe(self.heartbeat_channel(number), partial(self._on_heartbeat, number))
            self.lcm.Subscribe(self.status_channel, self._on_status)

    @classmethod
    def heartbeat_channel(cls, number: int = 0) -> str:
        """Return a channel of a safety monitor's heartbeats; `number` is less than `MAX_SENDERS`.

        On UDP, `DrakeLcm` keeps one unread message of a channel and drops later messages. Each monitor therefore has
        its own channel, so that its heartbeats do not displace another monitor's heartbeats.
        """
        return cls.command_channel + ("_MONITOR" if number == 0 else f"_MONITOR_{number}")

    @classmethod
    def encode(cls, torque: np.ndarray, time: float) -> bytes:
        """Return the command message of torques (n,) [Nm] at a time [s]."""
        raise NotImplementedError

    @classmethod
    def decode(cls, message: bytes) -> JointStatus:
        """Return the content of a status message, or `MALFORMED_STATUS` if it cannot be decoded."""
        try:
            status = cls.status_type.decode(message)
            positions, velocities, external = (
                np.array(getattr(status, name), dtype=float) for name in cls.status_fields
            )
        except (ValueError, struct.error, OverflowError):
            return MALFORMED_STATUS
        return JointStatus(status.utime * MICROSECOND, positions, velocities, cls.external_torque_sign * external)

    @classmethod
    def decode_command(cls, message: bytes) -> tuple[np.ndarray, float] | None:
        """Return the torques (n,) [Nm] and the time [s] of a command message; None if it cannot be decoded."""
        try:
            command = cls.command_type.decode(message)
            return np.array(command.joint_torque, dtype=float), command.utime * MICROSECOND
        except (ValueError, struct.error, OverflowError):
            return None

    def read(self) -> JointStatus | None:
        """Return the newest status, or None before the first."""
        status = self._status
        if status is not None and status.foreign_commands != self._num_contested:
            self._status = status = replace(status, foreign_commands=self._num_contested)
        return status

    def write(self, torque: np.ndarray, time: float) -> None:
        """Send joint torques (n,) [Nm]; `time` is the time of the command [s]."""
        message = self.encode(torque, time)
        self._written.append(message)
        self.lcm.Publish(self.command_channel, message)

    def receive(self, timeout: float = 0.0) -> None:
        """Receive the messages that have arrived; if there are none, wait at most `timeout` [s].

        LCM waits for whole milliseconds: a positive timeout is rounded down, to at least 1 ms and at most `MAX_WAIT`.
        """
        self.lcm.HandleSubscriptions(max(1, int(1000 * min(timeout, MAX_WAIT))) if timeout > 0.0 else 0)

    def check_usable(self) -> None:
        """Raise `InputError` if a message handler in Python would end the process."""
        check_handlers()

    def add_listener(self, on_command: CommandCallback) -> None:
        """Register a callback for the torques (n,) [Nm] and time [s] of each command that another program sends."""
        self._listeners.append(on_command)

    def read_heartbeats(self) -> tuple[Heartbeat, ...]:
        """Return the newest heartbeat of each safety monitor, at most `MAX_SENDERS`.

        A monitor is left out if more than `MAX_HEARTBEATS_MISSED` heartbeats of other monitors followed its last one.
        """
        return tuple(heartbeat for heartbeat, *_ in self._heartbeats.values())

    def write_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Send a heartbeat of the safety monitor, if possible on a channel that no other monitor uses."""
        used = {number for newest, number, _ in self._heartbeats.values() if newest.sender != heartbeat.sender}
        if self._number in used:
            # Two monitors on one channel both change it: with a fixed rule they would choose the same channel again.
            self._number = secrets.choice(sorted(set(range(MAX_SENDERS)) - used) or [self._number])
        message = HEARTBEAT_FORMAT.pack(*astuple(heartbeat))
        self.lcm.Publish(self.heartbeat_channel(self._number), message)

    def __str__(self) -> str:
        """Return the URL of the bus and the channel of the statuses."""
        return f"{self.url or 'LCM'}, channel {self.status_channel}"

    def _on_status(self, message: bytes) -> None:
        status = self.decode(message)
        self._sequence.add(status)
        if self._status is not None and 0.0 < self._status.time - status.time <= MAX_MISSED_MESSAGES * self.period:
            status = self._status  # an older status has been overtaken
        self._status = replace(status, conflicts=self._sequence.num_conflicts, foreign_commands=self._num_contested)
        self.statuses.add(message)
        self.num_statuses = self.statuses.count

    def _on_command(self, message: bytes) -> None:
        if message in self._written:
            return
        # The commands of a safety monitor are not foreign. The monitor sends its heartbeat before them.
        if not any(heartbeat.is_stopping for heartbeat in self.read_heartbeats()):
            self.num_foreign_commands += 1
            self._num_contested += bool(self._written)
        command = self.decode_command(message)
        if command is not None:
            for on_command in self._listeners:
                on_command(*command)

    def _on_heartbeat(self, number: int, message: bytes) -> None:
        if len(message) == HEARTBEAT_FORMAT.size:
            heartbeat = Heartbeat(*HEARTBEAT_FORMAT.unpack(message))
            newest, *_ = self._heartbeats.pop(heartbeat.sender, (heartbeat,))
            # After a monitor has changed its channel, an older heartbeat may still be unread on its previous channel.
            is_older = heartbeat.sequence < newest.sequence
            self._num_heartbeats += 1
            self._heartbeats[heartbeat.sender] = (newest if is_older else heartbeat), number, self._num_heartbeats
            # While a monitor stops the arm, commands do not count as foreign. A monitor that ended during a stop is
            # therefore removed.
            while len(self._heartbeats) > MAX_SENDERS or self._num_missed() > MAX_HEARTBEATS_MISSED:
                self._heartbeats.pop(next(iter(self._heartbeats)))

    def _num_missed(self) -> int:
        """Return the number of heartbeats that followed the last heartbeat of the longest silent monitor."""
        return self._num_heartbeats - next(iter(self._heartbeats.values()))[2]


@register_driver("iiwa14")
class IiwaDriver(LcmDriver):
    """Drake's driver of a KUKA LBR iiwa, in torque mode."""

    name, robot = "iiwa", "iiwa14"
    status_channel = "IIWA_STATUS"
    command_channel = "IIWA_COMMAND"
    status_type = lcmt_iiwa_status
    status_fields = ("joint_position_measured", "joint_velocity_estimated", "joint_torque_external")
    external_torque_sign = 1.0
    command_type = lcmt_iiwa_command
    has_command_timeout = False
    torque_reflex_limits = tuple(60.0 * share for share in (1.0, 1.0, 1.0, 0.5, 0.2, 0.2, 0.1))

    @classmethod
    def encode(cls, torque: np.ndarray, time: float) -> bytes:
        """Return the command message of torques (7,) [Nm] at a time [s]."""
        command = lcmt_iiwa_command()
        command.utime = round(time / MICROSECOND)
        command.num_torques, command.joint_torque = len(torque), torque.tolist()
        return command.encode()


@register_driver("panda")
class PandaDriver(LcmDriver):
    """Drake's driver of a Franka Emika Panda, in torque mode.

    Franka's external torque is the torque of the arm on the surroundings. Reflex limits are from libfranka's examples.
    """

    name = robot = "panda"
    status_channel = "PANDA_STATUS"
    command_channel = "PANDA_COMMAND"
    status_type = lcmt_panda_status
    status_fields = ("joint_position", "joint_velocity", "joint_torque_external")
    external_torque_sign = -1.0
    command_type = lcmt_panda_command
    has_command_timeout = True
    torque_reflex_limits = (20.0, 20.0, 18.0, 18.0, 16.0, 14.0, 12.0)

    @classmethod
    def encode(cls, torque: np.ndarray, time: float) -> bytes:
        """Return the command message of torques (7,) [Nm], with the wall clock as its time.

        The driver drops commands that are older than 0.1 s, so the clocks of both machines must be synchronized.
        """
        del time
        command = lcmt_panda_command()
        command.utime = wall_time.time_ns() // 1000
        command.num_joint_torque, command.joint_torque = len(torque), torque.tolist()
        command.control_mode_expected = lcmt_panda_status.CONTROL_MODE_TORQUE
        return command.encode()
