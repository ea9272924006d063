"""Learner PPO of Stable-Baselines3, a method of the benchmark, trained by the library's own step.

An update uses only the transitions since the last update. A checkpoint stores the transitions collected for the next
update.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.logger import Logger
from torch.nn.utils import parameters_to_vector

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.checkpoint import module_arrays, random_state, restore_modules, restore_random
from guiderail.tools.learning.learner import Learner, divergence_error, register_learner
from guiderail.tools.learning.learner_config import action_gamma
from guiderail.tools.learning.networks import export_layers
from guiderail_studies.ppo_config import PpoConfig

_BUFFER_ARRAYS = ("observations", "actions", "rewards", "episode_starts", "values", "log_probs")


@register_learner("ppo")
class PpoLearner(Learner):
    """Learner of proximal policy optimization (PPO; Schulman et al., 2017).

    With a `cost_limit`, the reward r of an action with the cost c, `info["cost"]`, becomes (r − λ c) / (1 + λ). Before
    each training, the Lagrange multiplier λ ≥ 0 changes by `multiplier_rate` times the difference of the mean cost of
    the episodes since the last training and the limit. This is PPO-Lagrangian (Ray, Achiam and Amodei, 2019) with one
    critic of the penalized reward, as in reward constrained policy optimization (Tessler, Mankowitz and Mannor, 2019).

    Attributes:
        model: PPO of Stable-Baselines3.
        transitions: Number of transitions so far.
        multiplier: Lagrange multiplier of the cost.
    """

    Config = PpoConfig

    def __init__(self, config: PpoConfig, env: gymnasium.Env, *, action_repeat: int, seed: int, **unused: Any):
        """Construct the learner; `Learner` describes the arguments. Only the spaces of `env` are used."""
        self.config = config
        self.model: Any = PPO(
            "MlpPolicy",
            env,
            learning_rate=config.learning_rate,
            n_steps=config.n_steps,
            batch_size=min(config.batch_size, config.n_steps),
            gamma=action_gamma(config, action_repeat),
            policy_kwargs={"net_arch": list(config.net_arch)},
            seed=seed,
            device="cpu",
            n_epochs=config.n_epochs,
            ent_coef=config.ent_coef,
        )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.model.policy.set_training_mode(False)
        self.transitions, self.multiplier = 0, 0.0
        self._is_start = True
        self._cost, self._ended_costs = 0.0, list[float]()  # of this episode, and of those since the last training
        self._sampled: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None  # action, value, log. probability

    def on_episode_start(self) -> None:
        """Start an episode, so that no advantage is estimated across its start."""
        self._is_start, self._cost = True, 0.0

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """End an episode, whose cost counts for the multiplier."""
        self._ended_costs.append(self._cost)
        return {}

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return a sampled action (A,) for an observation (n,), clipped to the action space."""
        policy, space = self.model.policy, self.model.action_space
        with torch.no_grad():
            self._sampled = policy(policy.obs_to_tensor(observation)[0])
        return np.clip(self._sampled[0][0].numpy(), space.low, space.high)

    def on_step(self, transition: Transition) -> None:
        """Store a transition and train if the buffer is full.

        A transition is not stored if the simulation failed in it, or if its action is not from `act`, as a supervisor's
        correction. The previous transition is then treated as the episode's last, as at a time limit.
        """
        buffer = self.model.rollout_buffer
        if "simulation_failure" in transition.info or self._sampled is None:
            if not self._is_start and buffer.pos:
                buffer.rewards[buffer.pos - 1] += self.model.gamma * float(self._value(transition.observation))
            self._is_start, self._sampled = True, None
            return
        action, value, log_prob = self._sampled
        reward = self._penalized(transition)
        if transition.truncated and not transition.terminated:  # bootstrap, because the task did not end
            reward += self.model.gamma * float(self._value(transition.next_observation))
        starts = np.array([self._is_start])
        buffer.add(transition.observation[None], action.numpy(), np.array([reward]), starts, value, log_prob)
        self._sampled, self._is_start = None, transition.is_last
        self.transitions += 1
        if buffer.full:
            last_value = self._value(transition.next_observation)
            buffer.compute_returns_and_advantage(last_value, np.array([transition.is_last]))
            self._update_multiplier()
            self.model.train()
            self.model.policy.set_training_mode(False)
            buffer.reset()
            if self.has_diverged():
                raise divergence_error()

    def _penalized(self, transition: Transition) -> float:
        if self.config.cost_limit is None:
            return transition.reward
        if "cost" not in transition.info:
            raise InputError("the environment's info has no cost: leave --set cost_limit out, or add the cost")
        cost = float(transition.info["cost"])
        self._cost += cost
        return (transition.reward - self.multiplier * cost) / (1.0 + self.multiplier)

    def _update_multiplier(self) -> None:
        if self.config.cost_limit is not None and self._ended_costs:
            excess = float(np.mean(self._ended_costs)) - self.config.cost_limit
            self.multiplier = max(0.0, self.multiplier + self.config.multiplier_rate * excess)
        self._ended_costs = []

    def _value(self, observation: np.ndarray) -> torch.Tensor:
        policy = self.model.policy
        with torch.no_grad():
            return policy.predict_values(policy.obs_to_tensor(observation)[0]).flatten()

    def metrics(self) -> Mapping[str, float]:
        """Return the values that the last training recorded in the logger of Stable-Baselines3."""
        recorded = dict(self.model.logger.name_to_value)
        self.model.logger.dump()
        return recorded if self.config.cost_limit is None else recorded | {"train/multiplier": self.multiplier}

    def policy(self, description: Mapping[str, Any]) -> Policy:
        """Return the policy of the most probable action; the entries of `description` are added to its description."""
        network = self.model.policy
        layers = [*network.mlp_extractor.policy_net, network.action_net]
        return export_layers(layers, network.action_space, {"squash": "clip", **description})

    def has_diverged(self) -> bool:
        """Return True if a parameter is NaN or infinite."""
        return not bool(torch.isfinite(parameters_to_vector(self.model.policy.parameters())).all())

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state that a resumed run continues from: arrays by name, and JSON-serializable values."""
        policy, buffer = self.model.policy, self.model.rollout_buffer
        arrays = module_arrays({"policy": policy}, {"policy": policy.optimizer})
        arrays |= {f"buffer/{name}": getattr(buffer, name)[: buffer.pos] for name in _BUFFER_ARRAYS if buffer.pos}
        generators, states = random_state()
        values = {"transitions": self.transitions, "updates": self.model._n_updates, "buffer": buffer.pos}
        if self.config.cost_limit is not None:
            values |= {"multiplier": self.multiplier, "costs": self._ended_costs}
        return arrays | generators, values | states

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`; raise KeyError, ValueError or RuntimeError if it does not fit this learner."""
        tensors = {key: torch.from_numpy(np.array(value)) for key, value in arrays.items()}
        policy, buffer = self.model.policy, self.model.rollout_buffer
        restore_modules(tensors, {"policy": policy}, {"policy": policy.optimizer})
        buffer.reset()
        buffer.pos = values["buffer"]
        for name in _BUFFER_ARRAYS if buffer.pos else ():
            getattr(buffer, name)[: buffer.pos] = arrays[f"buffer/{name}"]
        self.transitions, self.model._n_updates = values["transitions"], values["updates"]
        if self.config.cost_limit is not None:
            self.multiplier, self._ended_costs = values["multiplier"], list(values["costs"])
        restore_random(arrays, values)
