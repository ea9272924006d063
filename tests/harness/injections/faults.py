"""Faults of a bus and of the programs on it, each with its required effect."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from drake import lcmt_iiwa_status

from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES, Fault

from . import bus as buses
from .bus import PERIOD, Bus, passes, with_fields

TOLERATED, STOPS = (
    (MAX_MISSED_MESSAGES - 2) * PERIOD,
    (MAX_MISSED_MESSAGES + 2) * PERIOD,
)  # a shorter fault is tolerated, a longer one stops the arm [s]
JOINT_FIELDS = tuple(lcmt_iiwa_status.__slots__[2:])
MEASURED = ("joint_position_measured", "joint_velocity_estimated", "joint_torque_external")


@dataclass(frozen=True)
class Injection:
    """Fault that is injected.

    Attributes:
        kind: Name of the kind.
        description: Parameters of the fault, for messages.
        begin: Function that begins the fault.
        end: Function that ends it.
        duration: Duration [s].
        stops: True if the fault must stop the arm, False if it must not, None if both are allowed.
        fault: The station's fault, if it is always the same.
    """

    kind: str
    description: str
    begin: Callable[[Bus], None]
    end: Callable[[Bus], None]
    duration: float
    stops: bool | None
    fault: Fault | None = None

    def inject(self, bus: Bus) -> buses.Observation:
        """Inject the fault while the arm moves; check its effect, and that the arm can resume."""
        bus.run_in()
        self.begin(bus)
        standstill = buses.STANDSTILL_WITHOUT_STATUS if self.kind.startswith(("status", "clock")) else buses.STANDSTILL
        observation = bus.watch(self.duration + 0.35, lambda: self.end(bus), self.duration, standstill)
        if self.stops is not None and self.stops != (observation.detected is not None):
            observation.wrong.append("not detected" if self.stops else f"stopped the arm: {observation.fault}")
        if self.stops and self.fault not in (None, bus.fault):
            observation.wrong.append(f"reported as {bus.fault.name}")
        try:
            bus.run_in(0.05)
        except AssertionError as error:
            observation.wrong.append(str(error))
        return observation


def _repair(bus: Bus) -> None:
    bus.on_status = bus.on_command = passes


def _must_stop(seconds: float) -> bool | None:
    return False if seconds <= TOLERATED else True if seconds >= STOPS else None


def _at(where: str, relay: Callable[[bytes], list[bytes]]) -> Callable[[Bus], None]:
    def begin(bus: Bus) -> None:
        setattr(bus, where, relay)

    return begin


def lost(where: str, seconds: float) -> Injection:
    """Drop all messages for a while."""
    kind = "status stopped" if where == "on_status" else "commands lost"
    return Injection(kind, f"{seconds} s", _at(where, lambda m: []), _repair, seconds, _must_stop(seconds))


def delayed(where: str, seconds: float) -> Injection:
    """Delay all messages by `seconds`, during 0.3 s."""
    name = "status" if where == "on_status" else "commands"
    queue: deque[bytes] = deque()
    steps = round(seconds / PERIOD)

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        queue.append(message)
        return [queue.popleft()] if len(queue) > steps else []

    stops = True if seconds >= STOPS else None
    return Injection(f"{name} delayed", f"{seconds} s", _at(where, relay), _repair, 0.3, stops)


def reordered(where: str, pairs: int) -> Injection:
    """Swap pairs of messages."""
    name = "status" if where == "on_status" else "commands"
    held: list[bytes] = []

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        held.append(message)
        if len(held) < 2:
            return []
        later, sooner = held.pop(), held.pop()
        return [later, sooner]

    return Injection(f"{name} reordered", f"{pairs} pairs", _at(where, relay), _repair, 2 * pairs * PERIOD, None)


def duplicated(where: str, seconds: float) -> Injection:
    """Send all messages twice, which must be tolerated."""
    name = "status" if where == "on_status" else "commands"
    return Injection(f"{name} duplicated", f"{seconds} s", _at(where, lambda m: [m, m]), _repair, seconds, False)


def replaced(kind: str, description: str, change: Callable[[bytes], bytes], messages: int) -> Injection:
    """Change statuses; the first changed one must stop the arm."""

    def relay(message: bytes) -> list[bytes]:
        return [change(message)] if message else [message]

    return Injection(
        kind, f"{description}, {messages} times", _at("on_status", relay), _repair, messages * PERIOD, True
    )


def not_finite(field: str, joints: list[int], value: float, messages: int) -> Injection:
    """Replace numbers with NaN or infinity."""

    def change(message: bytes) -> bytes:
        values = list(getattr(lcmt_iiwa_status.decode(message), field))
        for joint in joints:
            values[joint] = value
        return with_fields(message, **{field: values})

    return replaced("status NaN", f"{value} in {field}{joints}", change, messages)


def resized(joints: int, messages: int) -> Injection:
    """Change the number of joints."""

    def change(message: bytes) -> bytes:
        return with_fields(message, num_joints=joints, **{name: [0.0] * joints for name in JOINT_FIELDS})

    return replaced("status wrong size", f"{joints} joints", change, messages)


def garbage(rng: np.random.Generator, messages: int) -> Injection:
    """Replace a message by random bytes, truncate it, or flip a byte of its type."""
    variant = int(rng.integers(3))
    share, noise = float(rng.uniform(0.0, 0.99)), rng.bytes(int(rng.integers(0, 2000)))

    def change(message: bytes) -> bytes:
        if variant == 0:
            return noise
        if variant == 1:
            return message[: int(share * len(message))]
        return bytes([message[0] ^ 255]) + message[1:]

    return replaced("status garbage", ("noise", "cut off", "another type")[variant], change, messages)


def jumped(field: str, joint: int, by: float, messages: int) -> Injection:
    """Let a joint's position or velocity jump."""

    def change(message: bytes) -> bytes:
        values = list(getattr(lcmt_iiwa_status.decode(message), field))
        values[joint] += by
        return with_fields(message, **{field: values})

    return replaced("status jumped", f"{field}[{joint}] by {by:.2f}", change, messages)


def external_load(joint: int, torque: float) -> Injection:
    """Load a joint with more than its limit."""

    def change(message: bytes) -> bytes:
        values = list(lcmt_iiwa_status.decode(message).joint_torque_external)
        values[joint] += torque
        return with_fields(message, joint_torque_external=values)

    return replaced("external torque", f"{torque:.0f} Nm on joint {joint}", change, 1)


def clock_jump(seconds: float) -> Injection:
    """Shift the robot's clock; the end of the fault shifts it back, which is another jump."""

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        return [with_fields(message, utime=lcmt_iiwa_status.decode(message).utime + round(seconds * 1e6))]

    stops = True if abs(seconds) >= STOPS else None
    return Injection("clock jump", f"{seconds} s", _at("on_status", relay), _repair, 0.3, stops)


def controller_held_up(seconds: float) -> Injection:
    """Pause the commanding program."""

    def begin(bus: Bus) -> None:
        bus.has_controller = False

    def end(bus: Bus) -> None:
        bus.has_controller = True

    return Injection(
        "controller held up", f"{seconds} s", begin, end, seconds, _must_stop(seconds), Fault.DEADLINE_MISSED
    )


def controller_killed(seconds: float) -> Injection:
    """Kill the commanding program, and start it again."""

    def begin(bus: Bus) -> None:
        bus.has_controller = False

    return Injection("controller killed", f"back after {seconds} s", begin, Bus.start_controller, seconds, True)


def robot_killed(seconds: float) -> Injection:
    """Kill the robot, and start it again with its clock at zero."""

    def begin(bus: Bus) -> None:
        bus.has_robot = False

    return Injection("robot killed", f"back after {seconds} s", begin, Bus.start_robot, seconds, True)


def monitor_killed(seconds: float) -> Injection:
    """Kill the safety monitor, and start it again."""

    def begin(bus: Bus) -> None:
        bus.has_safety_monitor = False

    def end(bus: Bus) -> None:
        bus.has_safety_monitor = True

    return Injection("monitor killed", f"back after {seconds} s", begin, end, seconds, True)


def all_kinds(rng: np.random.Generator) -> Iterator[Injection]:
    """Yield one injection of each kind with random parameters."""

    def duration(longest: float = 5.0) -> float:
        return round(float(np.exp(rng.uniform(np.log(0.01), np.log(longest)))) / PERIOD) * PERIOD

    def few() -> int:
        return int(rng.integers(1, 20))

    for where in ("on_status", "on_command"):
        yield lost(where, duration())
        yield delayed(where, duration(0.2))
        yield reordered(where, few())
        yield duplicated(where, duration(0.5))
    joints = sorted(set(rng.integers(0, 7, 3).tolist()))
    yield not_finite(str(rng.choice(MEASURED)), joints, float(rng.choice([np.nan, np.inf, -np.inf])), few())
    yield resized(int(rng.choice([0, 1, 3, 6, 8, 14])), few())
    yield garbage(rng, few())
    yield jumped(
        "joint_position_measured", int(rng.integers(7)), float(rng.choice([-1, 1]) * rng.uniform(0.1, 3)), few()
    )
    yield jumped(
        "joint_velocity_estimated", int(rng.integers(7)), float(rng.choice([-1, 1]) * rng.uniform(1.8, 9)), few()
    )
    yield external_load(int(rng.integers(7)), float(rng.uniform(50.0, 200.0)))
    yield clock_jump(float(rng.choice([-1, 1])) * float(np.exp(rng.uniform(np.log(0.01), np.log(1e5)))))
    yield controller_held_up(duration(2.0))
    yield controller_killed(duration(1.0) + STOPS)
    yield robot_killed(duration(1.0) + STOPS)
    yield monitor_killed(duration(1.0) + 2.0 * STOPS)
