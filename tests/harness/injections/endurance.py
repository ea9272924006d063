"""Endurance test of a simulated arm with repeated stops, faster than real time: missed stops and growth of memory.

    python tests/harness/injections/endurance.py --seconds 480     # seconds of wall clock time

The arm moves for 20 s of simulated time, a fault stops the arm, and the arm resumes. The exit code is 1 if a stop was
missed, or if the memory of the process has grown by more than 1 % between the first quarter of the time and the end.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from injections import faults
from injections.bus import PERIOD, Bus

MOTION_TIME = 20.0  # simulated time between two faults [s]
MAX_GROWTH = 0.01  # largest relative growth of the memory of the process
PAGE = 4096  # size of a page of memory [B]


def resident_memory() -> float:
    """Return the resident memory of this process [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 2**20


def stopping_faults(rng: np.random.Generator) -> Iterator[faults.Injection]:
    """Yield an endless sequence of faults that must stop the arm."""
    while True:
        yield faults.message_loss("on_status", 0.2)
        yield faults.non_finite_status("joint_position_measured", [int(rng.integers(7))], np.nan, 3)
        yield faults.external_load(int(rng.integers(7)), 150.0)
        yield faults.message_loss("on_command", 0.2)
        yield faults.controller_pause(0.2)
        yield faults.controller_kill(0.1)
        yield faults.malformed_status(rng, 3)


def main() -> int:
    """Run the test; return 1 if a check failed, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=480.0, help="duration by the wall clock [s]")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng, bus = np.random.default_rng(arguments.seed), Bus()
    started, last_report, num_failed, num_stops = time.monotonic(), 0.0, 0, 0
    sizes: list[tuple[float, float]] = []  # wall clock time [s], memory [MiB]
    for injection in stopping_faults(rng):
        bus.run_until_following(MOTION_TIME)
        observation = injection.inject(bus)
        num_stops, num_failed = num_stops + 1, num_failed + bool(observation.failures)
        for failure in observation.failures:
            print(f"FAIL  {injection.kind}, {injection.description}: {failure}", flush=True)
        wall = time.monotonic() - started
        sizes.append((wall, resident_memory()))
        if wall - last_report > 30.0 or wall > arguments.seconds:
            last_report, hours = wall, bus.step * PERIOD / 3600.0
            counts = f"{num_stops} stops, {num_failed} failed"
            print(f"{wall:.0f} s: {hours:.2f} simulated h, {counts}, {resident_memory():.1f} MiB", flush=True)
        if wall > arguments.seconds:
            break
    early = next(size for wall, size in sizes if wall > 0.25 * arguments.seconds)
    growth = sizes[-1][1] / early - 1.0
    print(f"memory has grown by {growth:.2%} since the first quarter of the time")
    return 1 if num_failed or growth > MAX_GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
