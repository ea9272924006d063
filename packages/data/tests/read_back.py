"""Read exported demonstrations with the libraries of the formats: LeRobot's, and MCAP's for ROS 2.

Run `python packages/data/tests/read_back.py --environment FOLDER [--interpreter python3.12]`. If FOLDER has no virtual
environment, the program creates one with both libraries (5 GB), which cannot be installed together with this package.
The exit code is 1 if a number differs by more than the rounding of its format.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

LIBRARIES = ("lerobot[dataset]", "mcap", "mcap-ros2-support")
ROUNDING = {"lerobot": 2.0**-24, "mcap": 0.0}  # largest relative rounding error of the format
NAMES = ("x [m]", "y [m]", "z [m]", "Rz [rad]", "Ry [rad]", "Rx [rad]")


def read_lerobot(folder: Path) -> list[list[list[float]]]:
    """Return the rows of each episode."""
    from lerobot.datasets import LeRobotDataset

    dataset = LeRobotDataset("guiderail/exported", root=folder)
    rows: dict[int, list[list[float]]] = {}
    for number in range(dataset.num_frames):
        frame = dataset[number]
        rows.setdefault(int(frame["episode_index"]), []).append(frame["action"].tolist())
    return [rows[episode] for episode in sorted(rows)]


def read_mcap(folder: Path) -> list[list[list[float]]]:
    """Return the rows of each bag."""
    from mcap_ros2.reader import read_ros2_messages

    return [
        [list(message.ros_msg.data) for message in read_ros2_messages(str(file))]
        for file in sorted(folder.rglob("*.mcap"))
    ]


READERS = {"lerobot": read_lerobot, "mcap": read_mcap}


def environment(folder: Path, interpreter: str) -> Path:
    """Return the interpreter of the virtual environment with the libraries; create the environment if missing."""
    python = folder / "bin" / "python"
    if not python.exists():
        subprocess.run([interpreter, "-m", "venv", folder], check=True)
        subprocess.run([python, "-m", "pip", "install", "-q", *LIBRARIES], check=True)
    return python


def differences(python: Path) -> dict[str, float]:
    """Return the largest relative difference between written and read numbers of each format."""
    from guiderail.models.primitives import Demonstrations
    from guiderail_data.convert import export_demonstrations

    rng = np.random.default_rng(0)
    times = [0.02 * np.arange(40 + number) for number in range(3)]
    outputs = [0.2 * np.cumsum(rng.standard_normal((len(t), 6)), axis=0) / len(t) for t in times]
    result = {}
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "exported.npz")
        Demonstrations(times, outputs, NAMES).save(file)
        for kind in READERS:
            export_demonstrations(file, Path(folder, kind), kind)
            offline = {**os.environ, "HF_HUB_OFFLINE": "1", "HF_HOME": folder}
            command = [python, __file__, "--read", kind, "--folder", Path(folder, kind)]
            printed = subprocess.run(command, env=offline, stdout=subprocess.PIPE, text=True, check=True).stdout
            loaded = json.loads(printed.splitlines()[-1])
            if [len(rows) for rows in loaded] != [len(rows) for rows in outputs]:
                raise SystemExit(f"{kind}: the number or the lengths of the demonstrations changed")
            result[kind] = max(
                float(np.max(np.abs(np.array(read) - written) / np.abs(written)))
                for read, written in zip(loaded, outputs, strict=True)
            )
    return result


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--environment", type=Path, help="folder of the virtual environment with the libraries")
    parser.add_argument("--interpreter", default=sys.executable, help="interpreter of a new virtual environment")
    parser.add_argument("--read", choices=READERS, help="print the demonstrations in --folder as JSON (internal)")
    parser.add_argument("--folder", type=Path)
    arguments = parser.parse_args()
    if arguments.read:
        print(json.dumps(READERS[arguments.read](arguments.folder)))
        return 0
    if arguments.environment is None:
        parser.error("name the folder of a virtual environment with --environment")
    result = differences(environment(arguments.environment, arguments.interpreter))
    for kind, difference in result.items():
        print(f"{kind}: largest relative difference {difference:.1e}, largest rounding error {ROUNDING[kind]:.1e}")
    return int(any(difference > ROUNDING[kind] for kind, difference in result.items()))


if __name__ == "__main__":
    sys.exit(main())
