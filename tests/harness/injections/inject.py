"""Inject random faults of the bus and its programs while an arm moves: `make injections`.

The test suite has one fault of each kind. Both programs are stepped in turn, so the same seed gives the same
injections. A round has one fault of each kind; `--first` starts with a later round.
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
    parser.add_argument("--injections", type=int, default=500, help="how many at least")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="round to begin with")
    arguments = parser.parse_args()
    bus = Bus()
    result: dict[str, list[tuple[Injection, Observation]]] = defaultdict(list)
    started, total, number = time.monotonic(), 0, arguments.first
    while total < arguments.injections:
        num_wrong = 0
        for injection in all_kinds(np.random.default_rng([arguments.seed, number])):
            observation = injection.inject(bus)
            result[injection.kind].append((injection, observation))
            total, num_wrong = total + 1, num_wrong + bool(observation.wrong)
            for wrong in observation.wrong:
                print(f"WRONG  {injection.kind}, {injection.description}: {wrong}", flush=True)
        print(f"round {number}: {num_wrong} wrong; {total} injections until now", flush=True)
        number += 1
    wrong = table(result)
    print(f"in {time.monotonic() - started:.0f} s")
    return 1 if wrong else 0


def table(found: dict[str, list[tuple[Injection, Observation]]]) -> int:
    """Print a row for each kind; return the number of injections with a failed check."""
    print(f"{'kind':<22}{'injected':>9}{'stopped':>9}{'borne':>7}{'wrong':>7}   detected after [ms]   faults")
    for kind, rows in found.items():
        times = [1000.0 * observation.detected for _, observation in rows if observation.detected is not None]
        faults = sorted({observation.fault for _, observation in rows if observation.fault})
        between = f"{min(times):.0f} to {max(times):.0f}" if times else ""
        wrong = sum(bool(observation.wrong) for _, observation in rows)
        counts = f"{len(rows):>9}{len(times):>9}{len(rows) - len(times):>7}{wrong:>7}"
        print(f"{kind:<22}{counts}   {between:<20}  {', '.join(faults)}")
    everything = [observation for rows in found.values() for _, observation in rows]
    wrong = sum(bool(observation.wrong) for observation in everything)
    print(f"{len(everything)} injections, {wrong} of them with something wrong;", end=" ")
    slowest = max(observation.after for observation in everything)
    print(f"the fastest joint of any arm 50 ms after a detection: {slowest:.3f} rad/s", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
