"""Kinds of faults of a robot's sensors, clock, bus and programs, for `campaign.py` and `fci/faults.py`.

A message fault is a function from a message and the time since the fault began [s] to the messages that arrive.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from drake import lcmt_iiwa_command, lcmt_iiwa_status

from guiderail_hardware.drivers.lcm import IiwaDriver

PERIOD = IiwaDriver.period
Q, V, T = "joint_position_measured", "joint_velocity_estimated", "joint_torque_external"
FIELDS = lcmt_iiwa_status.__slots__[2:]

Fault = Callable[[bytes, float], list[bytes]]

GROWTH = 1.25  # largest joint speed after a fault, relative to the speed at the fault or of the undisturbed motion


@dataclass(frozen=True)
class Kind:
    """Kind of fault, with the bound of its detection time.

    Attributes:
        name: Name of the kind.
        bound: Time within which the fault must be detected while the arm moves [s], derived in docs/robot.md; NaN if
            the arm may continue, because the fault has no effect.
        make: Function from a random generator to a message fault; None for a fault of a program.
        where: Place of the fault: "sensor" (before station and safety monitor), "network" (before the station only),
            "command" (before the robot) or "program".
        action: For a fault of a program, "kill" or "stop", and the name of the program.
        delays_heartbeats: True if the fault also affects the monitor's heartbeats, as a late network does.
        growth: Largest allowed joint speed after the fault, relative to the speed at the fault or of the undisturbed
            motion within the bound if that is higher.
        situation: "motion"; "start", if the fault is present when all programs start; or "pause", if the fault begins
            while the commanding program is paused for 0.6 s and then tries to resume.
        change: Function that changes the bus when the fault begins, for a fault of a clock or of a driver.
    """

    name: str
    bound: float
    make: Callable[[np.random.Generator], Fault] | None = None
    where: str = "sensor"
    action: tuple[str, str] = ("", "")
    delays_heartbeats: bool = False
    growth: float = GROWTH
    situation: str = "motion"
    change: Callable[[Any], None] | None = None

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


def _frozen(fields: tuple[str, ...], single_joint: bool) -> Callable[[np.random.Generator], Fault]:
    """Return a fault that repeats the first values of the given fields, for a single joint or all joints."""

    def make(rng: np.random.Generator) -> Fault:
        joint, first = int(rng.integers(7)), dict[str, list[float]]()

        def change(status: lcmt_iiwa_status, elapsed: float) -> None:
            for field in fields:
                values = getattr(status, field)
                first_values = first.setdefault(field, list(values))
                for index in range(7):
                    if not single_joint or index == joint:
                        values[index] = first_values[index]

        return _status(change)

    return make


def _changed(
    field: str, change: Callable[[float, float], float], single_joint: bool = False
) -> Callable[[np.random.Generator], Fault]:
    """Return a fault of a field; `change` maps a value and the time since the fault began [s] to the new value."""

    def make(rng: np.random.Generator) -> Fault:
        joint, sign = int(rng.integers(7)), float(rng.choice([-1.0, 1.0]))

        def changed(status: lcmt_iiwa_status, elapsed: float) -> None:
            values = getattr(status, field)
            for index in range(7):
                if not single_joint or index == joint:
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
    frozen = _frozen((Q, V, T), single_joint=False)(rng)

    def relay(message: bytes, elapsed: float) -> list[bytes]:
        status = lcmt_iiwa_status.decode(frozen(message, elapsed)[0])
        for field in (Q, V):
            setattr(status, field, (np.array(getattr(status, field)) + rng.normal(0.0, 1e-6, 7)).tolist())
        return [status.encode()]

    return relay


def _clock(change: Callable[[float], float]) -> Callable[[np.random.Generator], Fault]:
    """Return a fault of the clock; `change` maps the time since the fault began [s] to the clock error [s]."""

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
    """Return a fault that delays the values, but not the time stamps, by `seconds` [s]."""

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


def _lost(fraction: float) -> Callable[[np.random.Generator], Fault]:
    return lambda rng: lambda message, elapsed: [] if rng.random() < fraction else [message]


def _duplicated(rng: np.random.Generator) -> Fault:
    return lambda message, elapsed: [message, message]


def _reordered(rng: np.random.Generator) -> Fault:
    pending: list[bytes] = []

    def relay(message: bytes, elapsed: float) -> list[bytes]:
        pending.append(message)
        return [pending.pop(), pending.pop()] if len(pending) == 2 else []

    return relay


def _second_robot(delay: float, offset: float) -> Callable[[np.random.Generator], Fault]:
    """Return a fault by a second robot at rest.

    Args:
        delay: Difference between the clocks of the two robots [s].
        offset: Difference between the joint positions of the second robot and those of the first status [rad].
    """

    def make(rng: np.random.Generator) -> Fault:
        first: list[lcmt_iiwa_status] = []

        def relay(message: bytes, elapsed: float) -> list[bytes]:
            status = lcmt_iiwa_status.decode(message)
            if not first:
                first.append(lcmt_iiwa_status.decode(message))
            second = first[0]
            second.utime = status.utime + round(1e6 * delay)
            second.joint_velocity_estimated = [0.0] * 7
            second.joint_position_measured = [value + offset for value in second.joint_position_measured]
            return [message, second.encode()]

        return relay

    return make


def _reversed_groups(size: int) -> Callable[[np.random.Generator], Fault]:
    def make(rng: np.random.Generator) -> Fault:
        pending: list[bytes] = []

        def relay(message: bytes, elapsed: float) -> list[bytes]:
            pending.append(message)
            if len(pending) < size:
                return []
            group, pending[:] = pending[::-1], []
            return group

        return relay

    return make


def _moving_robot(
    order: str, delay: float, *, amplitude: float = 0.5, begins: float = 0.0
) -> Callable[[np.random.Generator], Fault]:
    """Return a fault by a second robot in the same posture that oscillates.

    Args:
        order: Senders of the statuses that arrive in a period, in turn: "1" or "2", or both, such as "21".
        delay: Difference between the clocks of the two robots [s].
        amplitude: Largest joint speed of the second robot [rad/s].
        begins: Time after the beginning of the fault until which only the first robot sends [s].
    """

    def make(rng: np.random.Generator) -> Fault:
        first: list[lcmt_iiwa_status] = []
        number = [0]

        def relay(message: bytes, elapsed: float) -> list[bytes]:
            if elapsed < begins:
                return [message]
            second = lcmt_iiwa_status.decode(message)
            if not first:
                first.append(lcmt_iiwa_status.decode(message))
            phase = 2.0 * np.pi * (elapsed - begins)
            second.utime += round(1e6 * delay)
            noise = rng.normal(0.0, 1e-6, (2, 7))
            start = first[0].joint_position_measured
            positions = start + amplitude / (2.0 * np.pi) * np.sin(phase) + noise[0]
            second.joint_position_measured = positions.tolist()
            second.joint_velocity_estimated = (amplitude * np.cos(phase) + noise[1]).tolist()
            senders = order.split(",")[number[0] % len(order.split(","))]
            number[0] += 1
            return [message if sender == "1" else second.encode() for sender in senders]

        return relay

    return make


def _imitator(speed: float) -> Callable[[np.random.Generator], Fault]:
    """Return a fault by a second robot that replaces the first, and moves like it plus a constant speed [rad/s]."""

    def make(rng: np.random.Generator) -> Fault:
        def change(status: lcmt_iiwa_status, elapsed: float) -> None:
            status.joint_velocity_estimated = [v + speed for v in status.joint_velocity_estimated]
            status.joint_position_measured = [q + speed * elapsed for q in status.joint_position_measured]

        return _status(change)

    return make


def _scaled_torques(scale: float) -> Callable[[np.random.Generator], Fault]:
    def make(rng: np.random.Generator) -> Fault:
        def relay(message: bytes, elapsed: float) -> list[bytes]:
            command = lcmt_iiwa_command.decode(message)
            command.joint_torque = [scale * torque for torque in command.joint_torque]
            return [command.encode()]

        return relay

    return make


def _clock_error(seconds: float, *names: str) -> Callable[[Any], None]:
    """Return a change that adds an error [s] to the clocks with the given attribute names."""

    def change(bus: Any) -> None:
        for name in names:
            setattr(bus, name, getattr(bus, name) + seconds)

    return change


def _hold(answer: Callable[[], bool], is_torque_zero: bool, bus: Any) -> None:
    """Set how drivers react to `hold`: their answer, and whether the robot's torque is zero from then on."""

    def hold() -> bool:
        if is_torque_zero:
            bus.set_torque(np.zeros(7))
        return answer()

    bus.on_hold = hold


def _raise() -> bool:
    raise RuntimeError("no brakes")


def _replaced(make_message: Callable[[bytes, np.random.Generator], bytes]) -> Callable[[np.random.Generator], Fault]:
    return lambda rng: lambda message, elapsed: [make_message(message, rng)]


def _resized(message: bytes, rng: np.random.Generator) -> bytes:
    status, joints = lcmt_iiwa_status.decode(message), int(rng.choice([0, 1, 3, 6, 8, 14]))
    status.num_joints = joints
    for field in FIELDS:
        setattr(status, field, [0.0] * joints)
    return status.encode()


def _second_program(change: Callable[[np.ndarray], np.ndarray], delay: float) -> Callable[[np.random.Generator], Fault]:
    """Return a fault by a second program, which sends changed torques after each command.

    Args:
        change: Function from the commanded to the changed torques, both (7,) [Nm].
        delay: Clock error of the second program [s].
    """

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


# Bounds of the detection time [s], derived in docs/robot.md.
NEXT, TWO, FEW = 2 * PERIOD, 3 * PERIOD, 6 * PERIOD
TIMEOUT, HEARTBEAT, SLOW = 8 * PERIOD, 14 * PERIOD, 24 * PERIOD
START_BOUND = 20 * PERIOD
UNDETECTED = float("nan")
# An error proportional to the velocity is detectable above 0.05 rad/s, and its growth depends on the motion. Its bound
# is therefore the bound of a constant error of 0.05 rad/s.
KINDS = (
    Kind("all values frozen", FEW, _frozen(FIELDS, single_joint=False)),
    Kind("one joint frozen", FEW, _frozen((Q, V, T), single_joint=True)),
    Kind("positions frozen", FEW, _frozen((Q,), single_joint=False)),
    Kind("velocities frozen", HEARTBEAT, _frozen((V,), single_joint=False)),
    Kind("one position frozen", HEARTBEAT, _frozen((Q,), single_joint=True)),
    Kind("one velocity frozen", HEARTBEAT, _frozen((V,), single_joint=True)),
    Kind("all values frozen, with noise", FEW, _frozen_with_noise),
    Kind("external torques frozen", UNDETECTED, _frozen((T,), single_joint=False)),
    Kind("time stamp frozen", NEXT, _frozen_clock),
    Kind("status repeated", TIMEOUT, _repeated),
    Kind("velocity + 1.2 rad/s", TWO, _changed(V, lambda v, t: v + 1.2, single_joint=True)),
    Kind("velocity + 0.3 rad/s", FEW, _changed(V, lambda v, t: v + 0.3, single_joint=True)),
    Kind("velocity + 0.05 rad/s", HEARTBEAT, _changed(V, lambda v, t: v + 0.05, single_joint=True)),
    Kind("velocities zero", HEARTBEAT, _changed(V, lambda v, t: 0.0)),
    Kind("velocities negated", HEARTBEAT, _changed(V, lambda v, t: -v)),
    Kind("velocities doubled", HEARTBEAT, _changed(V, lambda v, t: 2.0 * v)),
    Kind("velocities halved", HEARTBEAT, _changed(V, lambda v, t: 0.5 * v)),
    Kind("velocities swapped", HEARTBEAT, _swapped(V)),
    Kind("velocity spike", NEXT, _changed(V, _spike(5.0), single_joint=True)),
    Kind("velocity noise 0.3 rad/s", HEARTBEAT, _noisy(V, 0.3)),
    Kind("velocity drift 0.5 rad/s²", 60 * PERIOD, _changed(V, lambda v, t: v + 0.5 * t, single_joint=True)),
    Kind("velocity drift 5 rad/s²", HEARTBEAT, _changed(V, lambda v, t: v + 5.0 * t, single_joint=True)),
    Kind("position + 0.01 rad", NEXT, _changed(Q, lambda q, t: q + 0.01, single_joint=True)),
    Kind("position + 1 rad", NEXT, _changed(Q, lambda q, t: q + 1.0, single_joint=True)),
    Kind("position drift 9 mrad/s", 160 * PERIOD, _changed(Q, lambda q, t: q + 9e-3 * t, single_joint=True)),
    Kind("position drift 0.1 rad/s", FEW, _changed(Q, lambda q, t: q + 0.1 * t, single_joint=True)),
    Kind("position drift 1 rad/s", NEXT, _changed(Q, lambda q, t: q + 1.0 * (t + PERIOD), single_joint=True)),
    Kind("positions swapped", NEXT, _swapped(Q)),
    Kind("positions in degrees", NEXT, _changed(Q, lambda q, t: q * 180.0 / np.pi)),
    Kind("position spike", NEXT, _changed(Q, _spike(0.5), single_joint=True)),
    Kind("position noise 5 mrad", TWO, _noisy(Q, 5e-3)),
    Kind("external torque + 100 Nm", NEXT, _changed(T, lambda t, e: t + 100.0, single_joint=True)),
    Kind("NaN in a position", NEXT, _changed(Q, lambda q, t: np.nan, single_joint=True)),
    Kind("NaN in a velocity", NEXT, _changed(V, lambda v, t: np.nan, single_joint=True)),
    Kind("NaN in an external torque", NEXT, _changed(T, lambda t, e: np.nan, single_joint=True)),
    Kind("infinite velocity", NEXT, _changed(V, lambda v, t: np.inf, single_joint=True)),
    Kind("wrong number of joints", NEXT, _replaced(_resized)),
    Kind("random bytes", NEXT, _replaced(lambda message, rng: rng.bytes(int(rng.integers(0, 500))))),
    Kind("message cut off", NEXT, _replaced(lambda message, rng: message[: int(rng.integers(len(message)))])),
    Kind("clock twice as fast", 10 * PERIOD, _clock(lambda t: t)),
    Kind("clock 1.5 times as fast", 16 * PERIOD, _clock(lambda t: 0.5 * t)),
    Kind("clock 1.1 times as fast", 34 * PERIOD, _clock(lambda t: 0.1 * t)),
    Kind("clock half as fast", HEARTBEAT, _clock(lambda t: -0.5 * t)),
    Kind("clock 0.9 times as fast", 80 * PERIOD, _clock(lambda t: -0.1 * t)),
    *(
        Kind(f"clock {seconds:+g} s", NEXT if abs(seconds) > 0.04 else UNDETECTED, _clock(lambda t, s=seconds: s))
        for size in (1e-3, 1e-2, 0.1, 1.0, 10.0)
        for seconds in (size, -size)
    ),
    Kind("clock from zero", NEXT, _reset_clock),
    Kind("values 50 ms old", FEW, _old_values(0.05)),
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
    Kind("half of the commands lost", UNDETECTED, _lost(0.5), "command"),
    Kind("second program, torque zero", FEW, _second_program(lambda torque: np.zeros(7), 0.0), "command"),
    Kind("second program, torque negated", FEW, _second_program(lambda torque: -torque, 0.0), "command"),
    Kind("second program, another clock", FEW, _second_program(lambda torque: -torque, 40.0), "command"),
    Kind("second program, clock + 1 ms", SLOW, _second_program(lambda torque: 0.5 * torque, 1e-3), "command"),
    *(
        Kind(f"{name} {milliseconds} ms late", bound, _delayed(1e-3 * milliseconds), where, ("", ""), True)
        for name, where in (("commands", "command"), ("statuses", "network"))
        for milliseconds, bound in (
            (5, UNDETECTED),
            (10, 10 * PERIOD),
            (15, 11 * PERIOD),
            (20, 12 * PERIOD),
            (25, 13 * PERIOD),
            (30, 14 * PERIOD),
            (45, HEARTBEAT),
            (60, TIMEOUT),
        )
    ),
    Kind("statuses reversed, groups of 8", 10 * PERIOD, _reversed_groups(8), "network"),
    *(
        Kind(f"moving robot {order}, clock {delay:+g} s", bound, _moving_robot(order, delay))
        for order, bound in (("2", TIMEOUT), ("21", NEXT), ("1,2", FEW), ("1,1,2", FEW), ("1,1,2,2", FEW))
        for delay in (0.0, 1e-3, 7.0)
    ),
    *(
        Kind(f"resting robot {order}, clock +0 s", HEARTBEAT, _moving_robot(order, 0.0, amplitude=0.0))
        for order in ("2", "21", "1,2", "1,1,2,2")
    ),
    Kind("moving robot 2, same motion + 0.1 rad/s", UNDETECTED, _imitator(0.1)),
    # The stop's damping removes 22 % of the velocity in a period, with five times the torque 110 %: more than a loop
    # with a delay of a period tolerates.
    *(
        Kind(f"torques times {scale:g}", UNDETECTED, _scaled_torques(scale), "command", growth=growth)
        for scale, growth in ((0.5, 1.25), (1.5, 1.25), (2, 1.25), (3, 1.25), (5, 3.0))
    ),
    Kind("controller killed", TIMEOUT, None, "program", ("kill", "controller")),
    Kind("controller stopped", TIMEOUT, None, "program", ("stop", "controller")),
    Kind("robot killed", TIMEOUT, None, "program", ("kill", "robot")),
    Kind("robot stopped", TIMEOUT, None, "program", ("stop", "robot")),
    Kind("monitor killed", HEARTBEAT, None, "program", ("kill", "monitor")),
    Kind("monitor stopped", HEARTBEAT, None, "program", ("stop", "monitor")),
)
# Faults that only `bus.py` can inject. The time until the detection of a latency that is constant from the start on
# begins with the first torque.
LATENCIES = (
    ("commands", "command", False, 1.25),
    ("statuses", "network", True, 1.25),
    # Before the monitor, so that its heartbeats do not show the delay, which makes the impedance unstable above 20 ms.
    ("statuses at the driver", "sensor", False, 2.0),
)
BUS_KINDS = (
    *(
        Kind(
            f"{name} always {latency} ms late",
            bound,
            _delayed(1e-3 * latency),
            where,
            ("", ""),
            is_late,
            growth=growth,
            situation="start",
        )
        for name, where, is_late, growth in LATENCIES
        for latency in (5, 10, 15, 20, 30, 45, 60)
        for bound in (UNDETECTED if latency == 5 or where == "sensor" else START_BOUND,)
    ),
    *(
        Kind(f"{place} clock {seconds:+g} s", NEXT if size > 0.04 else UNDETECTED, None, "clock", change=change)
        for place, name in (("station's", "station_clock_error"), ("monitor's", "monitor_clock_error"))
        for size in (1e-3, 1e-2, 0.1, 1.0, 10.0)
        for seconds in (size, -size)
        for change in (_clock_error(seconds, name),)
    ),
    *(
        Kind(f"hold() {name}, clock +1 s", NEXT, _clock(lambda t: 1.0), change=partial(_hold, answer, is_torque_zero))
        for name, answer, is_torque_zero in (
            ("repeats the last torque", lambda: True, False),
            ("only ends the torque", lambda: True, True),
            ("returns False", lambda: False, False),
            ("raises an exception", _raise, False),
        )
    ),
    *(
        Kind(
            f"paused, moving robot {order}, clock {delay:+g} s",
            UNDETECTED if order == "2" and delay < 1.0 else TIMEOUT,
            _moving_robot(order, delay, begins=0.1),
            situation="pause",
        )
        for order in ("2", "21", "1,2", "1,1,2", "1,1,2,2")
        for delay in (0.0, 1e-3, 7.0)
    ),
)
