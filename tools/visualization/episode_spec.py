"""An episode that is shown: whose actions, in which environment, under which held-out conditions."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium

from guiderail.models.policy import Policy
from guiderail.tools.environments import changed_environment
from guiderail.tools.evaluation.evaluate import HELD_OUT_SEED
from guiderail.tools.evaluation.rollout import PolicyFn, check_compatible, check_seed
from guiderail.tools.learning.run_folder import RunFolder


@dataclass(frozen=True)
class EpisodeSpec:
    """An episode that is shown, on held-out initial conditions."""

    task: str
    environment: Mapping[str, Any]  # its arguments
    policy: Callable[[gymnasium.Env], PolicyFn]  # what acts, for an environment
    acting: str  # whose actions they are, in a few words
    title: str  # what to say beside task and guidance
    run_seed: int = 0  # decides what is hidden and constant in a run
    seed: int = HELD_OUT_SEED  # of the episode
    run: Path | None = None  # the folder that it is from

    @classmethod
    def of_run(cls, run: Path, environment: Mapping[str, Any] | None = None, seed: int = HELD_OUT_SEED) -> EpisodeSpec:
        """The deterministic policy of a run, where it learned or with other arguments of the environment.

        Raises:
            InputError: if there is no trained run.
        """
        folder = RunFolder(run)
        config, policy = folder.config(), Policy.load(folder.path)
        return cls(
            task=config.task,
            environment=changed_environment(config.task, config.environment, environment or {}),
            policy=partial(check_compatible, policy, learned_in=config.environment),
            acting="after learning",
            title=config.learner.algorithm.upper(),
            run_seed=config.seed,
            seed=seed,
            run=folder.path,
        )

    def __post_init__(self) -> None:
        check_seed(self.seed)

    @property
    def heading(self) -> str:
        """One line that says what it is."""
        parts = (self.task, self.environment.get("guidance"), self.title, self.environment.get("station"))
        return " · ".join(str(part) for part in parts if part)


def outcome(row: Mapping[str, Any]) -> str:
    """How an episode ended, from its row."""
    return f"{row['termination'] or 'running'} after {row['steps']} control steps, peak force {row['peak_force']:.1f} N"
