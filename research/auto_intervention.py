"""Learner with automatic interventions from one demonstration, after AutoSERL (docs/experiments.md).

Y. Liu et al., "One Demonstration Is Enough for Real-World Robotic Reinforcement Learning", arXiv 2607.01651, guide the
robot to the nearest point in a sliding window of the demonstration, if this point lies ahead, and replay the
demonstration where the robot is stuck, until the policy succeeds alone. Here the demonstration is the base motion, so
its action is zero. There is no separate buffer of interventions.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import ReferenceTrajectory
from guiderail.tools.evaluation.rollout import Transition
from guiderail.tools.learning.config import OffPolicyConfig
from guiderail.tools.learning.learner import Positive, register_learner
from guiderail.tools.learning.off_policy import TqcLearner


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class AutoInterventionConfig(OffPolicyConfig):
    """Settings of TQC with automatic interventions."""

    algorithm: str = "auto_intervention"
    window: Positive = 25  # number of steps ahead of the last progress among which the nearest step is searched
    stall_actions: Positive = 6  # actions without progress after which the demonstration takes over
    intervention_actions: Positive = 6  # actions that an intervention lasts
    until_successes: Positive = 3  # consecutive greedy successes after which there are no interventions


class SlidingWindow:
    """Progress of a robot along a demonstration: the nearest step in a window ahead of the last progress.

    Args:
        reference: Reference of the demonstration; distances are in its standard deviations.
        window: Number of steps ahead.
    """

    def __init__(self, reference: ReferenceTrajectory, window: int):
        self._reference, self._window, self.step = reference, window, 0

    def advance(self, pose: np.ndarray) -> bool:
        """Update the progress with a measured pose (O,); return True if it has advanced."""
        ahead = slice(self.step, self.step + self._window + 1)
        distances = (self._reference.means[ahead] - pose) / self._reference.standard_deviations[ahead]
        nearest = int(np.argmin((distances**2).sum(axis=1)))
        self.step += nearest
        return nearest > 0


@register_learner("auto_intervention")
class AutoInterventionLearner(TqcLearner):
    """Learner of TQC in which the demonstration's action takes over where progress along it stalls.

    Attributes:
        interventions: Number of interventions in this episode.
    """

    Config = AutoInterventionConfig
    config: AutoInterventionConfig

    def __init__(self, config: AutoInterventionConfig, env: gymnasium.Env, **arguments: Any):
        """Construct the learner; `Learner` describes the arguments.

        Raises:
            InputError: If the task has no demonstrations, or the learner acts in another process.
        """
        super().__init__(config, env, **arguments)
        self._env: Any = env.unwrapped
        if config.pipelined or config.num_envs or "demonstrations" not in self._env.task.declaration.provides():
            raise InputError("auto_intervention needs a task with demonstrations: leave out pipelined and num_envs")
        self._reference = self._env.task.declaration.reference()
        self._start()

    def _start(self) -> None:
        self._progress = SlidingWindow(self._reference, self.config.window)
        self._stalled, self._remaining, self.interventions = 0, 0, 0
        self._is_intervening = False

    def on_episode_start(self) -> None:
        """Start an episode without progress."""
        super().on_episode_start()
        self._start()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action, or that of the demonstration, zero, during an intervention."""
        action = super().act(observation)
        self._is_intervening = self._remaining > 0
        self._remaining = max(self._remaining - 1, 0)
        return np.zeros_like(action) if self._is_intervening else action

    def on_step(self, transition: Transition) -> None:
        """Learn from the transition, and begin an intervention if there is no progress."""
        super().on_step(transition)
        has_advanced = self._progress.advance(self._env.trace.measured[-1])
        self._stalled = 0 if has_advanced or self._is_intervening else self._stalled + 1
        is_over = self.is_greedy or self.greedy_successes >= self.config.until_successes
        if self._stalled >= self.config.stall_actions and not is_over:
            self._stalled, self._remaining = 0, self.config.intervention_actions
            self.interventions += 1

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the column `auto_interventions`."""
        return {**super().on_episode_end(row), "auto_interventions": self.interventions}
