"""Compare each law in C++ with Python for 100,000 steps of random inputs, optimized and with sanitizers (20 minutes).

python packages/cpp/scripts/long_replay.py [--steps 100000] [LAW …]
"""

import argparse
import subprocess
import sys
import tempfile
from importlib.resources import files
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from random_laws import LAWS, TOLERANCE, TOLERANCES
from test_laws import FLAGS


def main() -> int:
    """Compare the laws that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("laws", nargs="*", default=list(LAWS))
    parser.add_argument("--steps", type=int, default=100_000)
    arguments = parser.parse_args()
    source, failed = files("guiderail_cpp"), False
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for flags_name, flags in FLAGS.items():
            command = ["g++", "-std=c++17", "-ffp-contract=off", *flags, "-I", source / "include"]
            subprocess.run([*command, source / "files/test/replay.cpp", "-o", folder / flags_name], check=True)
        for law in arguments.laws:
            for path, content in zip(("data", "recording"), LAWS[law](arguments.steps), strict=True):
                (folder / path).write_bytes(content)
            for flags_name in FLAGS:
                command = [folder / flags_name, folder / "data", folder / "recording"]
                command.append(str(TOLERANCES.get(law, TOLERANCE)))
                result = subprocess.run(command, capture_output=True, text=True, check=False)
                failed |= result.returncode != 0
                verdict = "equal" if result.returncode == 0 else "DIFFERENT"
                print(f"{law} ({flags_name}): {verdict}: {(result.stdout + result.stderr).strip()}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
