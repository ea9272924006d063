"""Hashes of seeded episodes of all tasks, guidance, stations and difficulties, to be compared after a refactoring.

    python tests/harness/episode_hashes.py write before.json     # some minutes
    python tests/harness/episode_hashes.py write after.json      # in the changed tree, on the same machine
    python tests/harness/episode_hashes.py compare before.json after.json

A hash covers observations, rewards, terminations, violations, forces and fallbacks of two episodes with smooth random
actions. The same tree gives the same hashes on one machine; other processors round differently. `compare` prints every
case that differs or is missing; the exit code is 1 if there is such a case. `--task`, `--guidance` and `--station`
select cases.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import guiderail  # noqa: F401 (registers the environments)
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.robots.robot import robot_names

STEPS = 60  # largest number of environment steps of an episode
INFO = ("constraint_violation", "measured_violation", "contact_force", "fallback")
EXTRA_CASES: list[tuple[str, dict[str, Any]]] = [
    ("BncConnector", {"guidance": "kgrl", "wrench_noise": [0.2, 0.01], "wrench_delay": 2, "action_repeat": 5}),
    ("BncConnector", {"guidance": "skgrl", "reward": "shaped"}),
    ("BncConnector", {"guidance": "skgrl", "observation": "center_of_pressure", "action_repeat": 5}),
    ("NarrowPassage", {"guidance": "kgrl", "observation": "image", "action_repeat": 10}),
]


def all_cases() -> list[tuple[str, dict[str, Any]]]:
    """Return task and options of every case."""
    cases = []
    for task in ("NarrowPassage", "BncConnector", "GridClamp", "Pouring"):
        declared = TASKS.get(task)
        stations = [name for name in declared.stations() if STATIONS.get(name).is_simulated]
        for guidance in possible_guidance(declared.provides()):
            for options in _station_options(task, stations):
                for difficulty in ("standard", "hard"):
                    common = {"guidance": guidance, "difficulty": difficulty, "action_repeat": 5}
                    cases.append((task, common | options))
    return cases + EXTRA_CASES


def _station_options(task: str, stations: list[str]) -> Iterator[dict[str, Any]]:
    if task == "Pouring":
        yield from ({"reward": reward} for reward in ("shaped", "sparse"))
        return
    if len(stations) == 1:
        yield {}
        return
    for station in stations:
        robots = robot_names() if (task, station) == ("BncConnector", "arm") else [None]
        for robot in robots:
            yield {"station": station} | ({} if robot is None else {"robot": robot})


def case_name(task: str, options: dict[str, Any]) -> str:
    """Return the name of a case: its task and sorted options."""
    return " ".join([task, *(f"{key}={value}" for key, value in sorted(options.items()))])


def episode_hash(task: str, options: dict[str, Any], steps: int = STEPS) -> str:
    """Run two seeded episodes; return their hash, number of steps and termination, or the refusal of the options.

    Args:
        task: Name of the task.
        options: Options of the environment.
        steps: Largest number of environment steps of an episode.
    """
    try:
        env = gymnasium.make(f"guiderail/{task}-v0", disable_env_checker=True, **options)
    except InputError as error:
        return f"refused: {error}"
    digest, rng, count = hashlib.blake2b(digest_size=8), np.random.default_rng(7), 0
    info: dict[str, Any] = {}
    for episode in range(2):
        observation, info = env.reset(seed=3 + episode, options={"held_out": bool(episode)})
        digest.update(np.ascontiguousarray(observation).tobytes())
        action = np.zeros(env.action_space.shape or ())
        for _ in range(steps):
            action = np.clip(0.7 * action + 0.5 * rng.normal(size=action.shape), -1.0, 1.0)
            observation, reward, terminated, truncated, info = env.step(action.astype(np.float32))
            count += 1
            numbers = [float(reward), terminated, truncated, *(float(info[name]) for name in INFO)]
            digest.update(np.ascontiguousarray(observation).tobytes())
            digest.update(np.array(numbers, dtype=float).tobytes())
            if terminated or truncated:
                break
        digest.update(info["termination"].encode())
    env.close()
    return f"{digest.hexdigest()} {count} {info['termination']}"


def write(path: Path, selected: dict[str, str | None]) -> None:
    """Write the hashes of the selected cases as JSON, with progress on standard error.

    Args:
        path: File to write.
        selected: Values of `task`, `guidance` and `station`; None selects all values.
    """
    hashes = {}
    for task, options in all_cases():
        values = {"task": task, **options}
        if all(value is None or values.get(key) == value for key, value in selected.items()):
            name = case_name(task, options)
            hashes[name] = episode_hash(task, options)
            print(name, hashes[name], file=sys.stderr, flush=True)
    path.write_text(json.dumps(hashes, indent=1, sort_keys=True) + "\n")


def differences(first: dict[str, str], second: dict[str, str]) -> list[str]:
    """Return a line for each case that differs or is missing in one of the results."""
    names = sorted({*first, *second})
    return [
        f"{name}: {first.get(name, 'missing')} → {second.get(name, 'missing')}"
        for name in names
        if first.get(name) != second.get(name)
    ]


def main(arguments: list[str] | None = None) -> int:
    """Run the program; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    write_parser = commands.add_parser("write", help="run the episodes and write their hashes")
    write_parser.add_argument("file", type=Path)
    for key in ("task", "guidance", "station"):
        write_parser.add_argument(f"--{key}")
    compare_parser = commands.add_parser("compare", help="compare two files of hashes")
    compare_parser.add_argument("first", type=Path)
    compare_parser.add_argument("second", type=Path)
    args = parser.parse_args(arguments)
    if args.command == "write":
        write(args.file, {key: getattr(args, key) for key in ("task", "guidance", "station")})
        return 0
    first, second = (json.loads(path.read_text()) for path in (args.first, args.second))
    lines = differences(first, second)
    print("\n".join([*lines, f"{len(lines)} of {len({*first, *second})} cases differ"]))
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
