"""The learners: Stable-Baselines3's SAC and TQC with the settings of the thesis and with a robust one.

Only the networks, the replay buffer and the gradient step are Stable-Baselines3's. Acting and deciding when to train
are here, so that everything that a run depends on has a name and can be written to a checkpoint.
"""

import copy
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

from guiderail.diagrams.task import Symmetry
from guiderail.models.policy import FORMAT, Policy
from guiderail.tools.learning.checkpoint_selection import Proving
from guiderail.tools.learning.presets import ALGORITHMS, Preset, decision_discount

IMAGE_POOL = 5  # pixels; 110×144×3 becomes 22×28×3


class PooledImage(BaseFeaturesExtractor):
    """An image as one vector (thesis, 4.4.1), after averaging squares of pixels.

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
    """The policy of a Stable-Baselines3 actor: linear layers, what rectifies between them, and a tanh at the end."""
    layers = [*actor.latent_pi, actor.mu]
    linear = [layer for layer in layers if isinstance(layer, torch.nn.Linear)]
    activations = {getattr(layer, "kind", "relu") for layer in actor.latent_pi if layer not in linear}
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


class Learner:
    """An off-policy algorithm of Stable-Baselines3 that is told when to act, to remember and to learn."""

    def __init__(
        self,
        preset: Preset,
        env: gymnasium.Env,
        *,
        hold: int,
        seed: int,
        decisions: int,
        symmetry: Symmetry | None = None,
    ):
        """
        Args:
            preset: how to learn.
            env: for its spaces only.
            hold: control steps that an action lasts.
            seed: of the networks, and of everything drawn in training.
            decisions: the most that this run can take, so that the replay buffer asks for no more memory than it uses.
            symmetry: of the task, where it has one; used if the preset says so.
        """
        self.symmetry = symmetry if preset.symmetry else None
        self._sides = 1 if self.symmetry is None else 2
        networks: dict[str, Any] = {"net_arch": list(preset.units), "optimizer_kwargs": {"fused": True}}
        if preset.layer_norm:
            networks["activation_fn"] = NormalizedReLU
        if is_image_space(env.observation_space):
            networks |= {"features_extractor_class": PooledImage, "features_extractor_kwargs": {"pool": IMAGE_POOL}}
        self.preset = preset
        self.decisions = 0
        self.model = ALGORITHMS[preset.algorithm](
            "MlpPolicy",
            env,
            learning_rate=preset.learning_rate,
            buffer_size=min(preset.buffer_size, decisions + 1),
            batch_size=preset.batch_size,
            tau=preset.soft_update,
            gamma=decision_discount(preset, hold),
            ent_coef=preset.entropy if preset.entropy.startswith("auto") else float(preset.entropy),
            policy_kwargs=networks,
            seed=seed,
            device="cpu",
        )
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
        self.averaged = copy.deepcopy(self.model.actor) if preset.averaging else None
        self.proving = Proving(preset.proven_by) if preset.proven_by else None
        self.episodes = 0
        self._practises = False
        self._row = 0  # practising episodes in a row that succeeded
        self._steady: np.ndarray | None = None
        self._burst = 0  # decisions for which it still goes on
        self._burst_action: np.ndarray | None = None

    def has_begun(self) -> bool:
        """Whether enough is known to learn from; until then actions are drawn uniformly."""
        return self.decisions >= self.preset.learning_starts

    def begin(self) -> None:
        """Begins an episode, and decides how it explores."""
        self.episodes += 1
        share = self.preset.practise
        self._steady = self._uniform() if self.episodes <= self.preset.steady_episodes else None
        due = int(self.episodes * share) > int((self.episodes - 1) * share)
        self._practises = due and self._steady is None and self.has_begun()
        self._burst = 0
        if self.proving is not None and self._practises:
            self.proving.begin(self.actor(), self._row)

    def finish(self, success: bool) -> None:
        """Ends an episode."""
        if self._practises:
            self._row = self._row + 1 if success else 0
            if self.proving is not None:
                self.proving.finish(success)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """An exploring action: uniform until learning starts, then drawn from the policy.

        White actions blur what an action is worth: on the connector they find the hole by wiggling, whatever the policy
        wants. Episodes that keep to one action, or to the policy's mean, say what that action or that mean is worth.
        """
        if self._steady is not None:
            return self._steady
        if not self.has_begun():
            return self._uniform()
        if not self._practises:
            burst = self._kept_for_a_while()
            return burst if burst is not None else self.model.predict(observation, deterministic=False)[0]
        with torch.no_grad():
            return self.actor()._predict(self.model.policy.obs_to_tensor(observation)[0], deterministic=True)[0].numpy()

    def _kept_for_a_while(self) -> np.ndarray | None:
        """Now and then one uniform action for several decisions; None in between.

        The temporally extended exploration of Dabney, Ostrovski and Barreto (2021): it leaves where a policy has
        settled, such as above all contact, and it says what going on in one direction is worth.
        """
        if self._burst == 0:
            known = 0 < self.preset.bursts_until <= self._row
            if known or not self.preset.bursts or self.random.random() >= self.preset.bursts:
                return None
            self._burst = int(self.random.integers(1, self.preset.longest_burst + 1))
            self._burst_action = self._uniform()
        self._burst -= 1
        return self._burst_action

    def _uniform(self) -> np.ndarray:
        space = self.model.action_space
        assert isinstance(space, spaces.Box)
        return self.random.uniform(space.low, space.high).astype(space.dtype)

    def remember(self, observation, action, reward: float, following, terminated: bool, truncated: bool) -> None:
        """Takes one decision and what followed into the replay buffer. A time limit is not an end of the task."""
        infos = [{"TimeLimit.truncated": truncated and not terminated}]
        action = self.model.policy.scale_action(np.asarray(action)[None])
        if np.ndim(observation) == 3:  # an image; Stable-Baselines3 keeps channels first
            observation, following = np.moveaxis(observation, -1, 0), np.moveaxis(following, -1, 0)
        seen, did, then = [observation], [action[0]], [following]
        if self.symmetry is not None:
            signs = np.array(self.symmetry.observation)
            seen.append(signs * observation)
            did.append(np.array(self.symmetry.action) * action[0])
            then.append(signs * following)
        self.model.replay_buffer.add(
            np.array(seen),
            np.array(then),
            np.array(did),
            np.full(self._sides, reward),
            np.full(self._sides, terminated or truncated),
            infos * self._sides,
        )
        self.decisions += 1

    def learn(self) -> None:
        """Trains if it is time to: every `train_every` decisions of the whole run, whatever the episodes' lengths."""
        if not self.has_begun() or self.decisions % self.preset.train_every:
            return
        self.model.train(self.preset.gradient_steps, self.preset.batch_size)
        if self.averaged is not None:
            follow = 1.0 - (1.0 - self.preset.averaging) ** self.preset.gradient_steps
            with torch.no_grad():
                for mean, value in zip(self.averaged.parameters(), self.model.actor.parameters(), strict=True):
                    mean.lerp_(value, follow)

    def actor(self) -> Any:
        """The network whose mean action is practised: the averaged one where there is one."""
        return self.model.actor if self.averaged is None else self.averaged

    def result(self) -> Any:
        """What a run leaves: the actor that proved itself, or the last one where none had the time to."""
        weights = None if self.proving is None else self.proving.result()
        if weights is None:
            return self.actor()
        proven = copy.deepcopy(self.actor())
        proven.load_state_dict(weights)
        return proven

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
        entropy = self.model.ent_coef_optimizer
        return optimizers if entropy is None else optimizers | {"entropy": entropy}

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Everything that the rest of a run depends on: arrays by name, and what JSON can hold."""
        arrays = {
            f"{m}/{k}": v.numpy() for m, module in self._modules().items() for k, v in module.state_dict().items()
        }
        for name, optimizer in self._optimizers().items():
            for index, moments in optimizer.state_dict()["state"].items():
                arrays |= {f"optimizer/{name}/{index}/{key}": value.numpy() for key, value in moments.items()}
        if self.model.log_ent_coef is not None:
            arrays["log_ent_coef"] = self.model.log_ent_coef.detach().numpy()
        proving: dict[str, Any] = {}
        if self.proving is not None:
            actors, proving = self.proving.state()
            arrays |= {f"proving/{key}": value.numpy() for key, value in actors.items()}
        buffer = self.model.replay_buffer
        arrays |= {f"buffer/{k}": getattr(buffer, k)[: buffer.size()] for k in self._buffer_names()}
        arrays["random/torch"] = torch.get_rng_state().numpy()
        kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 (Stable-Baselines3 samples from it)
        arrays["random/numpy"] = np.asarray(keys)
        return arrays, {
            "decisions": self.decisions,
            "episodes": self.episodes,
            "row": self._row,
            "proving": proving,
            "updates": self.model._n_updates,
            "buffer": [buffer.pos, buffer.full],
            "numpy": [kind, *rest],
            "python": random.getstate(),
            "own": self.random.bit_generator.state,
        }

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Becomes what it was when `state` was called. KeyError, ValueError or RuntimeError where it does not fit."""
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
        if self.model.log_ent_coef is not None:
            with torch.no_grad():
                self.model.log_ent_coef.copy_(tensors["log_ent_coef"])
        buffer = self.model.replay_buffer
        for key in self._buffer_names():
            stored = getattr(buffer, key)
            stored[: len(arrays[f"buffer/{key}"])] = arrays[f"buffer/{key}"]
        buffer.pos, buffer.full = values["buffer"]
        self.decisions, self.model._n_updates = values["decisions"], values["updates"]
        self.episodes = values["episodes"]
        self._row = values.get("row", values["proving"].get("row", 0))  # where older checkpoints have it, if at all
        if self.proving is not None:
            actors = {key.removeprefix("proving/"): v for key, v in tensors.items() if key.startswith("proving/")}
            self.proving.restore(actors, values["proving"])
        torch.set_rng_state(tensors["random/torch"])
        kind, *rest = values["numpy"]
        np.random.set_state((kind, arrays["random/numpy"], *rest))  # noqa: NPY002
        version, state, gauss = values["python"]
        random.setstate((version, tuple(state), gauss))
        self.random.bit_generator.state = values["own"]

    @staticmethod
    def _buffer_names() -> tuple[str, ...]:
        return ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
