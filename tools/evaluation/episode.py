"""Types of an episode: policy, transition, callbacks, and the seeds of held-out episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from guiderail.models.common.arrays import as_whole
from guiderail.tools.spaces import from_tensors

PolicyFn = Callable[[np.ndarray], np.ndarray]

HELD_OUT_SEED = 1_000_000  # seed of the first held-out episode


@dataclass(frozen=True)
class Transition:
    """Action of an episode and its outcome.

    Attributes:
        observation: Observation before the action, of the shape of the observation space.
        action: Action, of the shape of the action space.
        reward: Reward.
        next_observation: Observation after the action, of the same shape.
        terminated: True if the task ended the episode.
        truncated: True if the episode ended for another reason.
        info: `info` of the environment's step.
        privileged: Privileged observation before the action, (m,); None if the environment provides none.
        next_privileged: Privileged observation after the action, (m,), or None.
    """

    observation: np.ndarray
    action: np.ndarray
    reward: float
    next_observation: np.ndarray
    terminated: bool
    truncated: bool
    info: Mapping[str, Any]
    privileged: np.ndarray | None = None
    next_privileged: np.ndarray | None = None

    @property
    def is_last(self) -> bool:
        """True if the episode is over."""
        return self.terminated or self.truncated


class Callback:
    """Base class of callbacks of an episode, such as a learner or a camera."""

    def on_episode_start(self) -> None:
        """Handle the start of an episode, after the reset."""

    def on_step(self, transition: Transition) -> None:
        """Handle the transition of an action."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any] | None:
        """Handle the end of an episode; return further columns of its row, if there are any."""


class EnvCallback(Callback):
    """Callback that reads data of the environment which a step does not return.

    Attributes:
        env: Environment.
        base: Environment without its wrappers.
    """

    def __init__(self, env: gymnasium.Env):
        self.env: Any = env
        self.base: Any = env.unwrapped


def check_seed(seed: object) -> int:
    """Return a seed as an int; raise an InputError if it is not a whole number from 0 to 2^31 - 1."""
    return as_whole(seed, "a seed", 0, 2**31 - 1)


def has_image(space: Any) -> bool:
    """Return True if the observations of a space are images, or contain an image."""
    if isinstance(space, gymnasium.spaces.Dict):
        return any(map(has_image, space.spaces.values())) or hasattr(space, "image_shape")
    if isinstance(space, gymnasium.spaces.Tuple):
        return any(map(has_image, space.spaces))
    return len(space.shape or ()) == 3 or hasattr(space, "image_shape")


def as_action(action: Any, env: gymnasium.Env) -> Any:
    """Return a policy's result as an action: tensors become arrays, and an action (1, A) becomes (A,) if that fits."""
    action, shape = from_tensors(action), env.action_space.shape
    if isinstance(action, np.ndarray) and shape == (1, *action.shape) and action.shape == (1,):
        return action[None]  # the row of an action (1, 1) was taken for a batch
    return action[0] if shape and getattr(action, "shape", None) == (1, *shape) else action
