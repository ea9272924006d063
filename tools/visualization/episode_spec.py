"""Specification of an episode that is shown: policy, environment and held-out conditions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from guiderail.models.policy import Policy
from guiderail.tools.environments import changed_environment
from guiderail.tools.evaluation.baselines import MakePolicy
from guiderail.tools.evaluation.evaluate import HELD_OUT_SEED, check_guidance_change
from guiderail.tools.evaluation.metrics import COLLISION
from guiderail.tools.evaluation.rollout import check_compatible, check_seed
from guiderail.tools.learning.run_folder import RunFolder


@dataclass(frozen=True)
class EpisodeSpec:
    """Held-out episode that is shown.

    Attributes:
        task: Name of the task.
        environment: Options of the environment.
        policy: Makes the policy for an environment.
        acting: Label of the policy.
        title: Text next to task and guidance in a heading.
        run_seed: Seed of the run, which decides what is hidden and constant in it.
        seed: Seed of the episode.
        run: Folder of the run, or None.
    """

    task: str
    environment: Mapping[str, Any]
    policy: MakePolicy
    acting: str
    title: str
    run_seed: int = 0
    seed: int = HELD_OUT_SEED
    run: Path | None = None

    @classmethod
    def of_run(cls, run: Path, environment: Mapping[str, Any] | None = None, seed: int = HELD_OUT_SEED) -> EpisodeSpec:
        """Return an episode of the deterministic policy of a run.

        Args:
            run: Folder of the run.
            environment: Options of the environment that differ from the run's.
            seed: Seed of the episode.

        Raises:
            InputError: If there is no trained run, or its actions mean something else with another guidance.
        """
        folder = RunFolder(run)
        config, policy = folder.config(), Policy.load(folder.path)
        changed = changed_environment(config.task, config.environment, environment or {})
        remark = check_guidance_change(config.environment, changed)
        return cls(
            task=config.task,
            environment=changed,
            policy=partial(check_compatible, policy, learned_in=config.environment),
            acting="after learning",
            title=config.learner.algorithm.upper() + (f", {remark}" if remark else ""),
            run_seed=config.seed,
            seed=seed,
            run=folder.path,
        )

    def __post_init__(self) -> None:
        check_seed(self.seed)

    @property
    def heading(self) -> str:
        """Heading of the episode in one line."""
        parts = (self.task, self.environment.get("guidance"), self.title, self.environment.get("station"))
        return " · ".join(str(part) for part in parts if part)


def outcome(row: Mapping[str, Any]) -> str:
    """Return how an episode ended, from its row."""
    reason = row["termination"] or "running"
    meaning = f" ({COLLISION})" if reason == "collision" else ""
    return f"{reason} after {row['steps']} control steps, peak force {row['peak_force']:.1f} N{meaning}"
