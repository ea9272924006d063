"""Run a study of eight runs in two processes, and on a Ray cluster that loses one of its two machines.

    python packages/studies/tests/engines/ray_study.py --out FOLDER         # the narrow passage
    python packages/studies/tests/engines/ray_study.py --out FOLDER --bead  # half a minute

On the cluster, a worker is killed during a run, and then one of the two machines with all its processes. The exit code
is 1 if the study on the cluster is not complete, or differs in any bit from the study in two processes. Ray must be
installed.
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

TESTS = Path(__file__).parents[4] / "tests"
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
    "name": "eight",
    "task": "Bead",
    "learner": {"settings": SETTINGS, "episodes": 40},
    "methods": {"bead": {}},
    "seeds": list(range(8)),
    "eval_set": [{"episodes": 2}],
}
REGISTER = f"import sys\nsys.path.insert(0, {str(TESTS / 'tools')!r})\nimport bead\nbead.register()\n"
TIMEOUT = 600.0  # longest time of a study, and longest wait for a running job [s]


def write_study(folder: Path, bead: bool) -> Path:
    """Write the declaration of the study into a folder; return its path."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "register_bead.py").write_text(REGISTER)
    study = {**BEAD, "imports": [str(folder / "register_bead.py")]} if bead else STUDY
    (folder / "eight.yaml").write_text(yaml.safe_dump(study))
    return folder / "eight.yaml"


def command(file: Path, out: Path, *options: str) -> list[str]:
    """Return the command line of the study."""
    program = "from guiderail.tools.cli.main import main; main()"
    return [sys.executable, "-c", program, "study", str(file), "--out", str(out), "--json", *options]


def running_jobs(out: Path, episodes: int) -> Iterator[tuple[str, int]]:
    """Yield name and process id of each running job with at least this number of training episodes."""
    for log in sorted((out / "logs").glob("*.txt")):
        last = log.read_text().splitlines()[-1]
        table = out / log.stem.removeprefix("eight-") / "episodes.csv"
        if " begins on " in last and table.exists() and table.read_bytes().count(b"\n") > episodes:
            yield log.stem, int(last.rpartition(" ")[2])


def wait_for(find: Callable[[], Any], study: subprocess.Popen) -> Any:
    """Return the first result of `find` that is not None while the study runs."""
    end = time.monotonic() + TIMEOUT
    while time.monotonic() < end:
        if (result := find()) is not None:
            return result
        if study.poll() is not None:
            raise RuntimeError("the study ended before a process was killed")
        time.sleep(0.02)
    raise RuntimeError(f"no job was running for {TIMEOUT:g} s")


def is_on(process: int, machine: Any) -> bool:
    """Return True if a worker process was started by the Ray server of the machine."""
    parent = int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
    return any(server.process.pid == parent for server in machine.all_processes["raylet"])


def on_cluster(file: Path, out: Path, episodes: int) -> tuple[int, str, list[str]]:
    """Return the exit code and output of the study on a cluster of two machines, and a list of the losses."""
    from ray.cluster_utils import Cluster

    options = {"num_cpus": 1, "include_dashboard": False, "object_store_memory": 100 * 1024**2}
    cluster = Cluster(initialize_head=True, head_node_args=options | {"num_cpus": 0})
    losses = []
    try:
        machines = [cluster.add_node(**options) for _ in range(2)]
        engine = ("--engine", "ray", "--address", cluster.address)
        with subprocess.Popen(
            command(file, out, *engine), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as study:
            name, process = wait_for(lambda: next(running_jobs(out, episodes), None), study)
            os.kill(process, signal.SIGKILL)
            losses.append(f"the worker of {name}")
            killed = name
            name, process = wait_for(
                lambda: next((job for job in running_jobs(out, 0) if job[0] != killed), None), study
            )
            lost = next(machine for machine in machines if is_on(process, machine))
            cluster.remove_node(lost, allow_graceful=False)
            losses.append(f"one of two machines, where {name} was running")
            output, _ = study.communicate(timeout=TIMEOUT)
        return study.returncode, output, losses
    finally:
        cluster.shutdown()


def compare(folder: Path, bead: bool) -> dict[str, object]:
    """Run the study in two processes and on the cluster; return the comparison."""
    file, seconds = write_study(folder, bead), time.perf_counter()
    subprocess.run(command(file, folder / "process"), check=True, capture_output=True, timeout=TIMEOUT)
    seconds = time.perf_counter() - seconds
    started = time.perf_counter()
    code, output, losses = on_cluster(file, folder / "ray", 10 if bead else 1)
    return {
        "losses": losses,
        "exit_code": code,
        "restarted": [line for line in output.splitlines() if "by worker" in line],
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
    sys.exit(bool(result["exit_code"] or result["differences"] or len(result["restarted"]) < 2))


if __name__ == "__main__":
    main()
