"""Guard of a robot driver: an exception in the driver's code becomes a fault, so that the arm is brought to rest."""

from __future__ import annotations

import time as wall_time
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.models.common.errors import InputError
from guiderail_hardware.models.joint_status import MALFORMED_STATUS, Fault, Heartbeat, JointStatus, parse_status
from guiderail_hardware.models.robot_impedance import RobotImpedance
from guiderail_hardware.models.round_trip import RoundTrip

ERRORS = (Exception, SystemExit)  # exceptions of a driver that must not end the control of an arm


class DriverGuard:
    """Calls the methods of a driver while an arm is controlled, and catches their exceptions.

    If the driver raises an exception while a status is received, or returns no valid status object, the status counts
    as malformed. If it raises an exception while a command is sent, `take_failure` returns True once. The command of
    the next step is sent as usual; once a command has succeeded, `take_recovery` returns True once. All stations on a
    driver share one guard, `Driver.guard`. The driver is any object: no method of it is trusted to be complete.

    Attributes:
        read_error: Newest exception of receiving or reading, in words; empty if there was none.
        command_error: Newest exception of a command, in words; empty if there was none.
        num_failed_commands: Number of commands that raised an exception.
        round_trip: Round trip of the torques that stations send.
        has_torque: True if the robot may repeat a torque other than zero.
    """

    def __init__(self, driver: Any):
        self._driver = driver
        self.num_failed_commands = 0
        self.round_trip = RoundTrip()
        self._heartbeats: tuple[Heartbeat, ...] = ()  # heartbeats of the last check
        self._now = 0.0  # local time of the station's last check [s]
        self.forget_errors()

    def forget_errors(self) -> None:
        """Clear the errors, before the driver is used again."""
        self.read_error = self.command_error = ""
        self._has_failed_to_receive = self._has_failed_command = False
        self._is_failing = False  # the last command failed
        self._has_recovered = False  # a command succeeded after a failed one
        self._answer: object = None  # result of the last command
        self._has_refused_hold = False
        self.has_torque = True  # the robot may repeat a torque

    @property
    def error(self) -> str:
        """`Driver.error`, or the exception that it raises, in words."""
        try:
            return str(self._driver.error)
        except ERRORS as error:
            return _describe("error", error)

    def describe(self, fault: Fault) -> str:
        """Return the cause of a stop in words: the robot's own error, or the exception behind the fault."""
        causes = {Fault.MALFORMED: self.read_error, Fault.COMMAND_FAILED: self.command_error}
        return self.error or causes.get(fault, "")

    def receive(self, timeout: float = 0.0) -> None:
        """Call `Driver.receive`; after an exception, wait for at most a period, so that a loop does not spin."""
        try:
            self._driver.receive(timeout)
        except ERRORS as error:
            self.read_error, self._has_failed_to_receive = _describe("receive", error), True
            wall_time.sleep(min(timeout, self._driver.period))

    def read(self) -> JointStatus | None:
        """Return the newest status; it is malformed if an exception was raised since the last call."""
        has_failed, self._has_failed_to_receive = self._has_failed_to_receive, False
        try:
            status = parse_status(self._driver.read())
        except ERRORS as error:
            self.read_error = _describe("read", error)
            return MALFORMED_STATUS
        if has_failed:
            return MALFORMED_STATUS
        if status is MALFORMED_STATUS:
            self.read_error = ""  # an earlier exception is not the cause
        return status

    def read_heartbeats(self) -> tuple[Heartbeat, ...]:
        """Return the heartbeats.

        After an exception, or if the driver returns other objects, there are none, and the next status is malformed.
        """
        try:
            heartbeats = tuple(self._driver.read_heartbeats())
            if not all(isinstance(heartbeat, Heartbeat) for heartbeat in heartbeats):
                raise TypeError("it must return Heartbeat objects")
        except ERRORS as error:
            self.read_error, self._has_failed_to_receive = _describe("read_heartbeats", error), True
            return ()
        return heartbeats

    def measure_round_trip(self, heartbeats: tuple[Heartbeat, ...], clock: float | None) -> float:
        """Return the round trip at a station's check [s]; NaN if it is unknown.

        The heartbeats are the newest ones. Without a `clock` [s], the check counts as one period after the last one.
        """
        self._now = self._now + self._driver.period if clock is None else clock
        if heartbeats != self._heartbeats:  # otherwise the monitor is silent, which is another fault
            self.round_trip.update([heartbeat.command for heartbeat in heartbeats], self._now)
        self._heartbeats = heartbeats
        return self.round_trip.seconds

    def configure(self, impedance: RobotImpedance) -> None:
        """Call `PoseDriver.configure`; an exception counts as a failed command."""
        self._command("configure", impedance)

    def write(self, torque: np.ndarray, time: float) -> bool:
        """Send torques (n,) [Nm] with their time [s]; return False if the driver raises an exception."""
        self.has_torque, is_sent = True, self._command("write", torque, time)
        if is_sent:  # the arrival of a command that failed is not awaited
            self.round_trip.add_command(time, self._now)
        return is_sent

    def write_pose(self, X_BaseTool: RigidTransform, time: float) -> None:
        """Send a desired pose with its time [s]."""
        self._command("write_pose", X_BaseTool, time)

    def write_heartbeat(self, heartbeat: Heartbeat) -> None:
        """Send a heartbeat."""
        self._command("write_heartbeat", heartbeat)

    def stop(self) -> None:
        """Stop a robot that follows poses."""
        self._command("stop")

    def hold(self) -> bool:
        """Hold the arm; return False if the driver returns False or raises an exception, so that torques are sent.

        The torque is zero before, so that a driver that does not hold the arm does not repeat the last torque either.
        """
        has_failed = self._has_failed_command, self._is_failing
        if self.has_torque:
            self._command("write", np.zeros(len(self._driver.torque_reflex_limits)), self._now)
            self.has_torque = False
        if self._command("hold"):
            self._has_refused_hold = self._answer is False
        else:
            self._has_failed_command, self._is_failing = has_failed  # only failed torques count
            self._has_refused_hold = True
        return not self._has_refused_hold

    def take_refusal(self) -> bool:
        """Return True if the driver refused to hold the arm since the last call."""
        has_refused, self._has_refused_hold = self._has_refused_hold, False
        return has_refused

    def recover(self) -> None:
        """Clear an error of the robot while the arm is at rest.

        Raises:
            InputError: If the error persists, or the driver raises another exception.
        """
        self.call_at_rest("recover")
        self.forget_errors()

    def call_at_rest(self, method: str, *arguments: object) -> Any:
        """Call a method of the driver while the arm is at rest, and return its result.

        Raises:
            InputError: If the driver raises any exception.
        """
        try:
            return getattr(self._driver, method)(*arguments)
        except InputError:
            raise
        except ERRORS as error:
            raise InputError(f"the driver {self._driver.name} failed: {_describe(method, error)}") from error

    def take_failure(self) -> bool:
        """Return True if a command has failed since the last call."""
        has_failed, self._has_failed_command = self._has_failed_command, False
        return has_failed

    def take_recovery(self) -> bool:
        """Return True if a command has succeeded after failed ones since the last call."""
        has_recovered, self._has_recovered = self._has_recovered, False
        return has_recovered

    def check_readable(self) -> None:
        """Raise an `InputError` if receiving or reading raised an exception; call it before the arm moves."""
        if self.read_error:
            raise InputError(f"no status can be read from the driver {self._driver.name}: {self.read_error}")

    def _command(self, method: str, *arguments: object) -> bool:
        try:
            self._answer = getattr(self._driver, method)(*arguments)
        except ERRORS as error:
            self.command_error, self._has_failed_command = _describe(method, error), True
            self.num_failed_commands += 1
            self._is_failing = True
            return False
        self._has_recovered, self._is_failing = self._has_recovered or self._is_failing, False
        return True


def _describe(method: str, error: BaseException) -> str:
    return f"{method} raised {type(error).__name__}: {' '.join(str(error).split())}".rstrip(": ")
