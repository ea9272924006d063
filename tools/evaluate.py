"""How good a policy is: deterministic, on conditions that training never drew, beside the demonstration alone."""

from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import track

from guiderail.models.errors import InputError
from guiderail.tools.episodes import DEMONSTRATED, make_environment, run_episode, standing_still
from guiderail.tools.policy import Policy
from guiderail.tools.run_folder import RunConfig, RunFolder, converged_after


def evaluate(run: Path, *, episodes: int = 100, seed: int = 1_000_000) -> dict[str, Any]:
    """Judges the exported policy of a run.

    Args:
        run: the run's folder.
        episodes: how many, each with held-out initial conditions and offsets.
        seed: of the first; episode i is drawn from seed + i, for the policy and for the demonstration alike.

    Returns:
        `success_rate`, `episodes`, `worst_violation` (commanded; negative is slack), `worst_measured_violation`,
        `peak_force` [N], `collisions`, `mean_return`, `mean_steps`, `demonstration_success_rate` (the same episodes
        before anything was learned; None where guidance has no demonstration), and `converged_after`, the training
        episode after which ten in a row succeeded.

    Raises:
        InputError: if there is no trained run, or a number is out of range.
    """
    folder = RunFolder(run)
    config, policy = folder.config(), Policy.load(folder.path)
    rows = held_out(config, policy, episodes=episodes, seed=seed)
    demonstrated = None
    if config.environment.get("guidance") in DEMONSTRATED:
        alone = held_out(config, None, episodes=episodes, seed=seed)
        demonstrated = sum(row["success"] for row in alone) / episodes
    return {
        "success_rate": sum(row["success"] for row in rows) / episodes,
        "demonstration_success_rate": demonstrated,
        "episodes": episodes,
        "worst_violation": max(row["worst_violation"] for row in rows),
        "worst_measured_violation": max(row["worst_measured_violation"] for row in rows),
        "peak_force": max(row["peak_force"] for row in rows),
        "collisions": sum(row["collisions"] for row in rows),
        "mean_return": sum(row["return"] for row in rows) / episodes,
        "mean_steps": sum(row["steps"] for row in rows) / episodes,
        "converged_after": converged_after(bool(row["success"]) for row in folder.episodes()),
        "trained_episodes": len(folder.episodes()),
        "seed": seed,
    }


def held_out(config: RunConfig, policy: Policy | None, *, episodes: int, seed: int) -> list[dict[str, Any]]:
    """Rows of held-out episodes of a run's environment under a policy; None stands for an action of zero."""
    if episodes < 1:
        raise InputError(f"an evaluation needs at least one episode, not {episodes}")
    if not 0 <= seed < 2**31:
        raise InputError(f"a seed is a whole number from 0 to {2**31 - 1}, not {seed}")
    env = make_environment(config.task, config.environment)
    try:
        act = standing_still(env) if policy is None else policy
        env.reset(seed=config.seed)  # what is hidden and constant in the run is drawn as it was for training
        console = Console(stderr=True)
        words = "demonstration alone" if policy is None else "held-out episodes"
        indices = track(range(episodes), words, console=console, transient=True, disable=not console.is_terminal)
        return [run_episode(env, act, held_out_seed=seed + index, episode=index) for index in indices]
    finally:
        env.close()
