"""What training needs of a learner, and the learners by name."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import Registry
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.rollout import Callback


class Learner(Callback, ABC):
    """Acts in training episodes, and learns from what it sees of them as their observer."""

    @abstractmethod
    def act(self, observation: np.ndarray) -> np.ndarray:
        """The action for an observation, in the units of the action space."""

    def submit_episode(self) -> None:
        """Called between episodes, when the last one's checkpoint, if it has one, is written."""

    def finish(self) -> None:
        """Called after the last episode: everything is learned when it returns."""

    def close(self) -> None:
        """Ends what it began, such as other processes, whatever they do."""

    @abstractmethod
    def policy(self, description: Mapping[str, Any]) -> Policy:
        """What a run leaves, as NumPy evaluates it; `description` is what else is known of it."""

    @abstractmethod
    def has_diverged(self) -> bool:
        """Whether anything that it learned is not a finite number."""

    @abstractmethod
    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Between episodes: everything that the rest of a run depends on, as arrays by name and as what JSON holds."""

    @abstractmethod
    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Becomes what it was when `state` was called. KeyError, ValueError or RuntimeError where it does not fit."""


# An entry is called with a preset and an environment, and by name with `action_repeat`, `seed`, `decisions` and `symmetry`.
LEARNERS: Registry[Callable[..., Learner]] = Registry("algorithm", entry_points="guiderail.learners")
register_learner = LEARNERS.register
learner_names = LEARNERS.names


def diverged() -> InputError:
    """What a person is told of a learner that `has_diverged`."""
    return InputError("learning diverged: train anew with a smaller --set learning_rate=...")


def arguments_of(config: Any, task: Any) -> dict[str, Any]:
    """What a learner is called with by name: `action_repeat`, `seed`, `decisions` (the most that the run can take), `symmetry`.

    What a person pushed, demonstrations no longer have on their other sides: then there is no symmetry to learn from.

    Args:
        config: the run's `RunConfig`.
        task: its task.
    """
    decisions = config.episodes * -(-task.num_steps // config.action_repeat)
    symmetry = task.near_symmetry if config.learner.symmetry == "near" else task.symmetry
    pushed = config.with_person or bool(config.environment.get("via_points"))
    return {
        "action_repeat": config.action_repeat,
        "seed": config.seed,
        "decisions": decisions,
        "symmetry": None if pushed else symmetry,
    }


# These import PyTorch, which takes seconds, when one is made.
@register_learner("sac")
def _sac(*given: Any, **named: Any) -> Learner:
    from guiderail.tools.learning.off_policy import SacLearner

    return SacLearner(*given, **named)


@register_learner("tqc")
def _tqc(*given: Any, **named: Any) -> Learner:
    from guiderail.tools.learning.off_policy import TqcLearner

    return TqcLearner(*given, **named)
