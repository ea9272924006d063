"""Learner with automatic interventions from one demonstration, after AutoSERL (research/experiments.md).

Y. Liu et al., "One Demonstration Is Enough for Real-World Robotic Reinforcement Learning", arXiv 2607.01651. There, the
robot is guided to the nearest point in a sliding window of the demonstration if this point lies ahead. If the robot is
stuck, the demonstration is replayed. There are no interventions after the policy has succeeded alone. Here, the
demonstration is the base motion, so its action is zero, and interventions have no replay buffer of their own.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import ReferenceTrajectory
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import Positive, register_learner
from guiderail.tools.learning.learner_config import OffPolicyConfig
from guiderail.tools.learning.off_policy import TqcLearner


@dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class AutoInterventionConfig(OffPolicyConfig):
    """Settings of TQC with automatic interventions."""

    algorithm: str = "auto_intervention"
    window: Positive = 25  # number of steps after the last progress in which the nearest step is searched
    stall_actions: Positive = 6  # number of actions without progress after which an intervention begins
    intervention_actions: Positive = 6  # duration of an intervention in actions
    until_successes: Positive = 3  # number of consecutive greedy successes after which interventions end


class SlidingWindow:
    """Progress of a robot along a demonstration: the nearest step in a window after the last progress.

    Args:
        reference: Reference of the demonstration; distances are in its standard deviations.
        window: Number of steps in the window after the last progress.
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
    """TQC learner in which the demonstration's action replaces the policy's if progress along the demonstration stalls.

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
        if config.num_envs or self._env.diagram.config.reference() is None:
            raise InputError("auto_intervention needs a task with demonstrations: leave out num_envs")
        self._reference = self._env.diagram.config.reference()
        self._start()

    def _start(self) -> None:
        self._progress = SlidingWindow(self._reference, self.config.window)
        self._stalled, self._remaining, self.interventions = 0, 0, 0
        self._is_intervening = False

    def on_episode_start(self) -> None:
        """Start an episode, with no progress along the demonstration."""
        super().on_episode_start()
        self._start()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action; during an intervention, the demonstration's action, which is zero."""
        action = super().act(observation)
        self._is_intervening = self._remaining > 0
        self._remaining = max(self._remaining - 1, 0)
        return np.zeros_like(action) if self._is_intervening else action

    def on_step(self, transition: Transition) -> None:
        """Learn from the transition, and begin an intervention if there is no progress."""
        super().on_step(transition)
        has_advanced = self._progress.advance(self._env.trace.measured[-1])
        self._stalled = 0 if has_advanced or self._is_intervening else self._stalled + 1
        may_intervene = not self.is_greedy and self.greedy_successes < self.config.until_successes
        if self._stalled >= self.config.stall_actions and may_intervene:
            self._stalled, self._remaining = 0, self.config.intervention_actions
            self.interventions += 1

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the column `auto_interventions`."""
        return {**super().on_episode_end(row), "auto_interventions": self.interventions}
