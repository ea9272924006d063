"""Run a study of eight runs on two processes, and on a Ray cluster of two machines of which one is lost.

    python tests/tools.experiments.engines/ray_study.py --out FOLDER         # the narrow passage
    python tests/tools.experiments.engines/ray_study.py --out FOLDER --bead  # half a minute

On the cluster a worker is killed in the middle of a run, and then one of the two machines with all its processes. It
ends with 1 if the study is not complete, or not the same bit for bit. Ray must be installed.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import yaml

TESTS = Path(__file__).parents[3]
sys.path.insert(0, str(TESTS))
from oracles.same_runs import differences  # noqa: E402

STUDY = {
    "name": "eight",
    "task": "NarrowPassage",
    "env": {"guidance": "kgrl"},
    "learner": {"preset": "tqc_fast", "episodes": 3},
    "methods": {"kgrl": {}},
    "seeds": list(range(8)),
    "eval_set": [{"episodes": 2}],
}
SETTINGS = {"net_arch": "16", "batch_size": 16, "learning_starts": 10, "gradient_steps": 4}
BEAD = {
    **{"name": "eight", "task": "Bead", "methods": {"bead": {}}, "seeds": list(range(8))},
    **{"learner": {"settings": SETTINGS, "episodes": 40}, "eval_set": [{"episodes": 2}]},
}
REGISTER = f"import sys\nsys.path.insert(0, {str(TESTS / 'tools')!r})\nimport bead\nbead.register()\n"
PATIENCE = 600.0  # s


def write_study(folder: Path, bead: bool) -> Path:
    """Write the study's file into a folder and return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "register_bead.py").write_text(REGISTER)
    study = {**BEAD, "imports": [str(folder / "register_bead.py")]} if bead else STUDY
    (folder / "eight.yaml").write_text(yaml.safe_dump(study))
    return folder / "eight.yaml"


def command(file: Path, out: Path, *more: str) -> list[str]:
    """Return the study's command line."""
    program = "from guiderail.tools.cli.main import main; main()"
    return [sys.executable, "-c", program, "study", str(file), "--out", str(out), "--json", *more]


def running(out: Path, episodes: int) -> Iterator[tuple[str, int]]:
    """Yield running jobs with at least a number of episodes, and the process of each."""
    for log in sorted((out / "logs").glob("*.txt")):
        last = log.read_text().splitlines()[-1]
        table = out / log.stem.removeprefix("eight-") / "episodes.csv"
        if " begins on " in last and table.exists() and table.read_bytes().count(b"\n") > episodes:
            yield log.stem, int(last.rpartition(" ")[2])


def wait_for(found: Callable[[], Any], study: subprocess.Popen) -> Any:
    """Return the first result of `found` that is not None while the study runs."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        if (what := found()) is not None:
            return what
        if study.poll() is not None:
            raise RuntimeError("the study ended before anything was killed")
        time.sleep(0.02)
    raise RuntimeError("the study came nowhere")


def is_on(process: int, machine: Any) -> bool:
    """Return True if the worker was started by the machine's Ray."""
    parent = int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
    return any(one.process.pid == parent for one in machine.all_processes["raylet"])


def on_cluster(file: Path, out: Path, episodes: int) -> tuple[int, str, list[str]]:
    """Return exit code and output of the study on a cluster of two machines, and what was killed."""
    from ray.cluster_utils import Cluster

    machine = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 100 * 1024**2}
    cluster = Cluster(initialize_head=True, head_node_args=machine | {"num_cpus": 0})
    killed = []
    try:
        machines = [cluster.add_node(**machine) for _ in range(2)]
        engine = ("--engine", "ray", "--address", cluster.address)
        with subprocess.Popen(
            command(file, out, *engine), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as study:
            name, process = wait_for(lambda: next(running(out, episodes), None), study)
            os.kill(process, signal.SIGKILL)
            killed.append(f"the worker of {name}")
            others = {name}
            name, process = wait_for(lambda: next((o for o in running(out, 0) if o[0] not in others), None), study)
            cluster.remove_node(next(m for m in machines if is_on(process, m)), allow_graceful=False)
            killed.append(f"one of two machines, where {name} was running")
            words, _ = study.communicate(timeout=PATIENCE)
        return study.returncode, words, killed
    finally:
        cluster.shutdown()


def compare(folder: Path, bead: bool) -> dict[str, object]:
    """Run both studies and return their comparison."""
    file, seconds = write_study(folder, bead), time.perf_counter()
    subprocess.run(command(file, folder / "process"), check=True, capture_output=True, timeout=PATIENCE)
    seconds = time.perf_counter() - seconds
    started = time.perf_counter()
    code, words, killed = on_cluster(file, folder / "ray", 10 if bead else 1)
    return {
        "killed": killed,
        "exit_code": code,
        "begun_again": [line for line in words.splitlines() if "by worker" in line],
        "differences": differences(folder / "process", folder / "ray"),
        "files": sum(path.is_file() for path in (folder / "process").rglob("*")),
        "seconds": {"process": round(seconds, 1), "ray": round(time.perf_counter() - started, 1)},
    }


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--bead", action="store_true", help="the tests' smallest environment")
    args = parser.parse_args()
    result = compare(args.out.absolute(), args.bead)
    print(json.dumps(result, indent=2))
    sys.exit(bool(result["exit_code"] or result["differences"] or len(result["begun_again"]) < 2))


if __name__ == "__main__":
    main()
