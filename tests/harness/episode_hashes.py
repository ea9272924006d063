"""Hashes of seeded episodes and of seeded trainings, to be compared after a refactoring.

    python tests/harness/episode_hashes.py write before.json     # some minutes
    python tests/harness/episode_hashes.py write after.json      # in the changed tree, on the same machine
    python tests/harness/episode_hashes.py compare before.json after.json

A hash of an environment covers observations, rewards, terminations, violations, forces and fallbacks of two episodes
with smooth random actions: all tasks, guidance, stations and difficulties, sensor errors, a part made from two meshes,
and guidance around an environment without Drake (`GuidedEnv`). A hash of a learner is the digest of the weights and the
number of steps after three episodes. The same tree gives the same hashes on one machine; other processors round
differently. `compare` prints every case that differs or is missing; the exit code is 1 if there is such a case.
`--task`, `--guidance` and `--station` select cases; `--task GuidedEnv`, `part` and `learner` select the other kinds.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import guiderail
from guiderail.diagrams.envs.config import prior_of, stations_of
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.stations.registry import STATIONS
from guiderail.diagrams.tasks.registry import TASKS, environment_id
from guiderail.models.common.errors import InputError
from guiderail.models.robots.robot import robot_names

STEPS = 60  # largest number of environment steps of an episode
INFO = ("constraint_violation", "measured_violation", "force", "fallback")
EXTRA_CASES: list[tuple[str, dict[str, Any]]] = [
    (
        "BncConnector",
        {"guidance": "kgrl", "sensing.wrench_noise": [0.2, 0.01], "sensing.wrench_delay": 2, "action_repeat": 5},
    ),
    ("BncConnector", {"guidance": "skgrl", "reward": "shaped"}),
    ("BncConnector", {"guidance": "skgrl", "observation": "center_of_pressure", "action_repeat": 5}),
    ("NarrowPassage", {"guidance": "kgrl", "observation": "image", "action_repeat": 10}),
]
ROBOT_SENSING: dict[str, Any] = {"sensing": "robot", "difficulty": "hard", "action_repeat": 5}
SENSING_CASES: list[tuple[str, dict[str, Any]]] = [
    (task, {**ROBOT_SENSING, "guidance": guidance, "station": station})
    for task, guidance in (("BncConnector", "kgrl"), ("BncConnector", "skgrl"), ("GridClamp", "sct"))
    for station in ("gantry", "arm")
]
PART_CASES: list[dict[str, Any]] = [
    {"guidance": "kgrl", "action_repeat": 5},
    {"guidance": "skgrl", "action_repeat": 5, "sensing": "robot", "station": "arm"},
]
GUIDED_CASES: list[dict[str, Any]] = [
    {"guidance": guidance, "history": history}
    for guidance, history in (("kgrl", 4), ("skgrl", 4), ("skgrl", 10), ("residual", 4), ("clipped_residual", 4))
]
OFF_POLICY: dict[str, Any] = {"net_arch": "16", "batch_size": 8, "learning_starts": 6}
ON_POLICY: dict[str, Any] = {"net_arch": "16,16", "n_steps": 32, "batch_size": 8}
CLONING: dict[str, Any] = {"net_arch": "16,16", "batch_size": 8, "gradient_steps": 60, "demonstration_episodes": 2}
LEARNER_CASES: dict[str, dict[str, Any]] = {
    "bc": CLONING,
    "chunk": CLONING | {"chunk_steps": 10},
    "crossq": OFF_POLICY,
    "distillation": {"net_arch": "16,16", "batch_size": 8, "gradient_steps": 60, "chunk_steps": 10},
    "ppo": ON_POLICY,
    "sac": OFF_POLICY,
    "td3": OFF_POLICY,
    "tqc": OFF_POLICY,
}


def all_cases() -> list[tuple[str, dict[str, Any]]]:
    """Return task and options of every case."""
    cases = []
    for task in ("NarrowPassage", "BncConnector", "GridClamp", "Pouring"):
        declared = TASKS.get(task)
        stations = [name for name in stations_of(declared) if STATIONS.get(name).is_simulated]
        for guidance in possible_guidance(prior_of(declared).provides):
            for options in _station_options(task, stations):
                for difficulty in ("standard", "hard"):
                    common = {"guidance": guidance, "difficulty": difficulty, "action_repeat": 5}
                    cases.append((task, common | options))
    return cases + EXTRA_CASES + SENSING_CASES


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
        env = gymnasium.make(environment_id(task), disable_env_checker=True, **options)
    except InputError as error:
        return f"refused: {error}"
    return _hash_of(env, steps, ({"held_out": False}, {"held_out": True}))


def guided_hash(options: dict[str, Any]) -> str:
    """Return the hash of two episodes of `GuidedEnv` around a point robot; see `episode_hash`.

    Args:
        options: Arguments of `GuidedEnv` beyond the demonstrations, the frame and the two conversions.
    """
    from point_env import PERIOD, PointEnv, demonstrations, pose, to_action  # see `main`

    env = guiderail.GuidedEnv(
        PointEnv(),
        demonstrations=demonstrations(),
        frame=lambda env, observation: env.unwrapped.target,
        constraints=guiderail.LinearConstraints.box([-np.inf, -0.13, -np.inf], [np.inf, 0.01, np.inf]),
        pose=pose,
        to_action=to_action,
        period=PERIOD,
        action_repeat=3,
        horizon=20,
        **options,
    )
    return _hash_of(env, STEPS, ({}, {}))


def _hash_of(env: gymnasium.Env, steps: int, resets: tuple[dict[str, Any], ...]) -> str:
    digest, rng, count = hashlib.blake2b(digest_size=8), np.random.default_rng(7), 0
    info: dict[str, Any] = {}
    # Of the two forces, the one that the hashes had before there were two.
    has_impedance = getattr(env.unwrapped, "_has_impedance", True)
    for episode, options in enumerate(resets):
        observation, info = env.reset(seed=3 + episode, options=options)
        digest.update(np.ascontiguousarray(observation).tobytes())
        action = np.zeros(env.action_space.shape or ())
        for _ in range(steps):
            action = np.clip(0.7 * action + 0.5 * rng.normal(size=action.shape), -1.0, 1.0)
            observation, reward, terminated, truncated, info = env.step(action.astype(np.float32))
            count += 1
            forces = "impedance_force" if has_impedance else "contact_force"
            own = {**info, "force": info[forces]} if forces in info else info
            values = (own[name] for name in INFO if name in own)
            numbers = [float(reward), terminated, truncated, *map(float, values)]
            digest.update(np.ascontiguousarray(observation).tobytes())
            digest.update(np.array(numbers, dtype=float).tobytes())
            if terminated or truncated:
                break
        digest.update(str(info.get("termination", "")).encode())
    env.close()
    return f"{digest.hexdigest()} {count} {info.get('termination', '')}"


def learner_hash(algorithm: str, settings: dict[str, Any], folder: Path) -> str:
    """Train for three episodes; return the digest of the weights and the number of control steps of each episode.

    Args:
        algorithm: Name of the learner.
        settings: Settings of the learner.
        folder: Folder for the run and, for `distillation`, for its teacher.
    """
    if algorithm == "distillation":
        teacher = folder / "teacher"
        _train("tqc", LEARNER_CASES["tqc"], teacher)
        settings = settings | {"teacher": str(teacher)}
    run = _train(algorithm, settings, folder / algorithm)
    weights = hashlib.blake2b((run.path / "policy.safetensors").read_bytes(), digest_size=8).hexdigest()
    return f"{weights} {run.episodes['steps'].tolist()}"


def _train(algorithm: str, settings: dict[str, Any], out: Path) -> guiderail.Run:
    options = {"algorithm": algorithm, "settings": settings, "pictures": False, "out": out, "seed": 1, "episodes": 3}
    if "demonstration_episodes" in settings:  # the connector has a scripted policy for these episodes
        return guiderail.train("BncConnector", "kgrl", action_repeat=20, **options)
    return guiderail.train("NarrowPassage", "kgrl", action_repeat=10, **options)


def make_part(folder: Path) -> str:
    """Create the task folder of a square peg from two mesh files; return the name of its task."""
    from guiderail.diagrams.tasks.registry import register_task_folder
    from guiderail_parts.create_task import create_task
    from oracles.parts import square_peg  # see `main`

    plug, socket = square_peg().write(folder)
    create_task(plug, socket, folder / "square_peg", unit="mm", hard_episodes=0)
    return register_task_folder(folder / "square_peg")


def write(path: Path, selected: dict[str, str | None]) -> None:
    """Write the hashes of the selected cases as JSON, with progress on standard error.

    Args:
        path: File to write.
        selected: Values of `task`, `guidance` and `station`; None selects all values.
    """
    hashes = {}

    def is_selected(**values: Any) -> bool:
        return all(value is None or values.get(key) == value for key, value in selected.items())

    def add(name: str, value: str) -> None:
        hashes[name] = value
        print(name, value, file=sys.stderr, flush=True)

    for task, options in all_cases():
        if is_selected(task=task, **options):
            add(case_name(task, options), episode_hash(task, options))
    for options in GUIDED_CASES:
        if is_selected(task="GuidedEnv", **options):
            add(case_name("GuidedEnv", options), guided_hash(options))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if is_selected(task="part"):
            part = make_part(folder)
            for options in PART_CASES:
                add(case_name("part", options), episode_hash(part, options))
        for algorithm, settings in LEARNER_CASES.items():
            if is_selected(task="learner"):
                add(f"learner {algorithm}", learner_hash(algorithm, settings, folder))
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
    sys.path.append(str(Path(__file__).parents[1]))  # modules of the tests, as in pytest's `pythonpath`
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
