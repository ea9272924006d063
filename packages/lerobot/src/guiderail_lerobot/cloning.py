"""Behavior cloning: supervised regression of a policy on a demonstrator's actions, without reinforcement learning."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces.utils import flatdim
from stable_baselines3.common.torch_layers import create_mlp

from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.checkpoint import entries_of, load_module
from guiderail.tools.learning.learner import Learner, register_learner
from guiderail.tools.learning.networks import export_layers
from guiderail_lerobot.config import BcConfig


@register_learner("bc")
class BcLearner(Learner):
    """Behavior cloning (Pomerleau, 1988): minimizes the mean squared error to the demonstrator's actions.

    The network is trained once, by Adam, after the last demonstration. The trained policy acts in all later episodes.
    """

    Config = BcConfig

    def __init__(
        self,
        config: BcConfig,
        env: gymnasium.Env,
        *,
        seed: int,
        symmetry: Symmetry | None = None,
        **unused: Any,
    ):
        """Construct the learner; `Learner` describes the arguments. Only the spaces of `env` are used."""
        self.config, self._space, self._seed = config, env.action_space, seed
        self._symmetry = symmetry if config.symmetry else None
        sizes = flatdim(env.observation_space), flatdim(env.action_space)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            self.network = torch.nn.Sequential(*create_mlp(*sizes, [*config.net_arch]))
        self.episodes = 0
        self._observations: list[np.ndarray] = []
        self._actions: list[np.ndarray] = []
        self._loss = np.nan

    def on_episode_start(self) -> None:
        """Count the episode."""
        self.episodes += 1

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the policy's action (A,) for an observation (n,), clipped to the action space."""
        space: Any = self._space
        with torch.no_grad():
            action = self.network(torch.as_tensor(observation, dtype=torch.float32)).numpy()
        return np.clip(action, space.low, space.high)

    def on_step(self, transition: Transition) -> None:
        """Store the transition, and its symmetric copies, if the episode is a demonstration."""
        if self.episodes > self.config.demonstration_episodes:
            return
        observation, action = (np.asarray(x, np.float32) for x in (transition.observation, transition.action))
        self._observations.append(observation)
        self._actions.append(action)
        if self._symmetry is not None:
            self._observations.extend(np.asarray(self._symmetry.observations @ observation, np.float32))
            self._actions.extend(np.asarray(self._symmetry.actions @ action, np.float32))

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Train after the last demonstration."""
        if self.episodes == self.config.demonstration_episodes and self._observations:
            self._train()
        return {}

    def _train(self) -> None:
        random = np.random.default_rng(self._seed)
        observations = torch.from_numpy(np.array(self._observations))
        actions = torch.from_numpy(np.array(self._actions))
        optimizer = torch.optim.Adam(self.network.parameters(), lr=self.config.learning_rate)
        for _ in range(self.config.gradient_steps):
            batch = random.integers(len(observations), size=self.config.batch_size)
            loss = torch.nn.functional.mse_loss(self.network(observations[batch]), actions[batch])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        self._loss = float(loss.detach())

    def metrics(self) -> Mapping[str, float]:
        """Return the loss of the last batch, once after training."""
        loss, self._loss = self._loss, np.nan
        return {"train/loss": loss} if np.isfinite(loss) else {}

    def policy(self, description: Mapping[str, Any]) -> Policy:
        """Return the cloned policy; the entries of `description` are added to the policy's description."""
        self._check_trained()
        return export_layers([*self.network], self._space, {"squash": "clip", **description})

    def _check_trained(self) -> None:
        if not self._is_trained():
            raise InputError(
                f"{self.config.algorithm} trains after {self.config.demonstration_episodes} demonstrations: give at "
                "least that many --episodes"
            )

    def _is_trained(self) -> bool:
        return self.episodes >= self.config.demonstration_episodes

    def has_diverged(self) -> bool:
        """Return True if a parameter is NaN or infinite."""
        return not all(bool(torch.isfinite(parameter).all()) for parameter in self.network.parameters())

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state that a resumed run continues from: arrays by name, and JSON-serializable values."""
        arrays = {f"network/{name}": value.numpy() for name, value in self.network.state_dict().items()}
        if self._observations:
            arrays |= {"observations": np.array(self._observations), "actions": np.array(self._actions)}
        return arrays, {"episodes": self.episodes}

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`; raise KeyError or RuntimeError if it does not fit this learner."""
        load_module(self.network, entries_of(arrays, "network"))
        self._observations = [*arrays.get("observations", ())]
        self._actions = [*arrays.get("actions", ())]
        self.episodes = values["episodes"]
