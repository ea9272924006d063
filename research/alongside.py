"""Student trained alongside a KGRL teacher from the same transitions, and refined on its own (thesis, 6.2.3).

The student's action is a displacement in task space, so the student needs no primitive at execution. While the teacher
acts, its transitions are stored in the student's replay buffer, with the equivalent displacement as action. Then the
student acts itself, inside the constraints (`safe_residual`), and learns from its own transitions.

Run it with `python -m research.alongside --out runs/alongside`.
"""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.episode import Callback, Transition
from guiderail.tools.evaluation.evaluate import evaluate_policy
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.learning.learner import describe_interface, learner_arguments
from guiderail.tools.learning.off_policy import OffPolicyLearner, TqcLearner
from guiderail.tools.learning.run_folder import RunConfig, configure
from guiderail.tools.tables import read_table, write_table
from research.command import Parser, print_rows, run_program
from research.distillation import evaluate_in_blocks, median_time, teacher_actions

TASK, SETTINGS = "BncConnector", {"symmetry": "near"}
TEACHER = {"guidance": "kgrl", "difficulty": "hard", "reward": "aligned"}
STUDENT = {**TEACHER, "guidance": "safe_residual", "action_scale": 1.85}  # with the same reach as the teacher
# Policy and environment of each row.
VARIANTS: dict[str, tuple[str, Mapping[str, Any]]] = {
    "teacher": ("teacher", TEACHER),
    "student": ("student", STUDENT),
    "student, without constraints": ("student", {**STUDENT, "guidance": "residual"}),
    "student, refined": ("refined", STUDENT),
}


class TaskSpaceTransitions(Callback):
    """Callback that trains a student on the teacher's transitions, with the equivalent displacement as action.

    The displacement is the command minus the motion without actions, averaged over the control steps of the action. It
    is divided by the student's gains and clipped to ±1.

    Args:
        env: Environment of the teacher.
        student: Learner of the student.
        options: Options of the student's environment.
    """

    def __init__(self, env: Any, student: OffPolicyLearner, options: Mapping[str, Any]):
        config = make_prior_knowledge(TASK, **options).primitive
        if config is None:
            raise InputError(f"{TASK} has no demonstrations")
        primitive, self._dims = config.primitive(history=False, constrained=False), list(config.explored_outputs)
        motion = [primitive.predict(step).output for step in range(config.reference.num_steps)]
        self._motion, self._gains = np.array(motion)[:, self._dims], config.residual_gains()[self._dims]
        self._env, self._student, self._step = env.unwrapped, student, 0

    def on_episode_start(self) -> None:
        """Start an episode in which the teacher acts."""
        self._step = 0
        self._student.start_recorded(False, self._student.actor())

    def on_step(self, transition: Transition) -> None:
        """Let the student learn from the transition."""
        self._student.on_step(replace(transition, action=self.equivalent_action()))

    def equivalent_action(self) -> np.ndarray:
        """Return the student's action (A,) for the commands since the last call."""
        first, self._step = self._step, len(self._env.trace)
        steps = np.minimum(np.arange(first, self._step), len(self._motion) - 1)
        displacement = self._env.trace.commanded[first : self._step, self._dims] - self._motion[steps]
        return np.clip(displacement.mean(axis=0) / self._gains, -1.0, 1.0).astype(np.float32)


def make_learner(config: RunConfig, env: Any) -> OffPolicyLearner:
    """Return a learner for the environment of a run's configuration."""
    learner: Any = config.learner
    return TqcLearner(learner, env, **learner_arguments(config, env.unwrapped.diagram))


def train_both(out: Path, episodes: int, refinement: int, seed: int) -> None:
    """Train teacher and student, then the student alone; write the policies and `training.csv`."""
    configs = [
        configure(TASK, options, episodes=episodes + refinement, seed=seed, settings=SETTINGS)
        for options in (TEACHER, STUDENT)
    ]
    envs: list[Any] = [make_environment(TASK, config.environment) for config in configs]
    try:
        teacher, student = (make_learner(*each) for each in zip(configs, envs, strict=True))
        description = {"task": TASK, **describe_interface(envs[0])}
        copied, rows = TaskSpaceTransitions(envs[0], student, STUDENT), []
        for env in envs:
            env.reset(seed=seed)
        for name in ("teacher", "student", "refined"):
            (out / name).mkdir(parents=True, exist_ok=True)
        for index in range(episodes):
            rows.append(
                {"seed": seed, "acting": "teacher", **rollout(envs[0], teacher.act, teacher, copied, index=index)}
            )
        teacher.policy(description).save(out / "teacher")
        student.policy(description).save(out / "student")
        for index in range(episodes, episodes + refinement):
            rows.append({"seed": seed, "acting": "student", **rollout(envs[1], student.act, student, index=index)})
        student.policy(description).save(out / "refined")
        write_table(out / "training", rows)
    finally:
        for env in envs:
            env.close()


def evaluate_variant(out: Path, variant: str, episodes: int, seed: int, run_seed: int) -> pd.DataFrame:
    """Return the rows of held-out episodes of a variant."""
    name, options = VARIANTS[variant]
    env: Any = make_environment(TASK, options)
    try:
        env.reset(seed=run_seed)
        return evaluate_policy(env, Policy.load(out / name), episodes=episodes, seed=seed, processes=1)
    finally:
        env.close()


def times_per_action(out: Path) -> dict[str, float]:
    """Return the median time of an action, with all its commands, without simulation [ms].

    The student's time includes its network, the sum with the motion, and the projection onto the constraints.
    """
    repeat, prior = configure(TASK, TEACHER).action_repeat, make_prior_knowledge(TASK, **STUDENT).primitive
    act_as_teacher, observations, _ = teacher_actions(TASK, TEACHER, repeat, Policy.load(out / "teacher"))
    assert prior is not None
    assert prior.keep_out is not None
    policy, keep_out = Policy.load(out / "refined"), prior.keep_out
    means, gains = prior.reference.means, prior.residual_gains()

    def act_as_student(index: int) -> None:
        displacement = gains * (prior.selection @ np.asarray(policy(observations[index]), float))
        for step in range(repeat):
            keep_out.project(means[step], means[step] + displacement)

    return {"teacher": median_time(act_as_teacher), "student, refined": median_time(act_as_student)}


def compare(
    out: Path, *, episodes: int = 100, training: int = 60, refinement: int = 30, seed: int = 0
) -> list[dict[str, Any]]:
    """Train, evaluate, and write `alongside.csv` and `.md`; return the rows.

    Args:
        out: Folder; policies and blocks of episodes that are already in it are not computed again.
        episodes: Number of held-out episodes of each variant.
        training: Number of episodes in which the teacher acts.
        refinement: Number of episodes in which the student acts.
        seed: Seed of training.

    Raises:
        InputError: If there is no episode, or the policies in the folder were trained with other arguments.
    """
    if min(episodes, training, refinement) < 1:
        raise InputError(f"give at least one episode each, not {episodes}, {training} and {refinement}")
    if (out / "training.csv").exists():
        _refuse_other_training(out, training, refinement, seed)
    else:
        train_both(out, training, refinement, seed)
    times, rows = times_per_action(out), []
    for number, variant in enumerate(VARIANTS):
        evaluate = partial(evaluate_variant, out, variant, run_seed=seed)
        table = evaluate_in_blocks(out / "episodes" / str(number), evaluate, episodes)
        rows.append(
            {
                "variant": variant,
                "episodes": len(table),
                "success_rate": float(table["success"].mean()),
                "peak_force": float(table["peak_force"].max()),
                "commanded_jerk": float(table["jerk_commanded_linear"].mean()),
                "max_commanded_violation": float(table["max_commanded_violation"].max()),
                "time_per_action_ms": times.get(variant, np.nan),
            }
        )
    write_table(out / "alongside", rows)
    return rows


def _refuse_other_training(out: Path, episodes: int, refinement: int, seed: int) -> None:
    """Raise an InputError if the policies in a folder were trained with another seed or number of episodes."""
    rows = read_table(out / "training.csv")
    # A table of an older version has no column `seed`.
    acting, seeds = (rows[name].tolist() if name in rows else [] for name in ("acting", "seed"))
    if acting != ["teacher"] * episodes + ["student"] * refinement or {*seeds} != {seed}:
        raise InputError(
            f"{out} has policies that were not trained with seed {seed}, {episodes} episodes of the teacher and "
            f"{refinement} of the student: give their --seed, --training and --refinement, or another --out"
        )


def main(arguments: list[str]) -> None:
    """Run the program with command-line arguments."""
    parser = Parser("alongside", "Train a student alongside a KGRL teacher, and refine it.", "--episodes 100")
    parser.add_out("runs/alongside")
    parser.add_argument("--episodes", type=int, default=100, help="held-out episodes of each variant (default: 100)")
    parser.add_argument("--training", type=int, default=60, help="episodes of the teacher (default: 60)")
    parser.add_argument("--refinement", type=int, default=30, help="episodes of the student (default: 30)")
    parser.add_argument("--seed", type=int, default=0, help="seed of training (default: 0)")
    parser.add_json()
    options = parser.parse_args(arguments)
    settings = {name: getattr(options, name) for name in ("episodes", "training", "refinement", "seed")}
    print_rows(options.out / "alongside.md", compare(options.out, **settings), as_json=options.json)


if __name__ == "__main__":
    run_program(main)
