"""Campaign of faults at many instants of a simulated motion: every kind of fault, and sampled pairs of faults.

    python tests/harness/injections/campaign.py --instants 25 --pairs 200

Robot, safety monitor and station are stepped in turn in one process, so the same seed gives the same result. At each
instant the process is forked for every fault. `processes.py` kills and pauses real processes.

Every detectable fault must be detected within its bound. From 100 ms after the fault, all joints must be slower than
0.15 rad/s. No joint may exceed 1.25 times the speed at the fault, or 1.25 times the largest speed of the undisturbed
motion within the bound if that is higher; a kind of fault that no check detects has a larger bound, or none. Some
faults are present when the programs start, or begin while the commanding program is paused. The exit code is 1 if a
requirement is not met, and `--out FILE` writes the table as CSV.

A fault that only changes positions or velocities begins with the first error of at least `SENSITIVITY`: the frozen
velocity of a joint at rest is correct until the joint moves. Of two injected faults one can mask the other, so the
longer bound applies to a pair.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import multiprocessing
import struct
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from drake import lcmt_iiwa_status

sys.path.insert(0, str(Path(__file__).parents[1]))
from guiderail.models.common.errors import InputError
from guiderail_hardware.systems.torque_safety_limiter import ArmState
from injections.bus import FREQUENCY, PERIOD, Bus, HoldingDriver
from injections.kinds import BUS_KINDS, KINDS, Kind, Q, V

CAMPAIGN = (*KINDS, *BUS_KINDS)
SLOW, SLOW_AFTER = 0.15, 0.1  # required joint speed [rad/s], from this time after every fault on [s]
DURATION = 0.3  # duration of a fault [s]
DURATIONS = {"start": 1.0, "pause": 2.5}  # duration of a fault in other situations than the motion [s]
COLUMNS = (
    *("kind", "injections", "bound [ms]", "median [ms]", "worst [ms]", "not detected"),
    *("fastest joint after 100 ms [rad/s]", "largest relative speed", "failed", "faults"),
)  # of the table as CSV
PAUSE = 0.6  # duration of a pause of the commanding program [s]
MAX_STEPS = round(1.0 / PERIOD)  # a fault without an effect within this number of steps is not checked
SENSITIVITY = {Q: 1e-3, V: 0.05}  # smallest errors that must be detected [rad], [rad/s]


@dataclass
class Result:
    """Effect of a fault.

    Attributes:
        detected: Time from the fault to its detection [s]; NaN if it was not detected.
        cause: Fault reported by the station, or else by the safety monitor.
        late_speed: Largest joint speed from `SLOW_AFTER` after the fault [rad/s].
        growth: Largest joint speed after the fault, relative to the speed at the fault or of the undisturbed motion.
        failures: Failed requirements.
    """

    detected: float
    cause: str
    late_speed: float
    growth: float
    failures: list[str]


PROGRAMS = {"robot": "has_robot", "controller": "has_controller", "monitor": "has_safety_monitor"}


def largest_speed(bus: Bus) -> float:
    """Return the true speed of the fastest joint [rad/s]."""
    return float(np.abs(bus.velocities).max())


def undisturbed_speeds(bus: Bus) -> np.ndarray:
    """Return the speed of the fastest joint in each step of a period of the motion [rad/s]."""
    steps = round(1.0 / FREQUENCY / PERIOD)
    speeds = np.zeros(steps)
    bus.run_until_following(0.5)
    for _ in range(steps):
        bus.step_once()
        speeds[bus.step % steps] = largest_speed(bus)
    return speeds


def has_effect(
    message: bytes, relayed: list[bytes], where: str, sensitivity: Mapping[str, float] = SENSITIVITY
) -> bool:
    """Return True if a message is changed by at least the sensitivity, dropped or duplicated."""
    if where == "command" or len(relayed) != 1:
        return relayed != [message]
    try:
        before, after = lcmt_iiwa_status.decode(message), lcmt_iiwa_status.decode(relayed[0])
    except (ValueError, struct.error):
        return True
    for field in lcmt_iiwa_status.__slots__:
        first, second = getattr(before, field), getattr(after, field)
        if field not in sensitivity or len(first) != len(second):
            if first != second:
                return True
        elif not (np.abs(np.subtract(first, second)) < sensitivity[field] - 1e-9).all():
            return True
    return False


def begin(bus: Bus, kind: Kind, rng: np.random.Generator, effects: list[int]) -> None:
    """Begin a fault; append the step of the first effect to `effects` if the list is empty."""
    if kind.change is not None:
        kind.change(bus)
        if kind.make is None:
            effects.append(bus.step + 1)
    if kind.make is not None:
        start, fault = bus.step + 1, kind.make(rng)
        where = {"sensor": "on_sensor", "network": "on_status", "command": "on_command"}[kind.where]

        def relay(message: bytes) -> list[bytes]:
            relayed = fault(message, (bus.step - start) * PERIOD) if message else [message]
            if not effects and kind.situation == "motion" and has_effect(message, relayed, kind.where):
                effects.append(bus.step)
            return relayed

        setattr(bus, where, relay)
        if kind.delays_heartbeats and kind.where == "network":
            late = kind.make(rng)
            bus.on_heartbeat = lambda message: late(message, (bus.step - start) * PERIOD)
    if kind.situation == "pause":
        bus.has_controller = False
        effects.append(bus.step + 1)
    if kind.action[1]:
        setattr(bus, PROGRAMS[kind.action[1]], False)
        effects.append(bus.step)


def advance(bus: Bus, situation: str, effects: list[int]) -> None:
    """Advance by a period; after a pause, the station tries to resume in each period."""
    if situation == "start" and not effects and bus.arm_state == ArmState.RAMPING:
        effects.append(bus.step + 1)
    if situation == "pause" and (bus.step - effects[0]) * PERIOD > PAUSE:
        bus.has_controller = True
        with contextlib.suppress(InputError):  # the fault persists
            bus.station.resume(bus.simulator.get_mutable_context())
    bus.step_once()


def inject(bus: Bus, kinds: tuple[Kind, ...], speeds: np.ndarray, rng: np.random.Generator) -> Result:
    """Inject one or more faults at the same time, and observe the arm."""
    first_step, effects, start = bus.step, list[int](), None
    bound = max((kind.bound for kind in kinds if kind.is_detectable), default=np.nan)
    situation, largest_growth = kinds[0].situation, max(kind.growth for kind in kinds)
    duration = DURATIONS.get(situation, max(DURATION, np.nan_to_num(bound) + SLOW_AFTER))
    for kind in kinds:
        begin(bus, kind, rng, effects)
    result, speed, elapsed = Result(np.nan, "", 0.0, 0.0, []), largest_speed(bus), 0.0
    while elapsed < duration - 1e-9 and bus.step - first_step < max(MAX_STEPS, duration / PERIOD):
        before = largest_speed(bus)
        advance(bus, situation, effects)
        if start is None and effects:
            start = effects[0] - 1
            reach = round((bound if np.isfinite(bound) else duration) / PERIOD) + 4
            speed = max(before, speeds[(start + np.arange(1 + reach)) % len(speeds)].max())
        elapsed = 0.0 if start is None else (bus.step - start) * PERIOD
        if start is not None and np.isnan(result.detected) and bus.is_detected:
            result.detected = elapsed
            result.cause = bus.fault.name if bus.has_controller and bus.fault else f"monitor: {bus.monitor.fault.name}"
        if bus.has_robot and start is not None:
            result.growth = max(result.growth, largest_speed(bus) / speed)
            # A fault with a longer bound than `SLOW_AFTER` has no effect until its detection.
            if elapsed - (result.detected if bound > SLOW_AFTER else 0.0) > SLOW_AFTER - 1e-9:
                result.late_speed = max(result.late_speed, largest_speed(bus))
    if situation == "start" and start is None:
        result.detected, result.cause = 0.0, bus.fault.name  # detected before the motion
    elif start is not None:
        if any(kind.is_detectable for kind in kinds):
            if not result.detected <= bound + 1e-9:
                result.failures.append(f"detected after {1000.0 * result.detected:.0f} ms")
            if result.late_speed >= SLOW:
                result.failures.append(f"{result.late_speed:.2f} rad/s after {SLOW_AFTER} s")
        if result.growth > largest_growth:
            result.failures.append(f"{result.growth:.2f} times as fast")
    return result


def run_in_child(bus: Bus, work: Callable[[], Result]) -> Result:
    """Return the result of `work` in a forked process, so that this process continues without the fault."""
    bus.deliver()  # both processes share the pipes of the buses in memory, which must be empty
    context = multiprocessing.get_context("fork")
    reading, writing = context.Pipe(duplex=False)

    def send() -> None:
        writing.send(work())
        bus.deliver()

    child = context.Process(target=send)
    child.start()
    writing.close()
    try:
        result: Result = reading.recv()
    except EOFError as error:
        raise SystemExit("a forked process ended without a result") from error
    child.join()
    return result


def random_pairs(kinds: list[Kind], number: int, rng: np.random.Generator) -> Iterator[tuple[Kind, Kind]]:
    """Yield random pairs of faults in different places: sensor, network, command or program."""
    while number and len({kind.where for kind in kinds}) > 1:
        first, second = (kinds[i] for i in rng.choice(len(kinds), 2, replace=False))
        if first.where != second.where:
            number -= 1
            yield first, second


def print_table(results: dict[str, list[Result]], kinds: Sequence[Kind] = KINDS, out: Path | None = None) -> int:
    """Print a row for each of the kinds, and write it to the CSV file `out`; return the number of failed injections."""
    table, bounds = [], {kind.name: kind.bound for kind in kinds}
    print(
        f"{'kind':<32}{'bound':>6}{'median':>7}{'worst':>6} [ms]  {'missed':>6}{'speed':>7}{'growth':>7}{'failed':>7}"
    )
    for name, rows in results.items():
        times = 1000.0 * np.array([row.detected for row in rows])
        detected = times[np.isfinite(times)]
        median, worst = (np.median(detected), detected.max()) if len(detected) else (np.nan, np.nan)
        causes = ", ".join(sorted({row.cause for row in rows if row.cause}))
        late, growth = max(row.late_speed for row in rows), max(row.growth for row in rows)
        failed = sum(bool(row.failures) for row in rows)
        missed = len(times) - len(detected)
        print(
            f"{name:<32}{1000.0 * bounds.get(name, np.nan):>6.0f}{median:>7.0f}{worst:>6.0f}       {missed:>6}"
            f"{late:>7.2f}{growth:>7.2f}{failed:>7}  {causes}"
        )
        times = [f"{time:.0f}" for time in (1000.0 * bounds.get(name, np.nan), median, worst)]
        table.append([name, len(rows), *times, missed, f"{late:.2f}", f"{growth:.2f}", failed, causes])
    if out is not None:
        with out.open("w", newline="") as file:
            csv.writer(file).writerows([COLUMNS, *table])
    return sum(bool(row.failures) for rows in results.values() for row in rows)


def main() -> int:
    """Run the campaign; return 1 if a requirement was not met, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--instants", type=int, default=25, help="instants for each kind of fault")
    parser.add_argument("--pairs", type=int, default=200, help="pairs of faults that begin together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="CSV file of the table")
    parser.add_argument("--kinds", nargs="*", help="names of kinds (default: all)")
    arguments = parser.parse_args()
    started, bus, holding_bus, new_bus = time.monotonic(), Bus(), Bus(HoldingDriver), Bus()
    speeds = undisturbed_speeds(bus)
    undisturbed_speeds(holding_bus)
    kinds = [kind for kind in CAMPAIGN if not arguments.kinds or kind.name in arguments.kinds]
    pooled = [kind for kind in kinds if kind in KINDS]
    results: dict[str, list[Result]] = {kind.name: [] for kind in kinds}
    for instant in range(arguments.instants):
        rng = np.random.default_rng([arguments.seed, instant])
        seconds = float(rng.uniform(0.02, 0.3))
        for each in (bus, holding_bus):
            each.run_until_following(seconds)
        injections = [(CAMPAIGN.index(kind), (kind,)) for kind in kinds]
        injections += [
            (len(CAMPAIGN), pair) for pair in random_pairs(pooled, arguments.pairs // arguments.instants, rng)
        ]
        for index, (number, chosen) in enumerate(injections):
            rng = np.random.default_rng([arguments.seed, instant, number, index])
            situation = chosen[0].situation
            if situation == "start" and instant > 0:
                continue  # the start does not depend on the instant
            used = holding_bus if chosen[0].name.startswith("hold()") else new_bus if situation == "start" else bus
            result = run_in_child(used, partial(inject, used, chosen, speeds, rng))
            results.setdefault(chosen[0].name if len(chosen) == 1 else "pairs", []).append(result)
            for failure in result.failures:
                name = " and ".join(kind.name for kind in chosen)
                print(f"FAIL  {name}, instant {instant}: {failure} ({result.cause})", flush=True)
    failed = print_table(results, CAMPAIGN, arguments.out)
    total = sum(len(rows) for rows in results.values())
    print(f"{total} injections, {failed} with a failed requirement, in {time.monotonic() - started:.0f} s")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
