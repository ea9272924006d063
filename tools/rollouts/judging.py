"""What every study by seeds does once a policy is there: judge it on held-out episodes, once, and put it in a row."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from rich.console import Console
from rich.progress import track

from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.run_folder import RunConfig, read_table, table_text
from guiderail.tools.rollouts.rollout import run_episode, standing_still
from guiderail.tools.tasks import make_environment

HELD_OUT_SEED = 1_000_000  # of the first held-out episode; training seeds are smaller

Act = Callable[[np.ndarray], np.ndarray]
Rows = Sequence[Mapping[str, Any]]


def held_out(
    config: RunConfig,
    act: Act | None,
    *,
    episodes: int,
    seed: int = HELD_OUT_SEED,
) -> list[dict[str, Any]]:
    """Rows of held-out episodes of a run's environment; None stands for an action of zero.

    Raises:
        InputError: for a number out of range.
    """
    if episodes < 1:
        raise InputError(f"an evaluation needs at least one episode, not {episodes}")
    if not 0 <= seed < 2**31:
        raise InputError(f"a seed is a whole number from 0 to {2**31 - 1}, not {seed}")
    env = make_environment(config.task, config.environment)
    try:
        policy = standing_still(env) if act is None else act
        env.reset(seed=config.seed)  # what is hidden and constant in the run is drawn as it was for training
        console = Console(stderr=True)
        words = "demonstration alone" if act is None else "held-out episodes"
        indices = track(range(episodes), words, console=console, transient=True, disable=not console.is_terminal)
        return [run_episode(env, policy, held_out_seed=seed + index, episode=index) for index in indices]
    finally:
        env.close()


def trials(env: gymnasium.Env, act: Act, number: int, seed: int = HELD_OUT_SEED) -> list[dict[str, Any]]:
    """Rows of held-out episodes, each of a run of its own: what is hidden in a run is drawn anew."""
    return [run_episode(env, act, held_out_seed=seed + index, episode=index, new_run=True) for index in range(number)]


def kept(file: Path, judge: Callable[[], list[dict[str, Any]]]) -> list[dict[str, Any]]:
    """The rows in a file; where there is none yet, those that come of judging, and then they are in it."""
    if file.exists():
        return read_table(file)
    rows = judge()
    if rows:
        write_atomically(file, table_text(rows).encode())
    return rows


def mean(rows: Rows, key: str) -> float | None:
    """Of a column; None where there are no rows."""
    return float(np.mean([row[key] for row in rows])) if rows else None


def worst(rows: Rows, key: str) -> float | None:
    """The largest of a column; None where there are no rows."""
    return float(np.max([row[key] for row in rows])) if rows else None


def total(rows: Rows, key: str) -> float | None:
    """The sum of a column; None where there are no rows."""
    return float(np.sum([row[key] for row in rows])) if rows else None
