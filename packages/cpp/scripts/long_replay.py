"""Compare each law in C++ with Python for 100,000 steps of random inputs, optimized and with sanitizers (30 minutes).

    python packages/cpp/scripts/long_replay.py [--steps 100000] [LAW …]

A row of a table is printed for each law. Times are processor times of the thread, the shorter of several runs. The exit
status is 0 if every command is within its tolerance, no step allocates memory, and constraints or limits are active in
a third of the steps.
"""

import argparse
import re
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from random_laws import LAWS, TOLERANCE, TOLERANCES

FLAGS = {"optimized": ["-O2"], "sanitized": ["-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]}
RUNS = 3  # runs of the optimized program, of which the shortest times count
ACTIVE = 33.0  # required share of the steps with an active constraint [%]
FREE = ("policy", "whole skill of the connector")  # a network has no constraints, and this policy stays inside of them
NUMBERS = re.compile(
    r"(\d+) steps, (\d+) % .*, largest difference (\S+), (\d+) allocations, p50 (\S+) us, p99.9 (\S+) us"
)


def replay(program: Path, folder: Path, tolerance: float) -> list[float]:
    """Return steps, share of active constraints, difference, allocations, median and 99.9 % of the time [µs].

    Raises:
        RuntimeError: If the program ends without a result, as with an error that a sanitizer finds.
    """
    command = [program, folder / "data", folder / "recording", str(tolerance)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if (found := NUMBERS.match(result.stdout)) is None:
        raise RuntimeError(result.stdout + result.stderr)
    return [float(number) for number in found.groups()]


def main() -> int:
    """Compare the laws that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("laws", nargs="*", default=list(LAWS))
    parser.add_argument("--steps", type=int, default=100_000)
    arguments = parser.parse_args()
    source, failed = files("guiderail_cpp"), False
    print("| law | steps | active | difference: -O2; sanitizers | allocations | median; 99.9 % [µs] | |")
    print("|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for flags_name, flags in FLAGS.items():
            command = ["g++", "-std=c++17", "-ffp-contract=off", *flags, "-I", source / "include"]
            subprocess.run([*command, source / "files/test/replay.cpp", "-o", folder / flags_name], check=True)
        for law in arguments.laws:
            tolerance = TOLERANCES.get(law, TOLERANCE)
            for path, content in zip(("data", "recording"), LAWS[law](arguments.steps), strict=True):
                (folder / path).write_bytes(content)
            rows = [replay(folder / "optimized", folder, tolerance) for _ in range(RUNS)]
            rows.append(replay(folder / "sanitized", folder, tolerance))
            steps, active, difference, allocations, *_ = rows[0]
            median, longest = (min(row[column] for row in rows[:RUNS]) for column in (4, 5))
            is_met = max(difference, rows[-1][2]) <= tolerance and max(allocations, rows[-1][3]) == 0
            is_met = is_met and (active >= ACTIVE or law in FREE)
            failed |= not is_met
            print(
                f"| {law} | {steps:,.0f} | {active:.0f} % | {difference:.0e}; {rows[-1][2]:.0e} | {allocations:.0f} | "
                f"{median:.1f}; {longest:.0f} | {'met' if is_met else 'FAILED'} |",
                flush=True,
            )
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
