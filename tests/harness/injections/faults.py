"""What can happen on a bus, each with what has to come of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from drake import lcmt_iiwa_status

from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES, Fault

from . import bus as buses
from .bus import PERIOD, Bus, changed, passes

TOLERATED, STOPS = (
    (MAX_MISSED_MESSAGES - 2) * PERIOD,
    (MAX_MISSED_MESSAGES + 2) * PERIOD,
)  # [s]: shorter is borne, longer stops the arm
JOINT_FIELDS = tuple(lcmt_iiwa_status.__slots__[2:])
MEASURED = ("joint_position_measured", "joint_velocity_estimated", "joint_torque_external")


@dataclass(frozen=True)
class Injection:
    """A fault: how it begins and ends, how long it lasts [s], and whether it must stop the arm; None where it may.

    Where it must, `says` is what the station calls it, if that is always the same.
    """

    kind: str
    words: str
    begin: Callable[[Bus], None]
    end: Callable[[Bus], None]
    lasts: float
    stops: bool | None
    says: Fault | None = None

    def inject(self, bus: Bus) -> buses.Seen:
        """Lets it happen to an arm that is moving, checks what comes of it, and that the arm then goes on."""
        bus.run_in()
        self.begin(bus)
        standstill = buses.UNSEEN if self.kind.startswith("status") else buses.STANDSTILL
        seen = bus.watch(self.lasts + 0.35, lambda: self.end(bus), self.lasts, standstill)
        if self.stops is not None and self.stops != (seen.detected is not None):
            seen.wrong.append("not detected" if self.stops else f"stopped the arm: {seen.fault}")
        if self.stops and self.says not in (None, bus.fault):
            seen.wrong.append(f"is called {bus.fault.name}")
        try:
            bus.run_in(0.05)
        except AssertionError as error:
            seen.wrong.append(str(error))
        return seen


def _mended(bus: Bus) -> None:
    bus.on_status = bus.on_command = passes


def _must_stop(seconds: float) -> bool | None:
    return False if seconds <= TOLERATED else True if seconds >= STOPS else None


def _at(where: str, relay: Callable[[bytes], list[bytes]]) -> Callable[[Bus], None]:
    def begin(bus: Bus) -> None:
        setattr(bus, where, relay)

    return begin


def lost(where: str, seconds: float) -> Injection:
    """Nothing arrives for a while."""
    kind = "status stopped" if where == "on_status" else "commands lost"
    return Injection(kind, f"{seconds} s", _at(where, lambda m: []), _mended, seconds, _must_stop(seconds))


def delayed(where: str, seconds: float) -> Injection:
    """Everything arrives late, for a third of a second."""
    name = "status" if where == "on_status" else "commands"
    queue: deque[bytes] = deque()
    steps = round(seconds / PERIOD)

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        queue.append(message)
        return [queue.popleft()] if len(queue) > steps else []

    stops = True if seconds >= STOPS else None
    return Injection(f"{name} delayed", f"{seconds} s", _at(where, relay), _mended, 0.3, stops)


def reordered(where: str, pairs: int) -> Injection:
    """The later of two arrives first."""
    name = "status" if where == "on_status" else "commands"
    kept: list[bytes] = []

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        kept.append(message)
        if len(kept) < 2:
            return []
        later, sooner = kept.pop(), kept.pop()
        return [later, sooner]

    return Injection(f"{name} reordered", f"{pairs} pairs", _at(where, relay), _mended, 2 * pairs * PERIOD, None)


def duplicated(where: str, seconds: float) -> Injection:
    """Everything arrives twice, which is no fault."""
    name = "status" if where == "on_status" else "commands"
    return Injection(f"{name} duplicated", f"{seconds} s", _at(where, lambda m: [m, m]), _mended, seconds, False)


def replaced(kind: str, words: str, change: Callable[[bytes], bytes], messages: int) -> Injection:
    """Statuses come as others than they were sent; the first of them must stop the arm."""

    def relay(message: bytes) -> list[bytes]:
        return [change(message)] if message else [message]

    return Injection(kind, f"{words}, {messages} times", _at("on_status", relay), _mended, messages * PERIOD, True)


def not_finite(field: str, joints: list[int], value: float, messages: int) -> Injection:
    """Numbers that are none."""

    def change(message: bytes) -> bytes:
        values = list(getattr(lcmt_iiwa_status.decode(message), field))
        for joint in joints:
            values[joint] = value
        return changed(message, **{field: values})

    return replaced("status NaN", f"{value} in {field}{joints}", change, messages)


def resized(joints: int, messages: int) -> Injection:
    """Another number of joints."""

    def change(message: bytes) -> bytes:
        return changed(message, num_joints=joints, **{name: [0.0] * joints for name in JOINT_FIELDS})

    return replaced("status wrong size", f"{joints} joints", change, messages)


def garbage(rng: np.random.Generator, messages: int) -> Injection:
    """Bytes: random ones, the message cut off, or with a flipped byte in its head."""
    how = int(rng.integers(3))
    share, noise = float(rng.uniform(0.0, 0.99)), rng.bytes(int(rng.integers(0, 2000)))

    def change(message: bytes) -> bytes:
        if how == 0:
            return noise
        if how == 1:
            return message[: int(share * len(message))]
        return bytes([message[0] ^ 255]) + message[1:]

    return replaced("status garbage", ("noise", "cut off", "another type")[how], change, messages)


def jumped(field: str, joint: int, by: float, messages: int) -> Injection:
    """A joint is suddenly somewhere else, or much faster."""

    def change(message: bytes) -> bytes:
        values = list(getattr(lcmt_iiwa_status.decode(message), field))
        values[joint] += by
        return changed(message, **{field: values})

    return replaced("status jumped", f"{field}[{joint}] by {by:.2f}", change, messages)


def loaded(joint: int, torque: float) -> Injection:
    """The surroundings load a joint more than is borne."""

    def change(message: bytes) -> bytes:
        values = list(lcmt_iiwa_status.decode(message).joint_torque_external)
        values[joint] += torque
        return changed(message, joint_torque_external=values)

    return replaced("external torque", f"{torque:.0f} Nm on joint {joint}", change, 1)


def clock_jump(seconds: float) -> Injection:
    """The robot's clock is set, and stays so."""

    def relay(message: bytes) -> list[bytes]:
        if not message:
            return [message]
        return [changed(message, utime=lcmt_iiwa_status.decode(message).utime + round(seconds * 1e6))]

    stops = True if abs(seconds) >= STOPS else None
    # That the clock is set back again is another jump.
    return Injection("clock jump", f"{seconds} s", _at("on_status", relay), _mended, 0.3, stops)


def controller_held_up(seconds: float) -> Injection:
    """The program that commands doesn't run for a while."""

    def begin(bus: Bus) -> None:
        bus.has_controller = False

    def end(bus: Bus) -> None:
        bus.has_controller = True

    return Injection(
        "controller held up", f"{seconds} s", begin, end, seconds, _must_stop(seconds), Fault.DEADLINE_MISSED
    )


def controller_killed(seconds: float) -> Injection:
    """It is killed, and another one started."""

    def begin(bus: Bus) -> None:
        bus.has_controller = False

    return Injection("controller killed", f"back after {seconds} s", begin, Bus.start_controller, seconds, True)


def robot_killed(seconds: float) -> Injection:
    """The robot is gone, and comes back with a clock that begins at zero."""

    def begin(bus: Bus) -> None:
        bus.has_robot = False

    return Injection("robot killed", f"back after {seconds} s", begin, Bus.start_robot, seconds, True)


def deputy_killed(seconds: float) -> Injection:
    """Nobody stands by any more."""

    def begin(bus: Bus) -> None:
        bus.has_safety_monitor = False

    def end(bus: Bus) -> None:
        bus.has_safety_monitor = True

    return Injection("deputy killed", f"back after {seconds} s", begin, end, seconds, True)


def all_kinds(rng: np.random.Generator) -> Iterator[Injection]:
    """One of each kind, drawn; as many rounds as one wants."""

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
    yield loaded(int(rng.integers(7)), float(rng.uniform(50.0, 200.0)))
    yield clock_jump(float(rng.choice([-1, 1])) * float(np.exp(rng.uniform(np.log(0.01), np.log(1e5)))))
    yield controller_held_up(duration(2.0))
    yield controller_killed(duration(1.0) + STOPS)
    yield robot_killed(duration(1.0) + STOPS)
    yield deputy_killed(duration(1.0) + 2.0 * STOPS)
