"""Faults of a bus and of its programs, each with its required effect."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from drake import lcmt_iiwa_status

from guiderail_hardware.models.joint_status import MAX_MISSED_MESSAGES, Fault

from . import bus as buses
from .bus import PERIOD, Bus, relay_unchanged, with_fields

MAX_TOLERATED = (MAX_MISSED_MESSAGES - 2) * PERIOD  # longest fault that must not stop the arm [s]
MIN_STOPPING = (MAX_MISSED_MESSAGES + 2) * PERIOD  # shortest fault that must stop the arm [s]
JOINT_FIELDS = tuple(lcmt_iiwa_status.__slots__[2:])
MEASURED = ("joint_position_measured", "joint_velocity_estimated", "joint_torque_external")


@dataclass(frozen=True)
class Injection:
    """Fault to inject, with its required effect.

    Attributes:
        kind: Name of the kind.
        description: Parameters of the fault as text.
        begin: Function that begins the fault.
        end: Function that ends the fault.
        duration: Duration of the fault [s].
        stops: True if the fault must stop the arm, False if it must not, None if both outcomes are allowed.
        fault: Required fault of the station; None to allow any.
    """

    kind: str
    description: str
    begin: Callable[[Bus], None]
    end: Callable[[Bus], None]
    duration: float
    stops: bool | None
    fault: Fault | None = None

    def inject(self, bus: Bus) -> buses.Observation:
        """Inject the fault while the arm moves; check the effect of the fault, and that the arm can resume."""
        bus.run_until_following()
        self.begin(bus)
        standstill = buses.STANDSTILL_WITHOUT_STATUS if self.kind.startswith(("status", "clock")) else buses.STANDSTILL
        observation = bus.observe(self.duration + 0.35, lambda: self.end(bus), self.duration, standstill)
        if self.stops is not None and self.stops != (observation.detected is not None):
            observation.failures.append("not detected" if self.stops else f"stopped the arm: {observation.fault}")
        if self.stops and self.fault not in (None, bus.fault):
            observation.failures.append(f"reported as {bus.fault.name}")
        try:
            bus.run_until_following(0.05)
        except AssertionError as error:
            observation.failures.append(str(error))
        return observation


def _end_relay(bus: Bus) -> None:
    bus.on_status = bus.on_command = relay_unchanged


def _must_stop(seconds: float) -> bool | None:
    return False if seconds <= MAX_TOLERATED else True if seconds >= MIN_STOPPING else None


def _set_relay(where: str, relay: Callable[[bytes], list[bytes]]) -> Callable[[Bus], None]:
    def begin(bus: Bus) -> None:
        setattr(bus, where, relay)

    return begin


def message_loss(where: str, seconds: float) -> Injection:
    """Return a fault that drops all messages for `seconds` [s]."""
    kind = "status stopped" if where == "on_status" else "commands lost"
    return Injection(kind, f"{seconds} s", _set_relay(where, lambda m: []), _end_relay, seconds, _must_stop(seconds))


def message_delay(where: str, seconds: float) -> Injection:
    """Return a fault that delays all messages by `seconds` [s] for 0.3 s."""
    name = "status" if where == "on_status" else "commands"
    queue: deque[bytes] = deque()
    steps = round(seconds / PERIOD)

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        queue.append(message)
        return [queue.popleft()] if len(queue) > steps else []

    stops = True if seconds >= MIN_STOPPING else None
    return Injection(f"{name} delayed", f"{seconds} s", _set_relay(where, relay), _end_relay, 0.3, stops)


def message_swap(where: str, pairs: int) -> Injection:
    """Return a fault that swaps the messages of several consecutive pairs."""
    name = "status" if where == "on_status" else "commands"
    pending: list[bytes] = []

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        pending.append(message)
        if len(pending) < 2:
            return []
        return [pending.pop(), pending.pop()]

    return Injection(
        f"{name} reordered", f"{pairs} pairs", _set_relay(where, relay), _end_relay, 2 * pairs * PERIOD, None
    )


def message_duplication(where: str, seconds: float) -> Injection:
    """Return a fault that sends all messages twice for `seconds` [s], which must not stop the arm."""
    name = "status" if where == "on_status" else "commands"
    return Injection(
        f"{name} duplicated", f"{seconds} s", _set_relay(where, lambda m: [m, m]), _end_relay, seconds, False
    )


def status_replacement(kind: str, description: str, change: Callable[[bytes], bytes], messages: int) -> Injection:
    """Return a fault that changes a number of statuses; the first changed status must stop the arm."""

    def relay(message: bytes) -> list[bytes]:
        return [change(message)] if message else [message]

    return Injection(
        kind, f"{description}, {messages} times", _set_relay("on_status", relay), _end_relay, messages * PERIOD, True
    )


def non_finite_status(field: str, joints: list[int], value: float, messages: int) -> Injection:
    """Return a fault that replaces values of a field with NaN or infinity."""

    def change(message: bytes) -> bytes:
        values = list(getattr(lcmt_iiwa_status.decode(message), field))
        for joint in joints:
            values[joint] = value
        return with_fields(message, **{field: values})

    return status_replacement("status NaN", f"{value} in {field}{joints}", change, messages)


def resized_status(joints: int, messages: int) -> Injection:
    """Return a fault that changes the number of joints in the status."""

    def change(message: bytes) -> bytes:
        return with_fields(message, num_joints=joints, **{name: [0.0] * joints for name in JOINT_FIELDS})

    return status_replacement("status wrong size", f"{joints} joints", change, messages)


def malformed_status(rng: np.random.Generator, messages: int) -> Injection:
    """Return a fault that replaces statuses by random bytes, truncates statuses, or inverts the byte of their type."""
    variant = int(rng.integers(3))
    fraction, noise = float(rng.uniform(0.0, 0.99)), rng.bytes(int(rng.integers(0, 2000)))

    def change(message: bytes) -> bytes:
        if variant == 0:
            return noise
        if variant == 1:
            return message[: int(fraction * len(message))]
        return bytes([message[0] ^ 255]) + message[1:]

    return status_replacement("status garbage", ("noise", "truncated", "another type")[variant], change, messages)


def status_jump(field: str, joint: int, offset: float, messages: int) -> Injection:
    """Return a fault that adds an offset to a joint's position [rad] or velocity [rad/s]."""

    def change(message: bytes) -> bytes:
        values = list(getattr(lcmt_iiwa_status.decode(message), field))
        values[joint] += offset
        return with_fields(message, **{field: values})

    return status_replacement("status jumped", f"{field}[{joint}] by {offset:.2f}", change, messages)


def external_load(joint: int, torque: float) -> Injection:
    """Return a fault that adds an external torque above the limit to a joint, in a single status."""

    def change(message: bytes) -> bytes:
        values = list(lcmt_iiwa_status.decode(message).joint_torque_external)
        values[joint] += torque
        return with_fields(message, joint_torque_external=values)

    return status_replacement("external torque", f"{torque:.0f} Nm on joint {joint}", change, 1)


def clock_jump(seconds: float) -> Injection:
    """Return a fault that shifts the robot's clock by `seconds` [s] and, at its end, shifts the clock back."""

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        return [with_fields(message, utime=lcmt_iiwa_status.decode(message).utime + round(seconds * 1e6))]

    stops = True if abs(seconds) >= MIN_STOPPING else None
    return Injection("clock jump", f"{seconds} s", _set_relay("on_status", relay), _end_relay, 0.3, stops)


def controller_pause(seconds: float) -> Injection:
    """Return a fault that pauses the station for `seconds` [s]."""

    def begin(bus: Bus) -> None:
        bus.has_controller = False

    def end(bus: Bus) -> None:
        bus.has_controller = True

    return Injection(
        "controller paused", f"{seconds} s", begin, end, seconds, _must_stop(seconds), Fault.DEADLINE_MISSED
    )


def controller_kill(seconds: float) -> Injection:
    """Return a fault that kills the station and restarts it after `seconds` [s]."""

    def begin(bus: Bus) -> None:
        bus.has_controller = False

    return Injection("controller killed", f"restarted after {seconds} s", begin, Bus.start_controller, seconds, True)


def robot_kill(seconds: float) -> Injection:
    """Return a fault that kills the robot and restarts it after `seconds` [s] with its clock at zero."""

    def begin(bus: Bus) -> None:
        bus.has_robot = False

    return Injection("robot killed", f"restarted after {seconds} s", begin, Bus.start_robot, seconds, True)


def monitor_kill(seconds: float) -> Injection:
    """Return a fault that kills the safety monitor and restarts it after `seconds` [s]."""

    def begin(bus: Bus) -> None:
        bus.has_safety_monitor = False

    def end(bus: Bus) -> None:
        bus.has_safety_monitor = True

    return Injection("monitor killed", f"restarted after {seconds} s", begin, end, seconds, True)


def all_kinds(rng: np.random.Generator) -> Iterator[Injection]:
    """Yield one injection of each kind with random parameters."""

    def duration(maximum: float = 5.0) -> float:
        return round(float(np.exp(rng.uniform(np.log(0.01), np.log(maximum)))) / PERIOD) * PERIOD

    def random_count() -> int:
        return int(rng.integers(1, 20))

    for where in ("on_status", "on_command"):
        yield message_loss(where, duration())
        yield message_delay(where, duration(0.2))
        yield message_swap(where, random_count())
        yield message_duplication(where, duration(0.5))
    joints = sorted(set(rng.integers(0, 7, 3).tolist()))
    yield non_finite_status(
        str(rng.choice(MEASURED)), joints, float(rng.choice([np.nan, np.inf, -np.inf])), random_count()
    )
    yield resized_status(int(rng.choice([0, 1, 3, 6, 8, 14])), random_count())
    yield malformed_status(rng, random_count())
    yield status_jump(
        "joint_position_measured",
        int(rng.integers(7)),
        float(rng.choice([-1, 1]) * rng.uniform(0.1, 3)),
        random_count(),
    )
    yield status_jump(
        "joint_velocity_estimated",
        int(rng.integers(7)),
        float(rng.choice([-1, 1]) * rng.uniform(1.8, 9)),
        random_count(),
    )
    yield external_load(int(rng.integers(7)), float(rng.uniform(50.0, 200.0)))
    yield clock_jump(float(rng.choice([-1, 1])) * float(np.exp(rng.uniform(np.log(0.01), np.log(1e5)))))
    yield controller_pause(duration(2.0))
    yield controller_kill(duration(1.0) + MIN_STOPPING)
    yield robot_kill(duration(1.0) + MIN_STOPPING)
    yield monitor_kill(duration(1.0) + 2.0 * MIN_STOPPING)
