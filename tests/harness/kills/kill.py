"""Kills training runs at random instants, and a study, and asks whether what they leave is as if nobody had.

    python tests/kills/kill.py --kills 40                       # some ten minutes where nothing else runs
    python tests/kills/kill.py --kills 12 --tasks GridClamp     # some of them

A run is begun, killed (SIGKILL), gone on with, killed again, and so on, and at last left alone. Half of the kills come
when at least half of its episodes are in a checkpoint, after a random part of an episode's time; the others at any
instant from the first import on. Then its folder is compared with that of an undisturbed run: every table without its
clock, the policy's bytes, every array and value of the checkpoint. A study is killed with its workers running, and
once only a worker: no process may be left. It prints what was found as JSON, and ends with 1 if anything differs.
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
    "GridClamp": ["--episodes", "6", *SMALL],
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
PATIENCE = 600.0  # s


def guiderail(*arguments: object) -> subprocess.Popen:
    """The command, in a process of its own."""
    program = "from guiderail.tools.cli.main import main; main()"
    words = [sys.executable, "-c", program, *map(str, arguments)]
    return subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)


def episodes(run: Path) -> int:
    """How many are in a run's table, each of which is in its checkpoint too."""
    try:
        return (run / "episodes.csv").read_bytes().count(b"\n") - 1
    except FileNotFoundError:
        return 0


def finished(process: subprocess.Popen) -> None:
    """Waits for a command that must succeed."""
    _, words = process.communicate(timeout=PATIENCE)
    if process.returncode:
        raise RuntimeError(f"exit code {process.returncode}: {words.strip()[-500:]}")


def until(done: Callable[[], bool], process: subprocess.Popen) -> bool:
    """Waits for something to happen while a command runs; whether it did before the command ended."""
    end = time.monotonic() + PATIENCE
    while not done():
        if process.poll() is not None:
            return done()
        if time.monotonic() > end:
            raise RuntimeError("nothing happens")
        time.sleep(0.005)
    return True


def kill_run(task: str, options: list[str], whole: Path, run: Path, wanted: int, chance: random.Random) -> dict:
    """Kills a run so often and lets it end; what came of it."""
    total, seconds = episodes(whole), json.loads((whole / "seconds.json").read_text())
    when = sorted(chance.choice([*range(total // 2, total)]) for _ in range(wanted - wanted // 2))
    early = sorted(chance.uniform(0.0, 1.3 * seconds["begins"]) for _ in range(wanted // 2))
    killed = {"begun": 0, "late": 0, "instants": []}
    for index, at in enumerate([*early, *when]):
        go_on = ["--resume"] if (run / "config.yaml").exists() else [task, *options, "--seed", "3"]
        process = guiderail("train", "--out", run, *go_on)
        late = index >= len(early)
        if late:
            until(lambda at=at: episodes(run) >= at, process)
            time.sleep(chance.uniform(0.0, 1.5 * seconds["episode"]))
        else:
            time.sleep(at)
        if process.poll() is not None:
            process.communicate()
            continue  # it ended before: no kill
        process.kill()
        process.communicate()
        done = episodes(run)
        killed["late" if done >= total / 2 else "begun"] += 1
        killed["instants"].append(done)
    if (run / "config.yaml").exists():
        finished(guiderail("train", "--out", run, "--resume"))
    else:
        finished(guiderail("train", "--out", run, task, *options, "--seed", "3"))
    parts = [str(path.relative_to(run)) for path in run.rglob("*.part")]
    same = [line for line in differences(whole, run) if "seconds.json" not in line and ".part" not in line]
    return killed | {"differences": same, "left_over_parts": parts}


def undisturbed(task: str, options: list[str], run: Path) -> None:
    """A run that nobody kills, and how long its parts take."""
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
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def workers(out: Path) -> dict[str, int]:
    """The process that has each job of the study that is not done."""
    found = {}
    for log in (out / "logs").glob("*.txt"):
        lines = log.read_text().splitlines()
        if lines and " begins on " in lines[-1]:
            found[log.stem] = int(lines[-1].rpartition(" ")[2])
    return found


def kill_study(folder: Path, kills: int, chance: random.Random) -> dict:
    """Kills a study's own process again and again, then a worker of it; what came of it."""
    file, whole, torn = folder / "killed.yaml", folder / "study", folder / "killed-study"
    file.write_text(yaml.safe_dump(STUDY))
    started = time.perf_counter()
    finished(guiderail("study", file, "--out", whole))
    seconds = time.perf_counter() - started
    found: dict = {"parents": 0, "workers": 0, "left_over_processes": 0}
    for _ in range(kills):
        process = guiderail("study", file, "--out", torn)
        had = set(workers(torn).values())  # of the one before
        until(lambda had=had: bool(set(workers(torn).values()) - had), process)
        time.sleep(chance.uniform(0.0, seconds / 3))
        if process.poll() is not None:
            process.communicate()
            continue
        mine = [one for one in set(workers(torn).values()) - had if alive(one)]
        process.send_signal(signal.SIGKILL)
        process.communicate()
        end = time.monotonic() + 10.0
        while any(map(alive, mine)) and time.monotonic() < end:
            time.sleep(0.05)
        found["parents"] += 1
        found["left_over_processes"] += sum(map(alive, mine))
    process = guiderail("study", file, "--out", torn)
    had = set(workers(torn).values())
    if until(lambda: any(alive(one) for one in set(workers(torn).values()) - had), process):
        os.kill(next(one for one in set(workers(torn).values()) - had if alive(one)), signal.SIGKILL)
        found["workers"] += 1
    finished(process)
    return found | {"differences": [line for line in differences(whole, torn) if ".part" not in line]}


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=40, help="of training runs; a quarter as many, or 2, of studies")
    parser.add_argument("--tasks", nargs="+", choices=list(RUNS), default=list(RUNS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="keeps the runs there")
    given = parser.parse_args()
    chance = random.Random(given.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = (given.out or Path(temporary)).absolute()
        folder.mkdir(parents=True, exist_ok=True)
        found: dict = {}
        left = {task: len(range(i, given.kills, len(given.tasks))) for i, task in enumerate(given.tasks)}
        for task, kills in left.items():
            undisturbed(task, RUNS[task], folder / task)
            for number in range(-(-kills // KILLS_OF_A_RUN)):
                wanted, run = min(KILLS_OF_A_RUN, kills - number * KILLS_OF_A_RUN), folder / f"{task}-{number}"
                found[run.name] = kill_run(task, RUNS[task], folder / task, run, wanted, chance)
                print(f"{run.name}: {json.dumps(found[run.name])}", file=sys.stderr, flush=True)
        found["study"] = kill_study(folder, max(2, given.kills // 10), chance)
    runs = [one for name, one in found.items() if name != "study"]
    late, early = sum(one["late"] for one in runs), sum(one["begun"] for one in runs)
    wrong = [f"{name}: {line}" for name, one in found.items() for line in one["differences"]]
    totals = {"kills": late + early, "in_the_second_half": late, "differences": wrong, "study": found["study"]}
    print(json.dumps(totals | {"left_over_parts": [part for one in runs for part in one["left_over_parts"]]}, indent=2))
    sys.exit(bool(wrong or found["study"]["left_over_processes"]))


if __name__ == "__main__":
    main()
