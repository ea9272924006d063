"""Specification of an episode that is shown: policy, environment and held-out conditions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from guiderail.tools.evaluation.baselines import MakePolicy
from guiderail.tools.evaluation.metrics import COLLISION
from guiderail.tools.evaluation.rollout import HELD_OUT_SEED, check_seed
from guiderail.tools.evaluation.subject import find_subject


@dataclass(frozen=True)
class EpisodeSpec:
    """Held-out episode that is shown."""

    task: str  # name of the task
    environment: Mapping[str, Any]  # options of the environment
    policy: MakePolicy  # function that returns the policy for an environment
    acting: str  # label of the policy
    title: str  # text next to task and guidance in a heading
    run_seed: int = 0  # seed of the run, from which its hidden values are sampled
    seed: int = HELD_OUT_SEED  # seed of the episode
    run: Path | None = None  # folder of the run, or None

    @classmethod
    def of_policy(
        cls,
        policy: Path | str,
        environment: Mapping[str, Any] | None = None,
        seed: int = HELD_OUT_SEED,
        *,
        task: str | None = None,
        trust_policy: bool = False,
    ) -> EpisodeSpec:
        """Return an episode of a policy of any origin; a run's policy acts deterministically.

        Args:
            policy: Folder of a run, or `pretrained:NAME`; with `task`, any policy that `find_subject` takes.
            environment: Options of the environment that differ from the run's, or from the task's defaults.
            seed: Seed of the episode.
            task: Task of a policy without a run.
            trust_policy: True to read a policy file that can execute code.

        Raises:
            InputError: If there is no such policy, or `environment` has another guidance than the run.
        """
        subject = find_subject(policy, task, environment, trust_policy=trust_policy)
        config, folder = subject.config, subject.folder
        assert config is not None
        return cls(
            task=config.task,
            environment=subject.changed_environment(environment or {}),
            policy=subject.make_policy,
            acting=subject.name if folder is None else "after learning",
            title=subject.name if folder is None else config.learner.algorithm.upper(),
            run_seed=config.seed,
            seed=seed,
            run=folder.path if folder is not None and subject.is_stored else None,
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
