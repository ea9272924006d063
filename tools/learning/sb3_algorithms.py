"""Off-policy learners of further algorithms of Stable-Baselines3 and sb3-contrib, trained by their own steps."""

from typing import Any

import numpy as np
import torch
from sb3_contrib import CrossQ
from stable_baselines3 import TD3

from guiderail.tools.learning.config import CrossQConfig, Td3Config
from guiderail.tools.learning.off_policy import OffPolicyLearner


class Td3Learner(OffPolicyLearner):
    """Learner of twin delayed DDPG (TD3; Fujimoto, van Hoof and Meger, 2018), which explores with normal noise."""

    Config = Td3Config
    algorithm = TD3
    config: Td3Config

    def algorithm_arguments(self, config: Any) -> dict[str, Any]:
        """Return the settings of the delayed actor and of the target actions."""
        names = ("policy_delay", "target_policy_noise", "target_noise_clip")
        return {name: getattr(config, name) for name in names}

    def explore(self, observation: np.ndarray) -> np.ndarray:
        """Return the action plus noise, clipped to the action space."""
        action, space = super().explore(observation), self.model.action_space
        deviation = self.config.exploration_noise * (space.high - space.low) / 2
        return np.clip(self.random.normal(action, deviation), space.low, space.high).astype(space.dtype)

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        return {"actor": self.model.actor.optimizer, "critic": self.model.critic.optimizer}


class CrossQLearner(OffPolicyLearner):
    """Learner of CrossQ (Bhatt et al., 2024): batch normalization in place of target critics."""

    Config = CrossQConfig
    algorithm = CrossQ
    config: CrossQConfig

    def algorithm_arguments(self, config: Any) -> dict[str, Any]:
        """Return the settings of the delayed actor."""
        return {"policy_delay": config.policy_delay}
