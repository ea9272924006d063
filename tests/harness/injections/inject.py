"""Inject random faults of the bus and its programs while an arm moves: `make injections`.

A round injects one fault of each kind; `--first` starts with a later round. Robot, safety monitor and station are
stepped in turn, so the same seed gives the same results. The test suite injects only a few faults.
"""

import argparse
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from injections.bus import Bus, Observation
from injections.faults import Injection, all_kinds


def main() -> int:
    """Run the injections; return 1 if a check failed, otherwise 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--injections", type=int, default=500, help="smallest number of injections")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="number of the first round")
    arguments = parser.parse_args()
    bus = Bus()
    results: dict[str, list[tuple[Injection, Observation]]] = defaultdict(list)
    started, total, number = time.monotonic(), 0, arguments.first
    while total < arguments.injections:
        num_failed = 0
        for injection in all_kinds(np.random.default_rng([arguments.seed, number])):
            observation = injection.inject(bus)
            results[injection.kind].append((injection, observation))
            total, num_failed = total + 1, num_failed + bool(observation.failures)
            for failure in observation.failures:
                print(f"FAIL  {injection.kind}, {injection.description}: {failure}", flush=True)
        print(f"round {number}: {num_failed} failed; {total} injections in total", flush=True)
        number += 1
    failed = print_table(results)
    print(f"in {time.monotonic() - started:.0f} s")
    return 1 if failed else 0


def print_table(results: dict[str, list[tuple[Injection, Observation]]]) -> int:
    """Print a row for each kind; return the number of injections with a failed check."""
    print(f"{'kind':<22}{'injected':>9}{'stopped':>9}{'tolerated':>11}{'failed':>8}   detected after [ms]   faults")
    for kind, rows in results.items():
        times = [1000.0 * observation.detected for _, observation in rows if observation.detected is not None]
        faults = sorted({observation.fault for _, observation in rows if observation.fault})
        interval = f"{min(times):.0f} to {max(times):.0f}" if times else ""
        failed = sum(bool(observation.failures) for _, observation in rows)
        counts = f"{len(rows):>9}{len(times):>9}{len(rows) - len(times):>11}{failed:>8}"
        print(f"{kind:<22}{counts}   {interval:<20}  {', '.join(faults)}")
    observations = [observation for rows in results.values() for _, observation in rows]
    failed = sum(bool(observation.failures) for observation in observations)
    speed = max(observation.after for observation in observations)
    print(f"{len(observations)} injections, {failed} failed; fastest joint 50 ms after a detection: {speed:.3f} rad/s")
    return failed


if __name__ == "__main__":
    sys.exit(main())
