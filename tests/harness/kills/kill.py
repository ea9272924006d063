"""Kill training runs and a study at random instants, and compare the results with undisturbed runs.

    python tests/harness/kills/kill.py --kills 40                       # about ten minutes on an idle machine
    python tests/harness/kills/kill.py --kills 12 --tasks GridClamp     # of one task

A run is started, killed (SIGKILL) and resumed repeatedly, and finally completed. Half of the kills happen at a random
instant of an episode, after at least half of the run's episodes are in a checkpoint. The others happen at a random
instant soon after the start of the process. The run's folder is compared with that of an undisturbed run: tables
without wall-clock times, the policy's bytes, every array and value of the checkpoint. A study is killed while its
workers run, and once only one worker is killed; no process may remain. The results are printed as JSON, and the exit
code is 1 if anything differs.
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

SMALL = [
    "--set",
    "net_arch=32,32",
    "--set",
    "learning_starts=10",
    "--set",
    "batch_size=32",
    "--set",
    "gradient_steps=2",
]
RUNS = {
    "NarrowPassage": ["--guidance", "kgrl", "--preset", "tqc_fast", "--episodes", "12", *SMALL],
    "GridClamp": ["--episodes", "6", "--num-envs", "2", *SMALL],  # parallel actors
    "Pouring": ["--episodes", "8", *SMALL],
}
KILLS_OF_A_RUN = 7
STUDY = {
    "name": "killed",
    "task": "NarrowPassage",
    "env": {"guidance": "kgrl"},
    "learner": {
        "preset": "tqc_fast",
        "episodes": 4,
        "settings": {"net_arch": "32,32", "learning_starts": 10, "batch_size": 32, "gradient_steps": 2},
    },
    "methods": {"kgrl": {}},
    "seeds": [0, 1, 2],
    "after_episodes": [2],
    "eval_set": [{"episodes": 2}],
}
TIMEOUT = 600.0  # largest time of a command or of waiting [s]


def guiderail(*arguments: object) -> subprocess.Popen:
    """Start the command in a child process."""
    program = "from guiderail.tools.cli.main import main; main()"
    words = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def episodes(run: Path) -> int:
    """Return the number of episodes in a run's table, all of which are in its checkpoint."""
    try:
        return (run / "episodes.csv").read_bytes().count(b"\n") - 1
    except FileNotFoundError:
        return 0


def finished(process: subprocess.Popen) -> None:
    """Wait for a command that must succeed."""
    _, output = process.communicate(timeout=TIMEOUT)
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}: {output.strip()[-500:]}")


def until(done: Callable[[], bool], process: subprocess.Popen) -> bool:
    """Wait for a condition while a command runs; return True if it occurred before the command ended."""
    end = time.monotonic() + TIMEOUT
    while not done():
        if process.poll() is not None:
            return done()
        if time.monotonic() > end:
            raise RuntimeError("timeout")
        time.sleep(0.005)
    return True


def kill_run(task: str, options: list[str], whole: Path, run: Path, kills: int, rng: random.Random) -> dict:
    """Kill a run repeatedly and complete it; return counts and differences."""
    total, seconds = episodes(whole), json.loads((whole / "seconds.json").read_text())
    when = sorted(rng.choice([*range(total // 2, total)]) for _ in range(kills - kills // 2))
    early = sorted(rng.uniform(0.0, 1.3 * seconds["begins"]) for _ in range(kills // 2))
    result = {"early": 0, "late": 0, "instants": []}
    for index, at in enumerate([*early, *when]):
        arguments = ["--resume"] if (run / "config.yaml").exists() else [task, *options, "--seed", "3"]
        process = guiderail("train", "--out", run, *arguments)
        late = index >= len(early)
        if late:
            until(lambda at=at: episodes(run) >= at, process)
            time.sleep(rng.uniform(0.0, 1.5 * seconds["episode"]))
        else:
            time.sleep(at)
        if process.poll() is not None:
            process.communicate()
            continue  # it ended before the kill
        process.kill()
        process.communicate()
        done = episodes(run)
        result["late" if done >= total / 2 else "early"] += 1
        result["instants"].append(done)
    if (run / "config.yaml").exists():
        finished(guiderail("train", "--out", run, "--resume"))
    else:
        finished(guiderail("train", "--out", run, task, *options, "--seed", "3"))
    parts = [str(path.relative_to(run)) for path in run.rglob("*.part")]
    same = [line for line in differences(whole, run) if "seconds.json" not in line and ".part" not in line]
    return result | {"differences": same, "left_over_parts": parts}


def undisturbed(task: str, options: list[str], run: Path) -> None:
    """Run without kills, and measure the durations of its parts."""
    started = time.perf_counter()
    process = guiderail("train", "--out", run, task, *options, "--seed", "3")
    until(lambda: episodes(run) >= 1, process)
    begins = time.perf_counter() - started
    until(lambda: (run / "policy.json").exists(), process)
    rest = time.perf_counter() - started - begins
    finished(process)
    seconds = {"begins": begins, "episode": rest / max(episodes(run) - 1, 1)}
    (run / "seconds.json").write_text(json.dumps(seconds))


def alive(process: int) -> bool:
    """Return True if a process exists and is not a zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def workers(out: Path) -> dict[str, int]:
    """Return the process of each unfinished job of a study."""
    result = {}
    for log in (out / "logs").glob("*.txt"):
        lines = log.read_text().splitlines()
        if lines and " begins on " in lines[-1]:
            result[log.stem] = int(lines[-1].rpartition(" ")[2])
    return result


def kill_study(folder: Path, kills: int, rng: random.Random) -> dict:
    """Kill the process of a study repeatedly, then one of its workers; return counts and differences."""
    file, whole, torn = folder / "killed.yaml", folder / "study", folder / "killed-study"
    file.write_text(yaml.safe_dump(STUDY))
    started = time.perf_counter()
    finished(guiderail("study", file, "--out", whole))
    seconds = time.perf_counter() - started
    result: dict = {"parents": 0, "workers": 0, "left_over_processes": 0}
    for _ in range(kills):
        process = guiderail("study", file, "--out", torn)
        previous = set(workers(torn).values())  # workers of the previous process
        until(lambda previous=previous: bool(set(workers(torn).values()) - previous), process)
        time.sleep(rng.uniform(0.0, seconds / 3))
        if process.poll() is not None:
            process.communicate()
            continue
        own = [one for one in set(workers(torn).values()) - previous if alive(one)]
        process.send_signal(signal.SIGKILL)
        process.communicate()
        end = time.monotonic() + 10.0
        while any(map(alive, own)) and time.monotonic() < end:
            time.sleep(0.05)
        result["parents"] += 1
        result["left_over_processes"] += sum(map(alive, own))
    process = guiderail("study", file, "--out", torn)
    previous = set(workers(torn).values())
    if until(lambda: any(alive(one) for one in set(workers(torn).values()) - previous), process):
        os.kill(next(one for one in set(workers(torn).values()) - previous if alive(one)), signal.SIGKILL)
        result["workers"] += 1
    finished(process)
    return result | {"differences": [line for line in differences(whole, torn) if ".part" not in line]}


def main() -> None:
    """Run the program."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kills", type=int, default=40, help="kills of training runs; a tenth as many, at least 2, of studies"
    )
    parser.add_argument("--tasks", nargs="+", choices=list(RUNS), default=list(RUNS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder in which the runs are kept")
    args = parser.parse_args()
    rng = random.Random(args.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = (args.out or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        result: dict = {}
        left = {task: len(range(i, args.kills, len(args.tasks))) for i, task in enumerate(args.tasks)}
        for task, kills in left.items():
            undisturbed(task, RUNS[task], folder / task)
            for number in range(-(-kills // KILLS_OF_A_RUN)):
                count, run = min(KILLS_OF_A_RUN, kills - number * KILLS_OF_A_RUN), folder / f"{task}-{number}"
                result[run.name] = kill_run(task, RUNS[task], folder / task, run, count, rng)
                print(f"{run.name}: {json.dumps(result[run.name])}", file=sys.stderr, flush=True)
        result["study"] = kill_study(folder, max(2, args.kills // 10), rng)
    runs = [one for name, one in result.items() if name != "study"]
    late, early = sum(one["late"] for one in runs), sum(one["early"] for one in runs)
    wrong = [f"{name}: {line}" for name, one in result.items() for line in one["differences"]]
    totals = {"kills": late + early, "in_the_second_half": late, "differences": wrong, "study": result["study"]}
    print(json.dumps(totals | {"left_over_parts": [part for one in runs for part in one["left_over_parts"]]}, indent=2))
    sys.exit(bool(wrong or result["study"]["left_over_processes"]))


if __name__ == "__main__":
    main()
