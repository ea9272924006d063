"""Off-policy learners: any algorithm with the interface of Stable-Baselines3.

Stable-Baselines3 supplies the networks, the replay buffer and the training step. Acting, exploration and the training
schedule are here, so that a checkpoint can contain all state that a run depends on. To add an algorithm, derive a class
from `OffPolicyLearner`, set its attribute `algorithm` and register it by `register_learner`. The learner then uses the
algorithm's own training step. SAC and TQC have an equivalent faster one (`guiderail.tools.learning.fast_sb3`).
"""

import copy
import inspect
import json
from collections.abc import Mapping
from typing import Any, ClassVar, cast

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import TQC, CrossQ
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.logger import Logger
from torch.nn.utils import parameters_to_vector

from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.checkpoint import (
    CheckpointSelection,
    entries_of,
    load_off_policy,
    module_arrays,
    random_state,
    restore_modules,
    restore_random,
)
from guiderail.tools.learning.fast_sb3 import FastSac, FastTqc
from guiderail.tools.learning.learner import Learner, divergence_error, register_learner
from guiderail.tools.learning.learner_config import OffPolicyConfig, action_gamma
from guiderail.tools.learning.networks import (
    DemonstrationReplayBuffer,
    ImageFeatures,
    NormalizedReLU,
    SpacesOnlyEnv,
    add_dropout,
    export_policy,
    image_shape,
    observe_privileged,
    pack_observation,
    packed_space,
    share_encoder,
    with_privileged,
)

TD3_NOISE = 0.1  # standard deviation of TD3's exploration noise, relative to half the action range


class OffPolicyLearner(Learner):
    """Learner of an off-policy algorithm with the interface of Stable-Baselines3.

    Attributes:
        algorithm: Class of the algorithm; a subclass sets it.
        fast_algorithm: The same algorithm with a faster training step, or None; used on the CPU, without
            dropout and without convolutions.
        config: Settings of the learner.
        model: Instance of the algorithm.
        averaged: Exponential moving average of the actor; None if `actor_ema` is 0.
        transitions: Number of transitions so far.
        episodes: Number of episodes so far.
        random: Random generator of exploration.
        is_greedy: True in an episode that does not explore.
        greedy_successes: Number of consecutive successes in greedy episodes.
    """

    Config = OffPolicyConfig
    algorithm: ClassVar[type]
    fast_algorithm: ClassVar[type | None] = None

    def __init__(
        self,
        config: OffPolicyConfig,
        env: gymnasium.Env,
        *,
        action_repeat: int,
        seed: int,
        max_transitions: int,
        symmetry: Symmetry | None = None,
    ):
        """Construct the learner; `Learner` describes the arguments. Only the spaces of `env` are used.

        With a privileged critic, `env.observes_privileged` is set to True. Incompatible settings raise an InputError.
        """
        self.symmetry = symmetry if config.symmetry else None
        self._copies = 1 if self.symmetry is None else 1 + len(self.symmetry.actions)  # buffer entries per transition
        networks: dict[str, Any] = {"net_arch": list(config.net_arch), "optimizer_kwargs": {"fused": True}}
        if config.layer_norm:
            networks["activation_fn"] = NormalizedReLU
        if config.device == "cuda" and not torch.cuda.is_available():
            raise InputError("this machine has no CUDA device that PyTorch can use: leave --set device=cuda out")
        self._image_shape = image_shape(env.observation_space)
        is_encoded = self._image_shape is not None and config.image_encoder == "convolutional"
        if self._image_shape is not None:
            if config.privileged_critic:
                raise InputError("a privileged critic takes no images: leave the setting privileged_critic out")
            env = SpacesOnlyEnv(env, packed_space(cast(spaces.Box, env.observation_space)))
            networks["features_extractor_class"] = ImageFeatures
            networks["features_extractor_kwargs"] = {
                "shape": self._image_shape,
                "encoder": config.image_encoder,
            }
        self.config = config
        self.transitions = 0
        initial = load_off_policy(config.init_from) if config.init_from else None
        if initial is not None:
            max_transitions += initial[1]["transitions"]
        arguments = {
            "learning_rate": config.learning_rate,
            "buffer_size": min(config.buffer_size, max_transitions + 1),
            "batch_size": config.batch_size,
            "tau": config.tau,
            "gamma": action_gamma(config, action_repeat),
            "ent_coef": config.ent_coef if config.ent_coef.startswith("auto") else float(config.ent_coef),
            "policy_kwargs": networks,
            "seed": seed,
            "device": config.device,
        }
        is_fast = not config.dropout and not is_encoded and config.device == "cpu" and self.fast_algorithm is not None
        algorithm: Any = self.fast_algorithm if is_fast else self.algorithm
        accepted = inspect.signature(algorithm).parameters  # not every algorithm has an entropy coefficient
        policy: Any = "MlpPolicy"
        self._num_privileged = 0  # number of privileged entries at the end of a stored observation
        if config.privileged_critic:
            env, policy, self._num_privileged = observe_privileged(env, algorithm, self.symmetry)
        self.model = algorithm(policy, env, **{k: v for k, v in arguments.items() if k in accepted})
        self.model.replay_buffer = DemonstrationReplayBuffer(
            self._copies * self.model.buffer_size,
            self.model.observation_space,
            self.model.action_space,
            device=config.device,
            n_envs=self._copies,
        )
        if config.demonstration_fraction:
            self.model.replay_buffer.fraction = config.demonstration_fraction
        if is_encoded:
            share_encoder(self.model)
        if config.dropout:
            add_dropout(self.model.critic, config.dropout)
        self.model.policy.set_training_mode(False)
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.random = np.random.default_rng(seed)
        self.averaged = copy.deepcopy(self.model.actor) if config.actor_ema else None
        self.selection = CheckpointSelection(config.selection_window) if config.selection_window else None
        self.episodes = 0
        self.is_greedy = False
        self._has_transition = False  # True if the replay buffer has a transition of this episode
        self.greedy_successes = 0
        self._constant_action: np.ndarray | None = None  # the action of a constant episode
        self._extended_action: np.ndarray | None = None
        self._extended_steps = 0  # remaining repetitions of the extended action
        if initial is not None:
            self._start_from(*initial, seed)

    def _start_from(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any], seed: int) -> None:
        """Load the state of another run, except its random generators, greedy successes and checkpoint selection."""
        number, size = len(arrays["buffer/rewards"]), self.model.replay_buffer.buffer_size
        is_full = values["buffer"][1]
        if number != size if is_full else number >= size:
            raise InputError(
                f"the replay buffer of {self.config.init_from} {'is full of' if is_full else 'holds'} {number} "
                f"transitions: give --set buffer_size={number if is_full else number + 1}"
                f"{' or more' * (not is_full)}, not {size}"
            )
        generators = random_state()
        try:
            self.restore(arrays, values)
        except (LookupError, TypeError, ValueError, RuntimeError) as error:
            raise InputError(
                f"the run {self.config.init_from} has another algorithm, network, symmetry or other observations than "
                "this one: give init_from a run with the same learner and environment interface"
            ) from error
        restore_random(*generators)
        self.random, self.greedy_successes = np.random.default_rng(seed), 0
        if self.selection is not None:  # its actors succeeded in another environment
            self.selection = CheckpointSelection(self.config.selection_window)

    def is_learning(self) -> bool:
        """Return True once there are `learning_starts` transitions; until then actions are uniformly random."""
        return self.transitions >= self.config.learning_starts

    def on_episode_start(self) -> None:
        """Start an episode and select its exploration."""
        self.episodes += 1
        self._has_transition = False
        fraction = self.config.greedy_episode_fraction
        own_episode = self.episodes - self.config.demonstration_episodes  # at most 0 while a demonstrator acts
        self._constant_action = self._uniform() if 0 < own_episode <= self.config.constant_episodes else None
        is_due = int(self.episodes * fraction) > int((self.episodes - 1) * fraction)
        self.is_greedy = is_due and own_episode > 0 and self._constant_action is None and self.is_learning()
        self._extended_steps = 0
        if self.selection is not None and self.is_greedy:
            self.selection.begin(self.actor(), self.greedy_successes)

    def start_recorded(self, is_greedy: bool, actor: torch.nn.Module) -> None:
        """Start learning from an episode in which `actor` acted in another process."""
        self.episodes += 1
        self._has_transition, self.is_greedy = False, is_greedy
        if self.selection is not None and is_greedy:
            self.selection.begin(actor, self.greedy_successes)

    def on_step(self, transition: Transition) -> None:
        """Store a transition and train if it is due.

        A transition in which the simulation failed has no next observation and is not stored. The transition
        before it becomes the episode's last, as at a time limit.
        """
        if "simulation_failure" in transition.info:
            if self._has_transition:
                buffer = self.model.replay_buffer
                buffer.dones[buffer.newest] = buffer.timeouts[buffer.newest] = 1.0
            return
        self.store(transition)
        self.learn()
        self._has_transition = True

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """End an episode; it does not count for the checkpoint selection if a supervisor intervened."""
        if row.get("interventions"):
            self.exclude_episode()
        elif self.is_greedy:
            self.greedy_successes = self.greedy_successes + 1 if row["success"] else 0
            if self.selection is not None:
                self.selection.finish(bool(row["success"]))
        return {}

    def exclude_episode(self) -> None:
        """End an episode that does not count for the checkpoint selection, as if it had not been greedy."""
        if self.is_greedy and self.selection is not None:
            self.selection.exclude()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the action (A,) for an observation: greedy in a greedy episode, otherwise explored as configured."""
        if self._constant_action is not None:
            return self._constant_action
        if self._follows_base_motion():
            return np.zeros_like(self._uniform())
        if not self.is_learning():
            return self._uniform()
        if self._num_privileged:  # the actor ignores these entries
            observation = np.concatenate([observation, np.zeros(self._num_privileged, observation.dtype)])
        if self._image_shape is not None:
            observation = pack_observation(observation, self._image_shape)
        if not self.is_greedy:
            extended = self._temporally_extended()
            return self.explore(observation) if extended is None else extended
        with torch.no_grad():
            tensor = self.model.policy.obs_to_tensor(observation)[0]
            action = self.actor()._predict(tensor, deterministic=True)[0].cpu().numpy()
        space: Any = self.model.action_space
        is_unit = (space.low == -1).all() and (space.high == 1).all()  # unscaling would change the last bit
        return action if is_unit else self.model.policy.unscale_action(action)

    def _follows_base_motion(self) -> bool:
        """Return True if the next action is zero, so that the base motion has no residual (Policy Decorator).

        In the progressive exploration of Yuan et al. (2025), the probability that the policy acts grows linearly.
        """
        steps = self.config.base_motion_steps
        return not self.is_greedy and self.transitions < steps and self.random.random() * steps >= self.transitions

    def explore(self, observation: np.ndarray) -> np.ndarray:
        """Return a sampled action (A,) for an observation (n,): with noise if the policy is deterministic."""
        action, space = self.model.predict(observation, deterministic=False)[0], self.model.action_space
        if not isinstance(self.model, TD3):  # or DDPG, which Stable-Baselines3 derives from TD3
            return action
        deviation = TD3_NOISE * (space.high - space.low) / 2
        return np.clip(self.random.normal(action, deviation), space.low, space.high).astype(space.dtype)

    def _temporally_extended(self) -> np.ndarray | None:
        """Return a uniformly sampled action that is repeated for several transitions; None if no repetition is active.

        This is the εz-greedy exploration of Dabney, Ostrovski and Barreto (2021), with uniform durations. It leaves
        regions in which a policy stays, such as free space, and adds data of long motions in one direction.
        """
        if self._extended_steps == 0:
            is_over = 0 < self.config.ez_greedy_until <= self.greedy_successes
            if is_over or not self.config.ez_greedy or self.random.random() >= self.config.ez_greedy:
                return None
            self._extended_steps = int(self.random.integers(1, self.config.ez_greedy_longest + 1))
            self._extended_action = self._uniform()
        self._extended_steps -= 1
        return self._extended_action

    def _uniform(self) -> np.ndarray:
        space = self.model.action_space
        assert isinstance(space, spaces.Box)
        return self.random.uniform(space.low, space.high).astype(space.dtype)

    def store(self, transition: Transition) -> None:
        """Add a transition, and its symmetric copies, to the replay buffer.

        A time limit does not terminate the task: the episode's last transition is bootstrapped (partial-episode
        bootstrapping, Pardo et al., 2018), because the value of a state must not depend on the time left. The observed
        clock identifies the phase of a skill, not the time left.
        """
        infos = [{"TimeLimit.truncated": transition.truncated and not transition.terminated}]
        observation, next_observation = transition.observation, transition.next_observation
        action = self.model.policy.scale_action(np.asarray(transition.action)[None])[0]
        if self._image_shape is not None:
            observation = pack_observation(observation, self._image_shape)
            next_observation = pack_observation(next_observation, self._image_shape)
        observations, actions, next_observations = [observation], [action], [next_observation]
        if self.symmetry is not None:
            observations.extend(self.symmetry.observations @ observation)
            actions.extend(self.symmetry.actions @ action)
            next_observations.extend(self.symmetry.observations @ next_observation)
        if self._num_privileged:
            observations = with_privileged(observations, transition.privileged, self.symmetry)
            next_observations = with_privileged(next_observations, transition.next_privileged, self.symmetry)
        self.model.replay_buffer.add(
            np.array(observations),
            np.array(next_observations),
            np.array(actions),
            np.full(self._copies, transition.reward),
            np.full(self._copies, transition.is_last),
            infos * self._copies,
        )
        self.transitions += 1
        if self.config.demonstration_fraction and self.episodes <= self.config.demonstration_episodes:
            self.model.replay_buffer.num_demonstrated = self.model.replay_buffer.size()

    def learn(self) -> None:
        """Train after every `train_freq` transitions of the run; raise an InputError if learning diverged."""
        if not self.is_learning() or self.transitions % self.config.train_freq:
            return
        self.model.records_metrics = self.records_metrics
        self.model.train(self.config.gradient_steps, self.config.batch_size)
        self.model.policy.set_training_mode(False)  # acting uses no dropout and no batch statistics
        if self.has_diverged():
            raise divergence_error()
        if self.averaged is not None:
            weight = 1.0 - (1.0 - self.config.actor_ema) ** self.config.gradient_steps
            with torch.no_grad():
                for mean, value in zip(self.averaged.parameters(), self.model.actor.parameters(), strict=True):
                    mean.lerp_(value, weight)
                for mean, value in zip(self.averaged.buffers(), self.model.actor.buffers(), strict=True):
                    mean.copy_(value)

    def metrics(self) -> Mapping[str, float]:
        """Return the values that the last training recorded in the logger, such as `train/critic_loss`."""
        recorded = dict(self.model.logger.name_to_value)
        self.model.logger.dump()
        return recorded

    def actor(self) -> Any:
        """Return the network whose mean is the greedy action: the averaged actor, or without averaging the actor."""
        return self.model.actor if self.averaged is None else self.averaged

    def selected_actor(self) -> Any:
        """Return the actor to export: the selected one, or the last one if none is selected."""
        weights = None if self.selection is None else self.selection.result()
        if weights is None:
            return self.actor()
        selected = copy.deepcopy(self.actor())
        selected.load_state_dict(weights)
        return selected

    def policy(self, description: Mapping[str, Any]) -> Policy:
        """Return the policy of `selected_actor`; the entries of `description` are added to its description."""
        return export_policy(self.selected_actor(), description)

    def has_diverged(self) -> bool:
        """Return True if a parameter of the actor is NaN or infinite."""
        return not bool(torch.isfinite(parameters_to_vector(self.model.actor.parameters())).all())

    def _modules(self) -> dict[str, Any]:
        modules = {"policy": self.model.policy}
        return modules if self.averaged is None else modules | {"averaged": self.averaged}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        optimizers = {"actor": self.model.actor.optimizer, "critic": self.model.critic.optimizer}
        entropy = getattr(self.model, "ent_coef_optimizer", None)
        return optimizers if entropy is None else optimizers | {"entropy": entropy}

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state that a resumed run continues from: arrays by name, and JSON-serializable values."""
        arrays = module_arrays(self._modules(), self._optimizers())
        if self._log_ent_coef() is not None:
            arrays["log_ent_coef"] = self._log_ent_coef().detach().cpu().numpy()
        selection: dict[str, Any] = {}
        if self.selection is not None:
            actors, selection = self.selection.state()
            arrays |= {f"selection/{key}": value.cpu().numpy() for key, value in actors.items()}
        buffer = self.model.replay_buffer
        arrays |= {f"buffer/{k}": getattr(buffer, k)[: buffer.size()] for k in _BUFFER_ARRAYS}
        generators, states = random_state()
        return arrays | generators, states | {
            "transitions": self.transitions,
            "episodes": self.episodes,
            "greedy_successes": self.greedy_successes,
            "selection": selection,
            "updates": self.model._n_updates,
            "buffer": [buffer.pos, buffer.full],
            "exploration": self.random.bit_generator.state,
        } | ({"demonstrated": buffer.num_demonstrated} if self.config.demonstration_fraction else {})

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`; raise KeyError, ValueError or RuntimeError if it does not fit this learner."""
        tensors = {key: torch.from_numpy(np.array(value)) for key, value in arrays.items()}
        restore_modules(tensors, self._modules(), self._optimizers())
        if self._log_ent_coef() is not None:
            with torch.no_grad():
                self._log_ent_coef().copy_(tensors["log_ent_coef"])
        buffer = self.model.replay_buffer
        for key in _BUFFER_ARRAYS:
            stored = getattr(buffer, key)
            stored[: len(arrays[f"buffer/{key}"])] = arrays[f"buffer/{key}"]
        buffer.pos, buffer.full = values["buffer"]
        if self.config.demonstration_fraction:
            buffer.num_demonstrated = values["demonstrated"]
        self.transitions, self.model._n_updates = values["transitions"], values["updates"]
        self.episodes, self.greedy_successes = values["episodes"], values["greedy_successes"]
        if self.selection is not None:
            self.selection.restore(entries_of(tensors, "selection"), values["selection"])
        restore_random(arrays, values)
        self.random.bit_generator.state = values["exploration"]
        self._check_restored(arrays, values)

    def _check_restored(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Raise a ValueError if `state` differs from the restored state, as that of another learner does."""
        own_arrays, own_values = self.state()
        different = {
            key for key in {*own_arrays, *arrays} if _array_key(own_arrays.get(key)) != _array_key(arrays.get(key))
        }
        if different or json.dumps(own_values, sort_keys=True) != json.dumps(values, sort_keys=True):
            raise ValueError(f"this learner has another {', '.join(sorted(different)) or 'state'}")

    def _log_ent_coef(self) -> Any:
        """Return the logarithm of the entropy coefficient; None if it is not learned."""
        return getattr(self.model, "log_ent_coef", None)


_BUFFER_ARRAYS = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _array_key(array: np.ndarray | None) -> tuple[Any, ...]:
    """Return the comparison key of an array; 0-d arrays count as 1-d, as safetensors stores them."""
    return () if array is None else (np.atleast_1d(array).shape, array.dtype, array.tobytes())


@register_learner("sac")
class SacLearner(OffPolicyLearner):
    """Learner of soft actor-critic (SAC; Haarnoja et al., 2018)."""

    algorithm = SAC
    fast_algorithm = FastSac


@register_learner("tqc")
class TqcLearner(OffPolicyLearner):
    """Learner of truncated quantile critics (TQC; Kuznetsov et al., 2020)."""

    algorithm = TQC
    fast_algorithm = FastTqc


@register_learner("td3")
class Td3Learner(OffPolicyLearner):
    """Learner of twin delayed DDPG (TD3; Fujimoto, van Hoof and Meger, 2018), which explores with Gaussian noise."""

    algorithm = TD3


@register_learner("crossq")
class CrossQLearner(OffPolicyLearner):
    """Learner of CrossQ (Bhatt et al., 2024): batch normalization in place of target critics, so no `tau`."""

    algorithm = CrossQ
