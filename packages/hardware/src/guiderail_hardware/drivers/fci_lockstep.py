"""Lockstep of a hardware station and a simulated Franka: each process waits for the other, on a machine of any speed.

libfranka's protocol has no message that makes a robot wait. The simulated robot therefore listens on `LOCKSTEP_PORT`
for requests, one JSON object a line, and answers each with its time [s]. ``{"advance": h}`` is answered when the
robot's clock has advanced by h [s]; during a motion the robot then waits for the next request.
``{"parts": [fixture, workpiece]}`` moves the task's parts by their offsets.
"""

from __future__ import annotations

import json
import logging
import socket
from typing import Any

import numpy as np

from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import brief
from guiderail_hardware.drivers.clock import Clock

logger = logging.getLogger(__name__)

LOCKSTEP_PORT = 1339  # the robot's own ports are 1337 and 1338
MAX_WAIT = 3600.0  # longest wait for an answer [s]; a socket refuses a very long timeout


class FciLockstepClock(Clock):
    """Clock that advances a hardware station in lockstep with a simulated Franka.

    The station's time base advances with the robot's clock, so that a delay of either process does not make a status
    late. If the robot does not answer, the time base advances without statuses, which the station's watchdog detects.
    """

    def __init__(self, host: str, timeout: float, period: float):
        """Construct the clock.

        Args:
            host: Address of the simulated robot.
            timeout: Longest wait for an answer [s of wall clock time], at most `MAX_WAIT`.
            period: Status period of the station [s].
        """
        self._address, self._timeout, self._period = (host, LOCKSTEP_PORT), min(timeout, MAX_WAIT), period
        self._socket: socket.socket | None = None
        self._time, self._robot_time, self._has_timed_out = 0.0, np.inf, False

    def begin(self) -> None:
        """Prepare to advance a simulator that has just been initialized with the newest status."""
        self._follow(0.0)

    def _wait_for_step(self) -> float:
        self._follow(self._period)
        return self._time

    def move_parts(self, offsets: list[list[float]]) -> None:
        """Move the task's fixture and workpiece by their offsets, the arguments of `part_poses`."""
        self._request({"parts": offsets})

    def _follow(self, seconds: float) -> None:
        """Let the robot advance by `seconds`; add its progress to the time base, or `seconds` if it is unknown."""
        answer = self._request({"advance": seconds})
        if answer is None or answer < self._robot_time:  # no answer, or the first answer of a robot
            self._time += seconds
        else:
            self._time += answer - self._robot_time
        self._robot_time = np.inf if answer is None else answer

    def _request(self, message: dict[str, Any]) -> float | None:
        """Return the robot's time after a request [s], or None if it does not answer."""
        # If the robot is silent, wait for the full timeout only once, not in every step.
        timeout = self._period if self._has_timed_out else self._timeout
        try:
            if self._socket is None:
                self._socket = socket.create_connection(self._address, timeout)
            self._socket.settimeout(timeout)
            self._socket.sendall(json.dumps(message).encode() + b"\n")
            answer = self._socket.recv(4096)
            if not answer:
                raise ConnectionError
            self._has_timed_out = False
            return float(json.loads(answer))
        except OSError as error:
            self._has_timed_out = isinstance(error, TimeoutError)
            if self._socket is not None:
                self._socket.close()
            self._socket = None
            return None


class LockstepServer:
    """Connection of the simulated robot to the station; no call waits for the station."""

    def __init__(self, host: str):
        """Listen on `LOCKSTEP_PORT` at the address `host`."""
        self._listener = socket.create_server((host, LOCKSTEP_PORT))
        self._listener.setblocking(False)
        self._client: socket.socket | None = None
        self._buffer = b""

    @property
    def is_connected(self) -> bool:
        """True if a station is connected."""
        return self._client is not None

    @property
    def socket(self) -> socket.socket:
        """Socket to wait on: readable if there is a request or a new station."""
        return self._client or self._listener

    def receive(self) -> dict[str, Any] | None:
        """Return the next request, or None if there is none; accept a station that connects.

        A station that sends a malformed request is disconnected.
        """
        try:
            if self._client is None:
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
                self._client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._buffer = b""
            received = self._client.recv(4096)
            if not received:
                raise ConnectionError
            self._buffer += received
        except BlockingIOError:
            return None
        except OSError:
            self._disconnect()
            return None
        line, separator, rest = self._buffer.partition(b"\n")
        if not separator:
            return None
        self._buffer = rest
        try:
            return _parse_request(line)
        except (TypeError, ValueError, RecursionError):
            logger.warning("a station in lockstep is disconnected: %s is no request", brief(line))
            self._disconnect()
            return None

    def answer(self, time: float) -> None:
        """Answer a request with the robot's time [s]."""
        try:
            if self._client is not None:
                self._client.sendall(json.dumps(time).encode())
        except OSError:
            self._disconnect()

    def _disconnect(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None

    def close(self) -> None:
        """Close both sockets."""
        self._disconnect()
        self._listener.close()


def _parse_request(line: bytes) -> dict[str, Any]:
    """Return the request of a line.

    Raises:
        TypeError, ValueError or RecursionError: If it is malformed.
    """
    request = json.loads(line)
    if not isinstance(request, dict):
        raise TypeError
    fixture, workpiece = request.get("parts", [[0.0, 0.0]] * 2)
    for values, sizes in (([request.get("advance", 0.0)], (1,)), (fixture, (2, 3)), (workpiece, (2, 4))):
        numbers = as_numbers(values, "a request")
        if numbers.ndim != 1 or len(numbers) not in sizes or not is_finite(numbers):
            raise ValueError
    return request
