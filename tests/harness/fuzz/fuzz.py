"""Tries every kind of file and argument with inputs made and changed at random, and counts what came of them.

    python tests/fuzz/fuzz.py                       # 25,000 inputs, some ten minutes
    python tests/fuzz/fuzz.py --inputs 200 runs     # fewer, and of tests/fuzz/test_runs.py alone
    python tests/fuzz/fuzz.py --seed 1 --add FILE   # others, added to what FILE counts from earlier calls

An input is accepted, and then means what it says to an independent reader, or refused in one sentence; within 2 s of
CPU and 200 MB. Everything else is counted as a traceback, a hang, too large or a wrong number, shown with the smallest
input that does it, and ends the command with 1. The same seed tries the same inputs.
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
    """A test that fails, though nothing was raised, found an input that means something else than it says."""

    def pytest_runtest_logreport(self, report):
        from fuzz.tally import TRIED

        if report.when == "call":
            told = sum(count for (_, outcome), count in TRIED.items() if outcome in FAILED)
            if report.failed and told == getattr(self, "told", 0):
                TRIED[report.nodeid.rpartition("::")[2], "wrong numbers"] += 1
                told += 1
            self.told = told


def count(file: Path, inputs: int, seed: int, into: Path) -> None:
    """Tries the inputs of one file in a process of its own, and writes what came of them."""
    import pytest
    from hypothesis import settings

    from fuzz import tally

    tally.measuring = True
    tally.bound_memory()
    settings.register_profile("counted", settings.get_profile("default"), max_examples=inputs, deadline=None,
                              database=None, suppress_health_check=list(_health()))  # fmt: skip
    how = ["-q", "--no-header", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=short"]
    pytest.main([*how, "--hypothesis-profile=counted", f"--hypothesis-seed={seed}", str(file)], [WrongNumbers()])
    if tally.TRIED:
        into.write_text(json.dumps([[*key, n] for key, n in tally.TRIED.items()]))


def _health():
    from hypothesis import HealthCheck

    return HealthCheck


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    files = {file.stem.removeprefix("test_"): file for file in sorted(FOLDER.glob("test_*.py"))}
    parser.add_argument("kinds", nargs="*", metavar="KIND", help=f"of {', '.join(files)}; all unless given")
    parser.add_argument("--inputs", type=int, default=1000, help="the most that each test tries")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--add", type=Path, metavar="FILE", help="a JSON file with counts, which grow")
    given = parser.parse_args()
    if unknown := set(given.kinds) - set(files):
        parser.error(f"there is no {', '.join(sorted(unknown))}: choose of {', '.join(files)}")
    os.chdir(FOLDER.parents[2])
    found: Counter[tuple[str, str]] = Counter()
    if given.add and given.add.exists():
        found.update({(target, outcome): n for target, outcome, n in json.loads(given.add.read_text())})
    for kind in given.kinds or files:
        with tempfile.NamedTemporaryFile() as into:
            child = os.fork()
            if child == 0:
                try:
                    count(files[kind], given.inputs, given.seed, Path(into.name))
                finally:
                    sys.stdout.flush()
                    os._exit(0)
            os.waitpid(child, 0)
            written = Path(into.name).read_text()
        if written:
            found.update({(target, outcome): n for target, outcome, n in json.loads(written)})
        else:
            found[kind, "hangs"] += 1  # the process ended early: it was stuck, or crashed
    if given.add:
        given.add.write_text(json.dumps([[*key, n] for key, n in found.items()], indent=1))
    targets = list(dict.fromkeys(target for target, _ in found))
    width = max(map(len, targets))
    print("\n" + "  ".join([" " * width, *(f"{outcome:>13}" for outcome in OUTCOMES)]))
    for target in targets:
        print("  ".join([f"{target:<{width}}", *(f"{found[target, outcome]:13d}" for outcome in OUTCOMES)]))
    together = {outcome: sum(found[target, outcome] for target in targets) for outcome in OUTCOMES}
    print("  ".join([f"{'together':<{width}}", *(f"{n:13d}" for n in together.values())]))
    return int(any(together[outcome] for outcome in FAILED))


if __name__ == "__main__":
    sys.exit(main())
