"""Kinds of faults of a robot's sensors, clock, bus and programs, for `campaign.py` and `processes.py`.

A message fault is a function from a message and the time since the fault began [s] to the messages that arrive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status

from guiderail.diagrams.hardware.lcm import IiwaDriver

PERIOD = IiwaDriver.period
Q, V, T = "joint_position_measured", "joint_velocity_estimated", "joint_torque_external"
FIELDS = lcmt_iiwa_status.__slots__[2:]

Fault = Callable[[bytes, float], list[bytes]]


@dataclass(frozen=True)
class Kind:
    """Kind of fault.

    Attributes:
        name: Name of the kind.
        bound: Time within which the fault must be detected while the arm moves [s], derived in docs/robot.md; NaN if
            the arm may continue, because the fault has no effect.
        make: Function from a random generator to the fault of messages; None for a fault of a program.
        where: "sensor" (before station and safety monitor), "network" (before the station), "command" or "program".
        action: "kill" or "stop" and the program, for a fault of a program.
    """

    name: str
    bound: float
    make: Callable[[np.random.Generator], Fault] | None = None
    where: str = "sensor"
    action: tuple[str, str] = ("", "")

    @property
    def is_detectable(self) -> bool:
        """True if the fault must be detected."""
        return bool(np.isfinite(self.bound))


def _status(change: Callable[[lcmt_iiwa_status, float], None]) -> Fault:
    """Return a fault that changes the fields of each status."""

    def relay(message: bytes, elapsed: float) -> list[bytes]:
        status = lcmt_iiwa_status.decode(message)
        for field in FIELDS:
            setattr(status, field, list(getattr(status, field)))
        change(status, elapsed)
        return [status.encode()]

    return relay


def _frozen(fields: tuple[str, ...], one: bool) -> Callable[[np.random.Generator], Fault]:
    """Return a fault that repeats the first values of fields, of one joint or of all."""

    def make(rng: np.random.Generator) -> Fault:
        joint, first = int(rng.integers(7)), dict[str, list[float]]()

        def change(status: lcmt_iiwa_status, elapsed: float) -> None:
            for field in fields:
                values = getattr(status, field)
                kept = first.setdefault(field, list(values))
                for index in range(7):
                    if not one or index == joint:
                        values[index] = kept[index]

        return _status(change)

    return make


def _changed(
    field: str, change: Callable[[float, float], float], one: bool = False
) -> Callable[[np.random.Generator], Fault]:
    """Return a fault that changes the values of a field; `change` maps a value and the time since then [s]."""

    def make(rng: np.random.Generator) -> Fault:
        joint, sign = int(rng.integers(7)), float(rng.choice([-1.0, 1.0]))

        def changed(status: lcmt_iiwa_status, elapsed: float) -> None:
            values = getattr(status, field)
            for index in range(7):
                if not one or index == joint:
                    values[index] = sign * change(sign * values[index], elapsed)

        return _status(changed)

    return make


def _noisy(field: str, deviation: float) -> Callable[[np.random.Generator], Fault]:
    def make(rng: np.random.Generator) -> Fault:
        def change(status: lcmt_iiwa_status, elapsed: float) -> None:
            setattr(status, field, (np.array(getattr(status, field)) + rng.normal(0.0, deviation, 7)).tolist())

        return _status(change)

    return make


def _swapped(field: str) -> Callable[[np.random.Generator], Fault]:
    def make(rng: np.random.Generator) -> Fault:
        def change(status: lcmt_iiwa_status, elapsed: float) -> None:
            values = getattr(status, field)
            values[0], values[2] = values[2], values[0]

        return _status(change)

    return make


def _frozen_with_noise(rng: np.random.Generator) -> Fault:
    frozen = _frozen((Q, V, T), one=False)(rng)

    def relay(message: bytes, elapsed: float) -> list[bytes]:
        status = lcmt_iiwa_status.decode(frozen(message, elapsed)[0])
        for field in (Q, V):
            setattr(status, field, (np.array(getattr(status, field)) + rng.normal(0.0, 1e-6, 7)).tolist())
        return [status.encode()]

    return relay


def _clock(change: Callable[[float], float]) -> Callable[[np.random.Generator], Fault]:
    """Return a fault of the clock; `change` returns its error [s] after a time [s]."""

    def make(rng: np.random.Generator) -> Fault:
        def changed(status: lcmt_iiwa_status, elapsed: float) -> None:
            status.utime += round(1e6 * change(elapsed))

        return _status(changed)

    return make


def _frozen_clock(rng: np.random.Generator) -> Fault:
    first: list[int] = []

    def change(status: lcmt_iiwa_status, elapsed: float) -> None:
        first.append(status.utime)
        status.utime = first[0]

    return _status(change)


def _reset_clock(rng: np.random.Generator) -> Fault:
    first: list[int] = []

    def change(status: lcmt_iiwa_status, elapsed: float) -> None:
        first.append(status.utime)
        status.utime = status.utime - first[0]

    return _status(change)


def _repeated(rng: np.random.Generator) -> Fault:
    first: list[bytes] = []

    def relay(message: bytes, elapsed: float) -> list[bytes]:
        first.append(message)
        return first[:1]

    return relay


def _old_values(seconds: float) -> Callable[[np.random.Generator], Fault]:
    """Return a fault that delays the values, but not the time stamps."""

    def make(rng: np.random.Generator) -> Fault:
        queue: deque[lcmt_iiwa_status] = deque()

        def change(status: lcmt_iiwa_status, elapsed: float) -> None:
            queue.append(lcmt_iiwa_status.decode(status.encode()))
            old = queue[0]
            if len(queue) > round(seconds / PERIOD):
                queue.popleft()
            for field in FIELDS:
                setattr(status, field, list(getattr(old, field)))

        return _status(change)

    return make


def _delayed(seconds: float) -> Callable[[np.random.Generator], Fault]:
    def make(rng: np.random.Generator) -> Fault:
        queue: deque[bytes] = deque()

        def relay(message: bytes, elapsed: float) -> list[bytes]:
            queue.append(message)
            return [queue.popleft()] if len(queue) > round(seconds / PERIOD) else []

        return relay

    return make


def _lost(share: float) -> Callable[[np.random.Generator], Fault]:
    return lambda rng: lambda message, elapsed: [] if rng.random() < share else [message]


def _duplicated(rng: np.random.Generator) -> Fault:
    return lambda message, elapsed: [message, message]


def _reordered(rng: np.random.Generator) -> Fault:
    held: list[bytes] = []

    def relay(message: bytes, elapsed: float) -> list[bytes]:
        held.append(message)
        return [held.pop(), held.pop()] if len(held) == 2 else []

    return relay


def _second_robot(delay: float, offset: float) -> Callable[[np.random.Generator], Fault]:
    """Return a fault by a second robot at rest in the posture of the first status; its clock differs by a delay [s]."""

    def make(rng: np.random.Generator) -> Fault:
        first: list[lcmt_iiwa_status] = []

        def relay(message: bytes, elapsed: float) -> list[bytes]:
            status = lcmt_iiwa_status.decode(message)
            if not first:
                first.append(lcmt_iiwa_status.decode(message))
            other = first[0]
            other.utime = status.utime + round(1e6 * delay)
            other.joint_velocity_estimated = [0.0] * 7
            other.joint_position_measured = [value + offset for value in other.joint_position_measured]
            return [message, other.encode()]

        return relay

    return make


def _replaced(make_message: Callable[[bytes, np.random.Generator], bytes]) -> Callable[[np.random.Generator], Fault]:
    return lambda rng: lambda message, elapsed: [make_message(message, rng)]


def _resized(message: bytes, rng: np.random.Generator) -> bytes:
    status, joints = lcmt_iiwa_status.decode(message), int(rng.choice([0, 1, 3, 6, 8, 14]))
    status.num_joints = joints
    for field in FIELDS:
        setattr(status, field, [0.0] * joints)
    return status.encode()


def _second_program(change: Callable[[np.ndarray], np.ndarray], delay: float) -> Callable[[np.random.Generator], Fault]:
    """Return a fault by a second program that commands other torques after each command, with a clock error [s]."""

    def make(rng: np.random.Generator) -> Fault:
        def relay(message: bytes, elapsed: float) -> list[bytes]:
            command = lcmt_iiwa_command.decode(message)
            command.joint_torque = change(np.array(command.joint_torque)).tolist()
            command.utime += round(1e6 * delay)
            return [message, command.encode()]

        return relay

    return make


def _spike(size: float) -> Callable[[float, float], float]:
    return lambda value, elapsed: value + (size if elapsed < 0.5 * PERIOD else 0.0)


NEXT, TWO, FEW = 2 * PERIOD, 3 * PERIOD, 6 * PERIOD
TIMEOUT, HEARTBEAT, SLOW = 8 * PERIOD, 14 * PERIOD, 24 * PERIOD
UNDETECTED = float("nan")
# An error proportional to the velocity counts from 0.05 rad/s on, and its growth depends on the motion. Its bound is
# therefore that of a constant error of 0.05 rad/s.
KINDS = (
    Kind("all values frozen", FEW, _frozen(FIELDS, one=False)),
    Kind("one joint frozen", FEW, _frozen((Q, V, T), one=True)),
    Kind("positions frozen", FEW, _frozen((Q,), one=False)),
    Kind("velocities frozen", HEARTBEAT, _frozen((V,), one=False)),
    Kind("one position frozen", HEARTBEAT, _frozen((Q,), one=True)),
    Kind("one velocity frozen", HEARTBEAT, _frozen((V,), one=True)),
    Kind("all values frozen, with noise", FEW, _frozen_with_noise),
    Kind("external torques frozen", UNDETECTED, _frozen((T,), one=False)),
    Kind("time stamp frozen", NEXT, _frozen_clock),
    Kind("status repeated", TIMEOUT, _repeated),
    Kind("velocity + 1.2 rad/s", TWO, _changed(V, lambda v, t: v + 1.2, one=True)),
    Kind("velocity + 0.3 rad/s", FEW, _changed(V, lambda v, t: v + 0.3, one=True)),
    Kind("velocity + 0.05 rad/s", HEARTBEAT, _changed(V, lambda v, t: v + 0.05, one=True)),
    Kind("velocities zero", HEARTBEAT, _changed(V, lambda v, t: 0.0)),
    Kind("velocities negated", HEARTBEAT, _changed(V, lambda v, t: -v)),
    Kind("velocities doubled", HEARTBEAT, _changed(V, lambda v, t: 2.0 * v)),
    Kind("velocities halved", HEARTBEAT, _changed(V, lambda v, t: 0.5 * v)),
    Kind("velocities swapped", HEARTBEAT, _swapped(V)),
    Kind("velocity spike", NEXT, _changed(V, _spike(5.0), one=True)),
    Kind("velocity noise 0.3 rad/s", HEARTBEAT, _noisy(V, 0.3)),
    Kind("velocity drift 5 rad/s²", HEARTBEAT, _changed(V, lambda v, t: v + 5.0 * t, one=True)),
    Kind("position + 0.01 rad", NEXT, _changed(Q, lambda q, t: q + 0.01, one=True)),
    Kind("position + 1 rad", NEXT, _changed(Q, lambda q, t: q + 1.0, one=True)),
    Kind("position drift 0.1 rad/s", FEW, _changed(Q, lambda q, t: q + 0.1 * t, one=True)),
    Kind("position drift 1 rad/s", NEXT, _changed(Q, lambda q, t: q + 1.0 * (t + PERIOD), one=True)),
    Kind("positions swapped", NEXT, _swapped(Q)),
    Kind("positions in degrees", NEXT, _changed(Q, lambda q, t: q * 180.0 / np.pi)),
    Kind("position spike", NEXT, _changed(Q, _spike(0.5), one=True)),
    Kind("position noise 5 mrad", TWO, _noisy(Q, 5e-3)),
    Kind("external torque + 100 Nm", NEXT, _changed(T, lambda t, e: t + 100.0, one=True)),
    Kind("NaN in a position", NEXT, _changed(Q, lambda q, t: np.nan, one=True)),
    Kind("NaN in a velocity", NEXT, _changed(V, lambda v, t: np.nan, one=True)),
    Kind("NaN in an external torque", NEXT, _changed(T, lambda t, e: np.nan, one=True)),
    Kind("infinite velocity", NEXT, _changed(V, lambda v, t: np.inf, one=True)),
    Kind("wrong number of joints", NEXT, _replaced(_resized)),
    Kind("random bytes", NEXT, _replaced(lambda message, rng: rng.bytes(int(rng.integers(0, 500))))),
    Kind("message cut off", NEXT, _replaced(lambda message, rng: message[: int(rng.integers(len(message)))])),
    Kind("clock twice as fast", 10 * PERIOD, _clock(lambda t: t)),
    Kind("clock 1.5 times as fast", 16 * PERIOD, _clock(lambda t: 0.5 * t)),
    Kind("clock half as fast", HEARTBEAT, _clock(lambda t: -0.5 * t)),
    Kind("clock + 1 s", NEXT, _clock(lambda t: 1.0)),
    Kind("clock − 1 s", NEXT, _clock(lambda t: -1.0)),
    Kind("clock from zero", NEXT, _reset_clock),
    Kind("values 50 ms old", FEW, _old_values(0.05)),
    Kind("statuses 60 ms late", TIMEOUT, _delayed(0.06), "network"),
    Kind("statuses lost", TIMEOUT, _lost(1.0), "network"),
    Kind("statuses lost at the driver", TIMEOUT, _lost(1.0)),
    Kind("half of the statuses lost", UNDETECTED, _lost(0.5), "network"),
    Kind("statuses twice", UNDETECTED, _duplicated, "network"),
    Kind("statuses reordered", UNDETECTED, _reordered, "network"),
    Kind("second robot, same clock", NEXT, _second_robot(0.0, 0.0)),
    Kind("second robot, clock + 1 ms", FEW, _second_robot(1e-3, 0.0)),
    Kind("second robot, another clock", NEXT, _second_robot(7.0, 0.0)),
    Kind("second robot, another posture", NEXT, _second_robot(1e-3, 0.3)),
    Kind("commands lost", TIMEOUT, _lost(1.0), "command"),
    Kind("commands 60 ms late", TIMEOUT, _delayed(0.06), "command"),
    Kind("half of the commands lost", UNDETECTED, _lost(0.5), "command"),
    Kind("second program, torque zero", FEW, _second_program(lambda torque: np.zeros(7), 0.0), "command"),
    Kind("second program, torque negated", FEW, _second_program(lambda torque: -torque, 0.0), "command"),
    Kind("second program, another clock", FEW, _second_program(lambda torque: -torque, 40.0), "command"),
    Kind("second program, clock + 1 ms", SLOW, _second_program(lambda torque: 0.5 * torque, 1e-3), "command"),
    Kind("commander killed", TIMEOUT, None, "program", ("kill", "controller")),
    Kind("commander stopped", TIMEOUT, None, "program", ("stop", "controller")),
    Kind("robot killed", TIMEOUT, None, "program", ("kill", "robot")),
    Kind("robot stopped", TIMEOUT, None, "program", ("stop", "robot")),
    Kind("monitor killed", HEARTBEAT, None, "program", ("kill", "monitor")),
    Kind("monitor stopped", HEARTBEAT, None, "program", ("stop", "monitor")),
)
