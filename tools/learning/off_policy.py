"""Off-policy learners: any algorithm with Stable-Baselines3's interface, told when to act, remember and learn.

Only the networks, the replay buffer and the gradient step are Stable-Baselines3's. Acting and deciding when to train
are here, so that everything that a run depends on has a name and can be written to a checkpoint. An algorithm more is
one file: a subclass of `OffPolicyLearner` that names it, registered by `register_learner` or by an entry point of the
group `guiderail.learners`.
"""

import copy
import inspect
import json
import random
from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch.nn.utils import parameters_to_vector

from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy
from guiderail.tools.evaluation.rollout import Transition
from guiderail.tools.learning.checkpoint import CheckpointSelection
from guiderail.tools.learning.config import LearnerConfig, action_gamma
from guiderail.tools.learning.fast_sb3.ensemble import EnsembleSac, EnsembleTqc
from guiderail.tools.learning.learner import Learner, diverged

IMAGE_POOL = 5  # pixels; 110×144×3 becomes 22×28×3


class PooledImage(BaseFeaturesExtractor):
    """An image as one vector (thesis, 4.4.1), after actor_ema squares of pixels.

    Flattened as it is, 110×144×3 makes a first layer of twelve million weights a network, and a gradient step of most
    of a second on one core; what the task needs to see is larger than a pixel.
    """

    def __init__(self, observation_space: spaces.Box, pool: int):
        """
        Args:
            observation_space: channels first.
            pool: the side of the squares, in pixels.
        """
        channels, height, width = observation_space.shape
        super().__init__(observation_space, channels * (height // pool) * (width // pool))
        self.pool = pool

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """(batch, channels, height, width) in [0, 1] to (batch, features)."""
        return torch.nn.functional.avg_pool2d(observations, self.pool).flatten(1)


class NormalizedReLU(torch.nn.Module):
    """A layer's outputs, normalized without learned parameters, and rectified."""

    kind = "normalized_relu"

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """(…, units) to the same shape."""
        return torch.relu(torch.nn.functional.layer_norm(features, features.shape[-1:]))


def policy_of(actor: Any, description: Mapping[str, Any]) -> Policy:
    """The policy of a Stable-Baselines3 actor: linear layers, what rectifies between them, and a tanh at the end.

    Raises:
        InputError: for an actor with other layers.
    """
    layers = [*actor.latent_pi, actor.mu] if hasattr(actor, "latent_pi") else [*actor.mu][:-1]
    linear, between = layers[::2], layers[1::2]
    activations = {"relu" if isinstance(layer, torch.nn.ReLU) else getattr(layer, "kind", None) for layer in between}
    if not all(isinstance(layer, torch.nn.Linear) for layer in linear) or len(activations) != 1 or None in activations:
        raise InputError(
            f"an actor of {', '.join(type(layer).__name__ for layer in layers)} can't be exported: use linear layers "
            "with one kind of rectifier between them"
        )
    space = actor.action_space
    return Policy(
        [(m.weight.detach().numpy().copy(), m.bias.detach().numpy().copy()) for m in linear],
        {
            "format": FORMAT,
            "pool": getattr(actor.features_extractor, "pool", 1),
            "action_low": space.low.tolist(),
            "action_high": space.high.tolist(),
            "activation": activations.pop(),
            "squash": "tanh",
            **description,
        },
    )


class OffPolicyLearner(Learner):
    """An off-policy algorithm of Stable-Baselines3 that is told when to act, to remember and to learn.

    Attributes:
        algorithm: the class; a subclass names it.
    """

    algorithm: type

    def __init__(
        self,
        preset: LearnerConfig,
        env: gymnasium.Env,
        *,
        action_repeat: int,
        seed: int,
        decisions: int,
        symmetry: Symmetry | None = None,
    ):
        """
        Args:
            preset: how to learn.
            env: for its spaces only.
            hold: control steps that an action lasts.
            seed: of the networks, and of everything random in training.
            decisions: the most that this run can take, so that the replay buffer asks for no more memory than it uses.
            symmetry: of the task, where it has one; used if the preset says so.
        """
        self.symmetry = symmetry if preset.symmetry else None
        self._sides = 1 if self.symmetry is None else 1 + len(self.symmetry.actions)
        networks: dict[str, Any] = {"net_arch": list(preset.net_arch), "optimizer_kwargs": {"fused": True}}
        if preset.layer_norm:
            networks["activation_fn"] = NormalizedReLU
        if is_image_space(env.observation_space):
            networks |= {"features_extractor_class": PooledImage, "features_extractor_kwargs": {"pool": IMAGE_POOL}}
        self.preset = preset
        self.decisions = 0
        arguments = {
            "learning_rate": preset.learning_rate,
            "buffer_size": min(preset.buffer_size, decisions + 1),
            "batch_size": preset.batch_size,
            "tau": preset.tau,
            "gamma": action_gamma(preset, action_repeat),
            "ent_coef": preset.ent_coef if preset.ent_coef.startswith("auto") else float(preset.ent_coef),
            "policy_kwargs": networks,
            "seed": seed,
            "device": "cpu",
        }
        taken = inspect.signature(self.algorithm).parameters  # not every algorithm has an entropy
        self.model = self.algorithm("MlpPolicy", env, **{k: v for k, v in arguments.items() if k in taken})
        self.model.replay_buffer = NStepReplayBuffer(
            self._sides * self.model.buffer_size,
            self.model.observation_space,
            self.model.action_space,
            device="cpu",
            n_envs=self._sides,
            n_steps=preset.n_steps,
            gamma=self.model.gamma,
        )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.random = np.random.default_rng(seed)
        self.averaged = copy.deepcopy(self.model.actor) if preset.actor_ema else None
        self.selection = CheckpointSelection(preset.selection_window) if preset.selection_window else None
        self.episodes = 0
        self._greedy = False  # whether this episode does not explore
        self._decided = False  # whether this episode has a decision that is remembered
        self._greedy_successes = 0  # in a row
        self._constant: np.ndarray | None = None  # the action of this episode, where it has only one
        self._repeats = 0  # decisions for which an extended action still goes on
        self._extended: np.ndarray | None = None

    def has_begun(self) -> bool:
        """Whether enough is known to learn from; until then actions are uniformly random."""
        return self.decisions >= self.preset.learning_starts

    def on_episode_start(self) -> None:
        """Begins an episode, and decides how it explores."""
        self.episodes += 1
        self._decided = False
        share = self.preset.greedy_episode_fraction
        own = self.episodes - self.preset.demonstration_episodes  # in those before, somebody else acts
        self._constant = self._uniform() if 0 < own <= self.preset.constant_episodes else None
        due = int(self.episodes * share) > int((self.episodes - 1) * share)
        self._greedy = due and own > 0 and self._constant is None and self.has_begun()
        self._repeats = 0
        if self.selection is not None and self._greedy:
            self.selection.begin(self.actor(), self._greedy_successes)

    def on_step(self, decision: Transition) -> None:
        """Remembers a decision, and learns if it is time to. Where the simulation failed nothing followed: what came
        before is then the episode's last, as at a time limit.
        """
        if "simulation_failure" in decision.info:
            self._cut_short()
            return
        self.remember(decision)
        self.learn()
        self._decided = True

    def _cut_short(self) -> None:
        if self._decided:
            buffer = self.model.replay_buffer
            buffer.dones[buffer.pos - 1] = buffer.timeouts[buffer.pos - 1] = 1.0

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Ends an episode. One in which a person pushed says nothing of the policy."""
        if row.get("interventions"):
            self.leave_out()
        elif self._greedy:
            self._greedy_successes = self._greedy_successes + 1 if row["success"] else 0
            if self.selection is not None:
                self.selection.finish(bool(row["success"]))
        return {}

    def leave_out(self) -> None:
        """Ends an episode that does not count for the selection, as if it had not been greedy."""
        if self._greedy and self.selection is not None:
            self.selection.leave_out()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Uniform until learning starts; then sampled from the policy, or in a greedy episode its mean."""
        if self._constant is not None:
            return self._constant
        if not self.has_begun():
            return self._uniform()
        if not self._greedy:
            extended = self._temporally_extended()
            return self.explore(observation) if extended is None else extended
        with torch.no_grad():
            return self.actor()._predict(self.model.policy.obs_to_tensor(observation)[0], deterministic=True)[0].numpy()

    def explore(self, observation: np.ndarray) -> np.ndarray:
        """An exploring action of the policy; one that is deterministic needs noise from its subclass."""
        return self.model.predict(observation, deterministic=False)[0]

    def _temporally_extended(self) -> np.ndarray | None:
        """Now and then one uniform action for several decisions; None in between.

        The εz-greedy exploration of Dabney, Ostrovski and Barreto (2021), with uniform durations: it leaves where a
        policy has settled, such as above all contact, and it says what going on in one direction is worth.
        """
        if self._repeats == 0:
            known = 0 < self.preset.ez_greedy_until <= self._greedy_successes
            if known or not self.preset.ez_greedy or self.random.random() >= self.preset.ez_greedy:
                return None
            self._repeats = int(self.random.integers(1, self.preset.ez_greedy_longest + 1))
            self._extended = self._uniform()
        self._repeats -= 1
        return self._extended

    def _uniform(self) -> np.ndarray:
        space = self.model.action_space
        assert isinstance(space, spaces.Box)
        return self.random.uniform(space.low, space.high).astype(space.dtype)

    def remember(self, one: Transition) -> None:
        """Takes a decision into the replay buffer.

        A time limit is not an end of the task: its last decision is bootstrapped (partial-episode bootstrapping, Pardo
        et al., 2018), as whoever is near the goal then is worth what one is worth who is there earlier. The clock that
        is observed is for telling the phases of a skill apart, and not for what is left of the time.
        """
        infos = [{"TimeLimit.truncated": one.truncated and not one.terminated}]
        observation, following = one.observation, one.following
        action = self.model.policy.scale_action(np.asarray(one.action)[None])
        if np.ndim(observation) == 3:  # an image; Stable-Baselines3 keeps channels first
            observation, following = np.moveaxis(observation, -1, 0), np.moveaxis(following, -1, 0)
        seen, did, then = [observation], [action[0]], [following]
        if self.symmetry is not None:
            seen.extend(self.symmetry.observations @ observation)
            did.extend(self.symmetry.actions @ action[0])
            then.extend(self.symmetry.observations @ following)
        self.model.replay_buffer.add(
            np.array(seen),
            np.array(then),
            np.array(did),
            np.full(self._sides, one.reward),
            np.full(self._sides, one.is_last),
            infos * self._sides,
        )
        self.decisions += 1

    def learn(self) -> None:
        """Trains if it is time to: every `train_freq` decisions of the whole run, whatever the episodes' lengths."""
        if not self.has_begun() or self.decisions % self.preset.train_freq:
            return
        self.model.train(self.preset.gradient_steps, self.preset.batch_size)
        if self.has_diverged():
            raise diverged()
        if self.averaged is not None:
            follow = 1.0 - (1.0 - self.preset.actor_ema) ** self.preset.gradient_steps
            with torch.no_grad():
                for mean, value in zip(self.averaged.parameters(), self.model.actor.parameters(), strict=True):
                    mean.lerp_(value, follow)

    def actor(self) -> Any:
        """The network whose mean is the greedy action: the averaged one where there is one."""
        return self.model.actor if self.averaged is None else self.averaged

    def result(self) -> Any:
        """What a run leaves: the selected actor, or the last one where none was."""
        weights = None if self.selection is None else self.selection.result()
        if weights is None:
            return self.actor()
        selected = copy.deepcopy(self.actor())
        selected.load_state_dict(weights)
        return selected

    def policy(self, description: Mapping[str, Any]) -> Policy:
        """What a run leaves, as NumPy evaluates it; `description` is what else is known of it."""
        return policy_of(self.result(), description)

    def has_diverged(self) -> bool:
        """Whether the actor holds anything that is not a finite number."""
        return not bool(torch.isfinite(parameters_to_vector(self.model.actor.parameters())).all())

    def _modules(self) -> dict[str, Any]:
        modules = {"policy": self.model.policy}
        return modules if self.averaged is None else modules | {"averaged": self.averaged}

    def _optimizers(self) -> dict[str, torch.optim.Optimizer]:
        optimizers = {"actor": self.model.actor.optimizer, "critic": self.model.critic.optimizer}
        entropy = getattr(self.model, "ent_coef_optimizer", None)
        return optimizers if entropy is None else optimizers | {"entropy": entropy}

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Everything that the rest of a run depends on: arrays by name, and what JSON can hold."""
        arrays = {
            f"{m}/{k}": v.numpy() for m, module in self._modules().items() for k, v in module.state_dict().items()
        }
        for name, optimizer in self._optimizers().items():
            for index, moments in optimizer.state_dict()["state"].items():
                arrays |= {f"optimizer/{name}/{index}/{key}": value.numpy() for key, value in moments.items()}
        if self._entropy() is not None:
            arrays["log_ent_coef"] = self._entropy().detach().numpy()
        selection: dict[str, Any] = {}
        if self.selection is not None:
            actors, selection = self.selection.state()
            arrays |= {f"selection/{key}": value.numpy() for key, value in actors.items()}
        buffer = self.model.replay_buffer
        arrays |= {f"buffer/{k}": getattr(buffer, k)[: buffer.size()] for k in self._buffer_names()}
        arrays["random/torch"] = torch.get_rng_state().numpy()
        kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 (Stable-Baselines3 samples from it)
        arrays["random/numpy"] = np.asarray(keys)
        return arrays, {
            "decisions": self.decisions,
            "episodes": self.episodes,
            "greedy_successes": self._greedy_successes,
            "selection": selection,
            "updates": self.model._n_updates,
            "buffer": [buffer.pos, buffer.full],
            "numpy": [kind, *rest],
            "python": random.getstate(),
            "own": self.random.bit_generator.state,
        }

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Becomes what it was when `state` was called; raises something, a ValueError at last, where that can't be."""
        tensors = {key: torch.from_numpy(np.array(value)) for key, value in arrays.items()}
        for name, module in self._modules().items():
            module.load_state_dict({k[len(name) + 1 :]: v for k, v in tensors.items() if k.startswith(name + "/")})
        for name, optimizer in self._optimizers().items():
            moments: dict[int, dict[str, torch.Tensor]] = {}
            for key, value in tensors.items():
                if key.startswith(f"optimizer/{name}/"):
                    _, _, index, moment = key.split("/")
                    moments.setdefault(int(index), {})[moment] = value
            optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})
        if self._entropy() is not None:
            with torch.no_grad():
                self._entropy().copy_(tensors["log_ent_coef"])
        buffer = self.model.replay_buffer
        for key in self._buffer_names():
            stored = getattr(buffer, key)
            stored[: len(arrays[f"buffer/{key}"])] = arrays[f"buffer/{key}"]
        buffer.pos, buffer.full = values["buffer"]
        self.decisions, self.model._n_updates = values["decisions"], values["updates"]
        self.episodes = values["episodes"]
        self._greedy_successes = values["greedy_successes"]
        if self.selection is not None:
            actors = {key.removeprefix("selection/"): v for key, v in tensors.items() if key.startswith("selection/")}
            self.selection.restore(actors, values["selection"])
        torch.set_rng_state(tensors["random/torch"])
        kind, *rest = values["numpy"]
        np.random.set_state((kind, arrays["random/numpy"], *rest))  # noqa: NPY002
        version, state, gauss = values["python"]
        random.setstate((version, tuple(state), gauss))
        self.random.bit_generator.state = values["own"]
        self._check_restored(arrays, values)

    def _check_restored(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Raises a ValueError if it is not what it should have become: some of that has no place here, or no sense."""
        found, known = self.state()
        different = {key for key in {*found, *arrays} if _bits(found.get(key)) != _bits(arrays.get(key))}
        if different or json.dumps(known, sort_keys=True) != json.dumps(values, sort_keys=True):
            raise ValueError(f"this learner has another {', '.join(sorted(different)) or 'state'}")

    def _entropy(self) -> Any:
        """The logarithm of the entropy's coefficient where it is learned."""
        return getattr(self.model, "log_ent_coef", None)

    @staticmethod
    def _buffer_names() -> tuple[str, ...]:
        return ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


def _bits(array: np.ndarray | None) -> tuple[Any, ...]:
    """What two arrays have in common that are the same; files know no number without a dimension."""
    return () if array is None else (np.atleast_1d(array).shape, array.dtype, array.tobytes())


class SacLearner(OffPolicyLearner):
    """Soft actor-critic (Haarnoja et al., 2018)."""

    algorithm = EnsembleSac


class TqcLearner(OffPolicyLearner):
    """Truncated quantile critics (Kuznetsov et al., 2020)."""

    algorithm = EnsembleTqc
