"""Lets everything that can happen on a bus happen to a moving arm, and checks the robot's side: `make injections`.

No part of the test suite, which has one of each kind. In turn and not by the wall's clock, so that the same seed gives
the same injections; a round has one of each kind, and `--first` goes on with a later round than the first.
"""

import argparse
import sys
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2]))
from injections.bus import Bus, Seen
from injections.faults import Injection, all_kinds


def main() -> int:
    """Prints a row for each kind; 1 if anything was wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--injections", type=int, default=500, help="how many at least")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="round to begin with")
    arguments = parser.parse_args()
    bus = Bus()
    found: dict[str, list[tuple[Injection, Seen]]] = defaultdict(list)
    started, total, number = time.monotonic(), 0, arguments.first
    while total < arguments.injections:
        wrongs = 0
        for injection in all_kinds(np.random.default_rng([arguments.seed, number])):
            seen = injection.inject(bus)
            found[injection.kind].append((injection, seen))
            total, wrongs = total + 1, wrongs + bool(seen.wrong)
            for wrong in seen.wrong:
                print(f"WRONG  {injection.kind}, {injection.words}: {wrong}", flush=True)
        print(f"round {number}: {wrongs} wrong; {total} injections until now", flush=True)
        number += 1
    wrong = table(found)
    print(f"in {time.monotonic() - started:.0f} s")
    return 1 if wrong else 0


def table(found: dict[str, list[tuple[Injection, Seen]]]) -> int:
    """Prints a row for each kind; how many had something wrong."""
    print(f"{'kind':<22}{'injected':>9}{'stopped':>9}{'borne':>7}{'wrong':>7}   detected after [ms]   faults")
    for kind, rows in found.items():
        times = [1000.0 * seen.detected for _, seen in rows if seen.detected is not None]
        faults = sorted({seen.fault for _, seen in rows if seen.fault})
        between = f"{min(times):.0f} to {max(times):.0f}" if times else ""
        wrong = sum(bool(seen.wrong) for _, seen in rows)
        counts = f"{len(rows):>9}{len(times):>9}{len(rows) - len(times):>7}{wrong:>7}"
        print(f"{kind:<22}{counts}   {between:<20}  {', '.join(faults)}")
    everything = [seen for rows in found.values() for _, seen in rows]
    wrong = sum(bool(seen.wrong) for seen in everything)
    print(f"{len(everything)} injections, {wrong} of them with something wrong;", end=" ")
    slowest = max(seen.after for seen in everything)
    print(f"the fastest joint of any arm 50 ms after a detection: {slowest:.3f} rad/s", flush=True)
    return wrong


if __name__ == "__main__":
    sys.exit(main())
