"""Endurance test of an arm that moves and is stopped, faster than real time: memory and missed stops.

    python tests/harness/injections/hours.py --seconds 480     # wall clock time

The arm moves for 20 s of simulated time, then a fault stops it, and it resumes. The exit code is 1 if a stop was
missed, or if the process has grown by more than 1 % between the first quarter and the end.
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

MOTION_TIME = 20.0  # between two faults [s]
MAX_GROWTH = 0.01  # of the process
PAGE = 4096  # [B]


def resident() -> float:
    """Return the memory of this process [MiB]."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 2**20


def stops(rng: np.random.Generator) -> Iterator[faults.Injection]:
    """Yield faults that must stop an arm, without end."""
    while True:
        yield faults.lost("on_status", 0.2)
        yield faults.not_finite("joint_position_measured", [int(rng.integers(7))], np.nan, 3)
        yield faults.external_load(int(rng.integers(7)), 150.0)
        yield faults.lost("on_command", 0.2)
        yield faults.controller_held_up(0.2)
        yield faults.controller_killed(0.1)
        yield faults.garbage(rng, 3)


def main() -> int:
    """Run the test; return 1 if a check failed, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=480.0)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng, bus = np.random.default_rng(arguments.seed), Bus()
    started, last_report, wrong, number = time.monotonic(), 0.0, 0, 0
    grown: list[tuple[float, float]] = []
    for injection in stops(rng):
        bus.run_in(MOTION_TIME)
        observation = injection.inject(bus)
        number, wrong = number + 1, wrong + bool(observation.wrong)
        for problem in observation.wrong:
            print(f"WRONG  {injection.kind}, {injection.description}: {problem}", flush=True)
        wall = time.monotonic() - started
        grown.append((wall, resident()))
        if wall - last_report > 30.0 or wall > arguments.seconds:
            last_report, hours = wall, bus.step * PERIOD / 3600.0
            print(f"{wall:.0f} s: {hours:.2f} h, {number} stops, {wrong} wrong, {resident():.1f} MiB", flush=True)
        if wall > arguments.seconds:
            break
    early = next(size for wall, size in grown if wall > 0.25 * arguments.seconds)
    growth = grown[-1][1] / early - 1.0
    print(f"grown by {growth:.2%} since a quarter of the time")
    return 1 if wrong or growth > MAX_GROWTH else 0


if __name__ == "__main__":
    sys.exit(main())
