"""Fuzzing of all kinds of files and arguments with random and mutated inputs.

    python tests/harness/fuzz/fuzz.py                       # 25,000 inputs, about ten minutes
    python tests/harness/fuzz/fuzz.py --inputs 200 runs     # 200 inputs of each test in test_runs.py
    python tests/harness/fuzz/fuzz.py --seed 1 --add FILE   # other inputs, added to the counts in FILE

An input must be accepted with the values that an independent reader finds, or refused with one sentence, within 2 s of
CPU time and 200 MB. Every other outcome counts as a traceback, a hang, too large or a wrong number, and makes the exit
code 1. The smallest such input is shown. The same seed generates the same inputs.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path

FOLDER = Path(__file__).parent
sys.path.insert(0, str(FOLDER.parent))
OUTCOMES = ("inputs", "accepted", "refused", "tracebacks", "hangs", "too large", "wrong numbers")
FAILED = OUTCOMES[3:]


class WrongNumbers:
    """Pytest plugin that counts failures without an exception of the code under test as wrong numbers."""

    def pytest_runtest_logreport(self, report):
        from fuzz.tally import COUNTS

        if report.when == "call":
            failures = sum(count for (_, outcome), count in COUNTS.items() if outcome in FAILED)
            if report.failed and failures == getattr(self, "failures", 0):
                COUNTS[report.nodeid.rpartition("::")[2], "wrong numbers"] += 1
                failures += 1
            self.failures = failures


def count(file: Path, inputs: int, seed: int, out: Path) -> None:
    """Try the inputs of one test file, and write the counts as JSON."""
    import pytest
    from hypothesis import HealthCheck, settings

    from fuzz import tally

    tally.measuring = True
    tally.bound_memory()
    settings.register_profile("counted", settings.get_profile("default"), max_examples=inputs, deadline=None,
                              database=None, suppress_health_check=list(HealthCheck))  # fmt: skip
    options = ["-q", "--no-header", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=short"]
    pytest.main([*options, "--hypothesis-profile=counted", f"--hypothesis-seed={seed}", str(file)], [WrongNumbers()])
    if tally.COUNTS:
        out.write_text(json.dumps([[*key, n] for key, n in tally.COUNTS.items()]))


def main() -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    files = {file.stem.removeprefix("test_"): file for file in sorted(FOLDER.glob("test_*.py"))}
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"kinds of inputs: {', '.join(files)}; default: all")
    parser.add_argument("--inputs", type=int, default=1000, help="maximum number of inputs of each test")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--add", type=Path, metavar="FILE", help="JSON file of counts, to which the new counts are added"
    )
    args = parser.parse_args()
    if unknown := set(args.kinds) - set(files):
        parser.error(f"there is no {', '.join(sorted(unknown))}: choose among {', '.join(files)}")
    os.chdir(FOLDER.parents[2])
    counts: Counter[tuple[str, str]] = Counter()
    if args.add and args.add.exists():
        counts.update({(target, outcome): n for target, outcome, n in json.loads(args.add.read_text())})
    for kind in args.kinds or files:
        with tempfile.NamedTemporaryFile() as file:
            child = os.fork()
            if child == 0:
                try:
                    count(files[kind], args.inputs, args.seed, Path(file.name))
                finally:
                    sys.stdout.flush()
                    os._exit(0)
            os.waitpid(child, 0)
            written = Path(file.name).read_text()
        if written:
            counts.update({(target, outcome): n for target, outcome, n in json.loads(written)})
        else:
            counts[kind, "hangs"] += 1  # the process hung or crashed
    if args.add:
        args.add.write_text(json.dumps([[*key, n] for key, n in counts.items()], indent=1))
    targets = list(dict.fromkeys(target for target, _ in counts))
    width = max(map(len, targets))
    print("\n" + "  ".join([" " * width, *(f"{outcome:>13}" for outcome in OUTCOMES)]))
    for target in targets:
        print("  ".join([f"{target:<{width}}", *(f"{counts[target, outcome]:13d}" for outcome in OUTCOMES)]))
    total = {outcome: sum(counts[target, outcome] for target in targets) for outcome in OUTCOMES}
    print("  ".join([f"{'total':<{width}}", *(f"{n:13d}" for n in total.values())]))
    return int(any(total[outcome] for outcome in FAILED))


if __name__ == "__main__":
    sys.exit(main())
