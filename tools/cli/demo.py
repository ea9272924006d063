"""Run of `guiderail demo`: training in about a minute, evaluation, and the contents of the run folder."""

import shlex
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pandas as pd

from guiderail.diagrams.tasks.narrow_passage import avoids_obstacle_from
from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import zero_policy
from guiderail.tools.evaluation.episode import HELD_OUT_SEED, check_seed
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.rollout import Paths, rollout
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.learner_config import check_episodes
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import train
from guiderail.tools.progress import PrintableConsole
from guiderail.tools.visualization.figures import color, draw_passage, new_figure, save_figure

HELD_OUT = 10  # number of held-out episodes
PRESET = "tqc_cheap_correlated"
MARK = ".demo"  # file that marks the folder of a demo: no other folder is removed


def run_demo(out: Path, *, episodes: int, seed: int) -> None:
    """Train sKGRL with TQC to avoid an obstacle in the narrow passage, evaluate it and print the result.

    An existing demo in the folder `out` is replaced.
    """
    check_episodes(episodes)
    check_seed(seed)
    _clear(out)
    started = time.perf_counter()
    console = PrintableConsole(soft_wrap=True, highlight=False)
    console.print(
        "A robot has nine demonstrations of the way through a narrow passage. Then an obstacle and a forbidden zone\n"
        "were added. It now learns by trial and error to avoid the obstacle, and never enters the forbidden zone."
    )
    write_atomically(out / MARK, b"")
    learner = {"num_envs": 1}  # simulates in a second process while this one learns
    run = train("NarrowPassage", "skgrl", out=out, preset=PRESET, settings=learner, episodes=episodes, seed=seed)
    before, after = _evaluate(out)
    picture = _draw(out, before, after)
    rows = RunFolder(out).episodes()
    avoided = avoids_obstacle_from(rows)
    violations = _count_violations(rows)
    console.print(f"\nResult after {time.perf_counter() - started:.0f} s:")
    for line in (
        f"{rows['success'].sum()} of {len(rows)} training episodes reached the goal, "
        f"{violations} violated the constraint, {(rows['collisions'] > 0).sum()} touched a wall.",
        "While exploring, it did not yet avoid the obstacle in five episodes in a row: try more --episodes."
        if avoided is None
        else f"From episode {avoided} on it avoided the obstacle while still exploring.",
        f"The policy on {HELD_OUT} held-out starts: {_outcome(after)}.",
        f"The demonstrations alone on the same starts: {_outcome(before)}.",
    ):
        console.print(f"  · {line}")
    console.print("\nFiles:")
    for path, content in (
        (picture, "paths before and after learning, and the return over the episodes"),
        (run.pictures["replay"], "animation in three dimensions: open it in a browser"),
        (out / "episodes.csv", "every training episode: return, success, violations, forces, jerk"),
        (out / "learning_curve.png", "plots of these values"),
    ):
        console.print(f"  {path}\n      {content}")
    name = _command_name()
    console.print(f"\nNext: {shlex.quote(name)} evaluate {shlex.quote(str(out))}, {name} list, {name} train --help")


def _count_violations(rows: pd.DataFrame) -> int:
    """Return the number of episodes with a command or a pose outside the constraints; NaN counts as outside."""
    largest = rows[["max_commanded_violation", "max_measured_violation"]].max(axis=1, skipna=False)
    return int((~(largest <= TOLERANCE)).sum())


def _command_name() -> str:
    """Return the name of this command, or its path if the shell does not find it by its name."""
    path = Path(sys.argv[0])
    return str(path) if path.name == "guiderail" and shutil.which("guiderail") is None else "guiderail"


def _clear(out: Path) -> None:
    """Remove an earlier demo; raise an InputError if the folder contains anything else."""
    if (out / MARK).is_file() and not out.is_symlink():
        shutil.rmtree(out)
    RunFolder(out).refuse_existing()


def _evaluate(out: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Run held-out episodes of the demonstration alone and of the policy; return their rows, with paths."""
    config = RunFolder(out).config()
    env = make_environment(config.task, config.environment)
    env.reset(seed=config.seed)
    tables = [
        pd.DataFrame(
            [rollout(env, act, Paths(env), index=i, seed=HELD_OUT_SEED + i, held_out=True) for i in range(HELD_OUT)]
        )
        for act in (zero_policy(env), Policy.load(out))
    ]
    env.close()
    return tables[0], tables[1]


def _outcome(rows: pd.DataFrame) -> str:
    """Return the success rate and the mean return of held-out episodes as text."""
    success, total, cost = (rows[name].mean() for name in ("success", "return", "reward_obstacle_cost"))
    return f"{success:.0%} reach the goal, return {total:.1f}, {cost:+.1f} reward from the obstacle"


def _draw(out: Path, before: pd.DataFrame, after: pd.DataFrame) -> Path:
    """Draw the paths before and after learning, and the return over the episodes; return the path of the picture."""
    figure, ((plane, curve),) = new_figure(1, 2, (11, 5.2))
    draw_passage(plane, named=True)
    for index, path in enumerate(after["measured"]):
        plane.plot(*path.T, color=color("skgrl"), linewidth=1.2, label="" if index else "after learning")
    plane.plot(*before["measured"][0].T, color="black", linewidth=1.2, label="before learning")
    plane.legend(frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=8)
    rows = RunFolder(out).episodes()
    episodes = np.arange(1, len(rows) + 1)
    curve.plot(episodes, rows["return"], "o-", markersize=3, color=color("skgrl"), label="return")
    curve.plot(episodes, rows["reward_obstacle_cost"], color="saddlebrown", label="reward from the obstacle")
    curve.axhline(before["return"].mean(), color="black", linewidth=0.8, linestyle=":", label="return before learning")
    curve.set(xlabel="training episode")
    curve.legend(frameon=False, fontsize=8)
    return save_figure(figure, out / "picture.png")
