"""Asymmetric actor-critic for Stable-Baselines3: critics observe more than the actor (Pinto et al., 2018)."""

from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError


class FirstEntries(BaseFeaturesExtractor):
    """Features of an actor whose critics observe more: the first entries of their observation."""

    def __init__(self, observation_space: spaces.Box, number: int):
        """Construct the extractor of the first `number` entries of an observation (n,)."""
        super().__init__(observation_space, number)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map observations (batch, n) to features (batch, number)."""
        return observations[:, : self._features_dim]


def asymmetric_policy(policy: Any, num_observed: int) -> type:
    """Return a policy class of Stable-Baselines3 with an actor that observes the first `num_observed` entries only.

    The critics observe all entries (asymmetric actor-critic; Pinto et al., 2018).
    """

    class AsymmetricPolicy(policy):
        def make_actor(self, features_extractor: BaseFeaturesExtractor | None = None) -> Any:
            return super().make_actor(FirstEntries(self.observation_space, num_observed))

    return AsymmetricPolicy


def observe_privileged(
    env: gymnasium.Env, algorithm: Any, symmetry: Symmetry | None
) -> tuple[gymnasium.Env, type, int]:
    """Let an environment observe what is privileged, for the critics of an algorithm.

    Returns:
        The spaces that critics observe, the policy class whose actor observes those of `env` only, and the number of
        privileged entries.

    Raises:
        InputError: If the task declares no privileged observation, or no symmetry of it.
    """
    base: Any = env.unwrapped
    observed, hidden = env.observation_space, getattr(base, "privileged_space", None)
    if hidden is None or observed.shape is None or len(observed.shape) != 1:
        raise InputError(
            "a privileged critic needs a simulated task with privileged terms and a vector as its observation: leave "
            "the setting privileged_critic out"
        )
    if symmetry is not None and symmetry.privileged is None:
        raise InputError(
            "the task declares no symmetry of what a privileged critic observes: set symmetry=false, or leave "
            "privileged_critic out"
        )
    policy = getattr(algorithm, "policy_aliases", {}).get("MlpPolicy")
    if not hasattr(policy, "make_actor"):
        raise InputError(f"{algorithm.__name__} has no critic apart from its actor: leave privileged_critic out")
    base.observes_privileged = True
    critic = gymnasium.Env()
    critic.action_space = env.action_space
    infinite = np.full(observed.shape[0] + hidden.shape[0], np.inf, np.float32)
    critic.observation_space = spaces.Box(-infinite, infinite)
    return critic, asymmetric_policy(policy, observed.shape[0]), hidden.shape[0]


def with_privileged(
    observations: list[np.ndarray], privileged: np.ndarray | None, symmetry: Symmetry | None
) -> list[np.ndarray]:
    """Return an observation and its symmetric copies, (n,) each, with the privileged numbers of each appended."""
    assert privileged is not None  # the environment observes it for a privileged critic
    hidden = [privileged]
    if symmetry is not None and symmetry.privileged is not None:
        hidden.extend(symmetry.privileged @ privileged)
    return [np.concatenate(pair) for pair in zip(observations, hidden, strict=True)]
