"""Distillation of a KGRL policy (thesis, 6.2.3): comparison of teacher and student on the same held-out episodes.

The student is executed in three ways: alone, with the guard of chunks, and as the reference of KGRL. The time that
teacher and student need for an action is measured as well.

Run it with `python -m research.distillation --teacher runs/teacher --student runs/student --out runs/distillation`.
"""

import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import beyond_defaults, make_environment
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.evaluate import evaluate_policy
from guiderail.tools.evaluation.evaluation import load_or_compute, policy_digest
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.tables import write_table
from guiderail_lerobot.base_policy import chunk_samples, find_base_policy
from research.command import Parser, print_rows, run_program

BLOCK = 10  # number of episodes in a stored file
MEASURED = 300  # number of timed actions
# Options of each way to execute the student. The teacher has the options of its own run.
VARIANTS: dict[str, dict[str, Any]] = {
    "teacher": {},
    "student": {"guidance": "base_policy", "base_policy.guard": "none"},
    "student, guarded": {"guidance": "base_policy", "base_policy.guard": "projection"},
    "student in KGRL's projection": {"guidance": "kgrl_base_policy"},
}


def options_of(variant: str, task: str, environment: Mapping[str, Any], student: Path, repeat: int) -> dict[str, Any]:
    """Return the environment options of a variant.

    Args:
        variant: Name in `VARIANTS`.
        task: Name of the task.
        environment: Options of the teacher's environment.
        student: Folder of the student's run.
        repeat: Control steps of an action, after which the student predicts again.
    """
    arguments = VARIANTS[variant]
    further = {"base_policy": str(student), "base_policy.replan_steps": repeat} if arguments else {}
    return beyond_defaults(task, environment) | arguments | further


def evaluate_variant(teacher: RunFolder, student: Path, variant: str, episodes: int, seed: int) -> pd.DataFrame:
    """Return the rows of held-out episodes of a variant."""
    config = teacher.config()
    options = options_of(variant, config.task, config.environment, student, config.action_repeat)
    env: Any = make_environment(config.task, options)
    try:
        env.reset(seed=config.seed)
        zero = np.zeros(env.action_space.shape, np.float32)
        act = Policy.load(teacher.path) if variant == "teacher" else lambda observation: zero
        return evaluate_policy(env, act, episodes=episodes, seed=seed, processes=1)
    finally:
        env.close()


def evaluate_in_blocks(prefix: Path, evaluate: Callable[[int, int], pd.DataFrame], episodes: int) -> pd.DataFrame:
    """Evaluate held-out episodes in blocks of `BLOCK`; a block that is stored is not evaluated again.

    Args:
        prefix: Path of the stored files, to which the first episode and the number of episodes are appended.
        evaluate: Function from a number of episodes and the seed of the first episode to their rows.
        episodes: Number of episodes.
    """
    tables = []
    for first in range(0, episodes, BLOCK):
        count = min(BLOCK, episodes - first)
        file = prefix.with_name(f"{prefix.name}-{first}-{count}.csv")
        tables.append(load_or_compute(file, partial(evaluate, count, HELD_OUT_SEED + first)))
    return pd.concat(tables)


def time_per_action(teacher: RunFolder, student: Path) -> dict[str, float]:
    """Return the median time of an action, with all its commands, without simulation [ms].

    The teacher's time includes its network, and a constrained primitive in every control step. The student's time
    includes only its network.
    """
    config, policy, base = teacher.config(), Policy.load(teacher.path), find_base_policy(str(student))
    options = beyond_defaults(config.task, config.environment)
    act_as_teacher, observations, num_outputs = teacher_actions(config.task, options, config.action_repeat, policy)

    def act_as_student(index: int) -> None:
        chunk_samples(base, observations[index], num_outputs)

    return {"teacher": median_time(act_as_teacher), "student": median_time(act_as_student)}


def teacher_actions(
    task: str, options: Mapping[str, Any], repeat: int, policy: Policy
) -> tuple[Callable[[int], None], np.ndarray, int]:
    """Return a function that computes a KGRL policy's action and its commands, for timing.

    Args:
        task: Name of the task.
        options: Options of the teacher's environment.
        repeat: Control steps of an action.
        policy: Policy of the teacher.

    Returns:
        The function of the index of an observation, the random observations (n, …), and the number of outputs O of a
        command.
    """
    prior = make_prior_knowledge(task, **options).primitive
    if prior is None:
        raise InputError(f"{task} has no demonstrations")
    primitive = prior.primitive(history=False)
    gains, size = prior.null_space_gains(primitive), policy.description["observation_shape"][0]
    observations = np.random.default_rng(0).uniform(-0.5, 0.5, (MEASURED, size)).astype(np.float32)
    starts = (np.arange(MEASURED) * repeat) % (primitive.reference.num_steps - repeat)

    def act(index: int) -> None:
        action = gains * (prior.selection @ np.asarray(policy(observations[index]), float))
        for step in range(starts[index], starts[index] + repeat):
            primitive.predict(int(step), action)

    return act, observations, prior.num_outputs


def median_time(act: Callable[[int], None]) -> float:
    """Return the median duration of `act` [ms], which computes the action with an index."""
    for index in range(MEASURED):  # not timed: the first evaluation of a step factors the primitive's matrices
        act(index)
    times = []
    for index in range(MEASURED):
        started = time.perf_counter()
        act(index)
        times.append(time.perf_counter() - started)
    return 1e3 * float(np.median(times))


def compare(teacher: Path, student: Path, out: Path, *, episodes: int = 100) -> list[dict[str, Any]]:
    """Evaluate teacher and student; write `distillation.csv` and `.md`; return the rows.

    Args:
        teacher: Folder of the teacher's run.
        student: Folder of the student's run.
        out: Folder; blocks of episodes that are already evaluated in it are not evaluated again, unless a policy has
            changed.
        episodes: Number of episodes of each variant.

    Raises:
        InputError: If `episodes` is below 1, or a folder does not contain a suitable policy.
    """
    if episodes < 1:
        raise InputError(f"give at least one episode, not {episodes}")
    find_base_policy(str(student))
    Policy.load(teacher)
    folder, rows = RunFolder(teacher), []
    runs = [run for run in (teacher, student) if (run / "policy.safetensors").is_file()]
    policies = "-".join([teacher.name, student.name, *map(policy_digest, runs)])
    for number, variant in enumerate(VARIANTS):
        evaluate = partial(evaluate_variant, folder, student, variant)
        table = evaluate_in_blocks(out / "episodes" / f"{number}-{policies}", evaluate, episodes)
        rows.append(
            {
                "variant": variant,
                "episodes": len(table),
                "success_rate": float(table["success"].mean()),
                "peak_force": float(table["peak_force"].max()),
                "mean_peak_force": float(table["peak_force"].mean()),
                "commanded_jerk": float(table["jerk_commanded_linear"].mean()),
                "max_commanded_violation": float(table["max_commanded_violation"].max()),
            }
        )
    times = time_per_action(folder, student)
    for row in rows:
        row["time_per_action_ms"] = times.get(row["variant"], np.nan)
    write_table(out / "distillation", rows)
    return rows


def main(arguments: list[str]) -> None:
    """Run the program with command-line arguments."""
    parser = Parser(
        "distillation", "Compare a distilled student with its teacher.", "--teacher runs/teacher --student runs/student"
    )
    parser.add_out("runs/distillation")
    parser.add_argument("--teacher", type=Path, required=True, help="folder of the teacher's run")
    parser.add_argument("--student", type=Path, required=True, help="folder of the student's run")
    parser.add_argument("--episodes", type=int, default=100, help="held-out episodes of each variant (default: 100)")
    parser.add_json()
    options = parser.parse_args(arguments)
    rows = compare(options.teacher, options.student, options.out, episodes=options.episodes)
    print_rows(options.out / "distillation.md", rows, as_json=options.json)


if __name__ == "__main__":
    run_program(main)
