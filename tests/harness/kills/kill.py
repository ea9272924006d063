"""Kill training runs and a study at random instants, and compare the results with undisturbed runs.

    python tests/harness/kills/kill.py --kills 40                       # about ten minutes on an idle machine
    python tests/harness/kills/kill.py --kills 12 --tasks GridClamp     # kills of one task

A run is started, killed (SIGKILL) and resumed repeatedly, and finally completed. Half of the kills happen at a random
instant of an episode, after at least half of the run's episodes are in a checkpoint. The others happen at a random
instant soon after the start of the process. The folder of the run is compared with the folder of an undisturbed run:
tables without wall-clock times, the policy's bytes, every array and value of the checkpoint. A study is killed
repeatedly while its workers run; the workers must end as well. Finally only one of the workers is killed. The results
are printed as JSON, and the exit code is 1 if a result differs or a process remains.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import yaml

TESTS = Path(__file__).parents[2]
sys.path.insert(0, str(TESTS))
from oracles.same_runs import differences  # noqa: E402

SETTINGS = {"net_arch": "32,32", "learning_starts": 10, "batch_size": 32, "gradient_steps": 2}
SMALL = [word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}")]
RUNS = {
    "NarrowPassage": ["--guidance", "kgrl", "--preset", "tqc_fast", "--episodes", "12", *SMALL],
    "GridClamp": ["--episodes", "6", "--num-envs", "2", *SMALL],  # parallel actors
    "Pouring": ["--episodes", "8", *SMALL],
}
KILLS_PER_RUN = 7
STUDY = {
    "name": "killed",
    "task": "NarrowPassage",
    "env": {"guidance": "kgrl"},
    "learner": {"preset": "tqc_fast", "episodes": 4, "settings": SETTINGS},
    "methods": {"kgrl": {}},
    "seeds": [0, 1, 2],
    "after_episodes": [2],
    "eval_set": [{"episodes": 2}],
}
TIMEOUT = 600.0  # longest duration of a command or of a wait [s]


def guiderail(*arguments: object) -> subprocess.Popen:
    """Start a `guiderail` command in a child process."""
    program = "from guiderail.tools.cli.main import main; main()"
    words = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def count_episodes(run: Path) -> int:
    """Return the number of episodes in the table of a run; its checkpoint has all of them."""
    try:
        return (run / "episodes.csv").read_bytes().count(b"\n") - 1
    except FileNotFoundError:
        return 0


def wait_for_success(process: subprocess.Popen) -> None:
    """Wait for the end of a command; raise an error if the command fails."""
    _, output = process.communicate(timeout=TIMEOUT)
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}: {output.strip()[-500:]}")


def wait_until(condition: Callable[[], bool], process: subprocess.Popen) -> bool:
    """Wait for a condition or the end of a command; return True if the condition was met."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        if process.poll() is not None:
            return condition()
        if time.monotonic() > end:
            raise RuntimeError("timeout")
        time.sleep(0.005)
    return True


def kill_run(task: str, options: list[str], reference: Path, run: Path, kills: int, rng: random.Random) -> dict:
    """Kill a run repeatedly and complete it; return counts and differences from an undisturbed reference."""
    total, seconds = count_episodes(reference), json.loads((reference / "seconds.json").read_text())
    late_episodes = sorted(rng.choice([*range(total // 2, total)]) for _ in range(kills - kills // 2))
    early_times = sorted(rng.uniform(0.0, 1.3 * seconds["start"]) for _ in range(kills // 2))
    result = {"early": 0, "late": 0, "episodes_at_kill": []}
    for index, instant in enumerate([*early_times, *late_episodes]):
        arguments = ["--resume"] if (run / "config.yaml").exists() else [task, *options, "--seed", "3"]
        process = guiderail("train", "--out", run, *arguments)
        if index >= len(early_times):
            wait_until(lambda number=instant: count_episodes(run) >= number, process)
            time.sleep(rng.uniform(0.0, 1.5 * seconds["episode"]))
        else:
            time.sleep(instant)
        if process.poll() is not None:
            process.communicate()
            continue  # the process ended before the kill
        process.kill()
        process.communicate()
        number = count_episodes(run)
        result["late" if number >= total / 2 else "early"] += 1
        result["episodes_at_kill"].append(number)
    arguments = ["--resume"] if (run / "config.yaml").exists() else [task, *options, "--seed", "3"]
    wait_for_success(guiderail("train", "--out", run, *arguments))
    parts = [str(path.relative_to(run)) for path in run.rglob("*.part")]
    lines = [line for line in differences(reference, run) if "seconds.json" not in line and ".part" not in line]
    return result | {"differences": lines, "left_over_parts": parts}


def run_undisturbed(task: str, options: list[str], run: Path) -> None:
    """Complete a run without kills, and store the time until its first episode and the mean time of the others."""
    started = time.perf_counter()
    process = guiderail("train", "--out", run, task, *options, "--seed", "3")
    wait_until(lambda: count_episodes(run) >= 1, process)
    start = time.perf_counter() - started
    wait_until(lambda: (run / "policy.json").exists(), process)
    rest = time.perf_counter() - started - start
    wait_for_success(process)
    seconds = {"start": start, "episode": rest / max(count_episodes(run) - 1, 1)}
    (run / "seconds.json").write_text(json.dumps(seconds))


def is_alive(pid: int) -> bool:
    """Return True if a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def worker_pids(out: Path) -> set[int]:
    """Return the process ids of the workers of all unfinished jobs of a study."""
    pids = set()
    for log in (out / "logs").glob("*.txt"):
        lines = log.read_text().splitlines()
        if lines and " begins on " in lines[-1]:
            pids.add(int(lines[-1].rpartition(" ")[2]))
    return pids


def kill_study(folder: Path, kills: int, rng: random.Random) -> dict:
    """Kill the process of a study repeatedly, and then one of its workers; return counts and differences."""
    file, reference, killed = folder / "killed.yaml", folder / "study", folder / "killed-study"
    file.write_text(yaml.safe_dump(STUDY))
    started = time.perf_counter()
    wait_for_success(guiderail("study", file, "--out", reference))
    seconds = time.perf_counter() - started
    result: dict = {"parents": 0, "workers": 0, "left_over_processes": 0}
    for _ in range(kills):
        process = guiderail("study", file, "--out", killed)
        previous = worker_pids(killed)  # workers of the previous process
        wait_until(lambda previous=previous: bool(worker_pids(killed) - previous), process)
        time.sleep(rng.uniform(0.0, seconds / 3))
        if process.poll() is not None:
            process.communicate()
            continue
        own = [pid for pid in worker_pids(killed) - previous if is_alive(pid)]
        process.send_signal(signal.SIGKILL)
        process.communicate()
        end = time.monotonic() + 10.0
        while any(map(is_alive, own)) and time.monotonic() < end:
            time.sleep(0.05)
        result["parents"] += 1
        result["left_over_processes"] += sum(map(is_alive, own))
    process = guiderail("study", file, "--out", killed)
    previous = worker_pids(killed)
    if wait_until(lambda: any(map(is_alive, worker_pids(killed) - previous)), process):
        os.kill(next(filter(is_alive, worker_pids(killed) - previous)), signal.SIGKILL)
        result["workers"] += 1
    wait_for_success(process)
    return result | {"differences": [line for line in differences(reference, killed) if ".part" not in line]}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kills",
        type=int,
        default=40,
        help="kills of training runs; a study is killed a tenth as often, at least twice",
    )
    parser.add_argument("--tasks", nargs="+", choices=list(RUNS), default=list(RUNS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder of the runs (default: a temporary folder)")
    args = parser.parse_args()
    rng = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.out or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        result: dict = {}
        num_kills = {task: len(range(i, args.kills, len(args.tasks))) for i, task in enumerate(args.tasks)}
        for task, kills in num_kills.items():
            run_undisturbed(task, RUNS[task], folder / task)
            for number in range(-(-kills // KILLS_PER_RUN)):
                count, run = min(KILLS_PER_RUN, kills - number * KILLS_PER_RUN), folder / f"{task}-{number}"
                result[run.name] = kill_run(task, RUNS[task], folder / task, run, count, rng)
                print(f"{run.name}: {json.dumps(result[run.name])}", file=sys.stderr, flush=True)
        result["study"] = kill_study(folder, max(2, args.kills // 10), rng)
    runs = [counts for name, counts in result.items() if name != "study"]
    late, early = sum(run["late"] for run in runs), sum(run["early"] for run in runs)
    lines = [f"{name}: {line}" for name, counts in result.items() for line in counts["differences"]]
    totals = {"kills": late + early, "in_the_second_half": late, "differences": lines, "study": result["study"]}
    print(json.dumps(totals | {"left_over_parts": [part for run in runs for part in run["left_over_parts"]]}, indent=2))
    sys.exit(bool(lines or result["study"]["left_over_processes"]))


if __name__ == "__main__":
    main()
