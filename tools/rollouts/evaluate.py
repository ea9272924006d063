"""How good a policy is: deterministic, on conditions that training never drew, beside the demonstration alone."""

from pathlib import Path
from typing import Any

from guiderail.models.policy import Policy
from guiderail.tools.guidance import DEMONSTRATED
from guiderail.tools.learning.run_folder import RunFolder, converged_after
from guiderail.tools.rollouts.judging import HELD_OUT_SEED, held_out


def evaluate(run: Path, *, episodes: int = 100, seed: int = HELD_OUT_SEED) -> dict[str, Any]:
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
