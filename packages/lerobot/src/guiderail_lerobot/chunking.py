"""Chunk cloning: supervised training of an ensemble that predicts the next commanded poses from an observation.

As in action chunking with transformers (ACT), the targets are chunks of future commands.
"""

from collections.abc import Mapping
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from scipy.linalg import block_diag
from stable_baselines3.common.torch_layers import create_mlp

from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import register_learner
from guiderail_lerobot.cloning import BcLearner
from guiderail_lerobot.config import ChunkConfig

MIN_SCALE = 1e-6  # minimum scale of an output; the standard deviation of a constant output is zero


@register_learner("chunk")
class ChunkLearner(BcLearner):
    """Learner of a base policy that maps an observation to the next K commanded poses (mean squared error, Adam).

    Action chunks are from Zhao et al., "Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware", RSS 2023.
    The policy is an ensemble of E networks, each trained on a bootstrap sample of the demonstrations. The spread of
    their outputs is the uncertainty of the chunk (Lakshminarayanan et al., 2017). The networks are exported as one
    network with block-diagonal layers. The learner's own action is always zero.
    """

    Config = ChunkConfig
    config: ChunkConfig

    def __init__(self, config: ChunkConfig, env: gymnasium.Env, **arguments: Any):
        """Construct the learner; `Learner` describes the arguments.

        Raises:
            InputError: If the environment is not built from a task's diagram.
        """
        super().__init__(config, env, **arguments)
        if not hasattr(env.unwrapped, "trace"):
            raise InputError(f"{config.algorithm} needs an environment that is built from a task's diagram")
        self._env = cast(Any, env.unwrapped)
        dims = self._env.diagram.config.options.get("action_dims")
        self._dims = slice(None) if dims is None else list(dims)
        self._episode_observations: list[np.ndarray] = []
        self._starts: list[int] = []  # control step of each observation of the episode
        self._groups: list[int] = []  # episode of each stored observation
        self._step, self._num_outputs = 0, 0
        self._center, self._scale = np.zeros(1), np.ones(1)
        self.network = torch.nn.Sequential()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return zero, because the chunks are references and not actions."""
        return np.zeros(self._space.shape or (), np.float32)

    def on_episode_start(self) -> None:
        """Count the episode and clear its observations."""
        super().on_episode_start()
        self._episode_observations, self._starts, self._step = [], [], 0

    def on_step(self, transition: Transition) -> None:
        """Store the observation if the episode is a demonstration."""
        if self.episodes <= self.config.demonstration_episodes:
            self._episode_observations.append(np.asarray(transition.observation, np.float32))
            self._starts.append(self._step)
        self._step = len(self._env.trace)

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Cut the commands into chunks, add their symmetric copies, and train after the last demonstration."""
        if self.episodes <= self.config.demonstration_episodes:
            commanded = self._env.trace.commanded
            self._num_outputs = commanded.shape[1]
            steps = np.array(self._starts)[:, None] + np.arange(self.config.chunk_steps)
            self._add(np.array(self._episode_observations), commanded[np.minimum(steps, len(commanded) - 1)])
        return super().on_episode_end(row)

    def _add(self, observations: np.ndarray, chunks: np.ndarray) -> None:
        """Store observations (n, size) and chunks (n, K, O) with symmetric copies.

        A symmetry acts on the outputs that actions move, `_dims`, as on the actions.
        """
        symmetries = [(np.eye(observations.shape[1]), None)]
        if self._symmetry is not None:
            symmetries += [*zip(self._symmetry.observations, self._symmetry.actions, strict=True)]
        for observation_matrix, action_matrix in symmetries:
            copies = chunks.copy()
            if action_matrix is not None:
                copies[:, :, self._dims] = chunks[:, :, self._dims] @ action_matrix.T
            self._observations.extend((observations @ observation_matrix.T).astype(np.float32))
            self._actions.extend(copies.reshape(len(chunks), -1))
            self._groups.extend([self.episodes] * len(chunks))

    def _train(self) -> None:
        observations, chunks = np.array(self._observations), np.array(self._actions)
        self._center, self._scale = chunks.mean(axis=0), np.maximum(chunks.std(axis=0), MIN_SCALE)
        inputs = torch.from_numpy(observations)
        targets = torch.from_numpy((chunks - self._center) / self._scale).float()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self._seed)
            sizes = observations.shape[1], chunks.shape[1], [*self.config.net_arch]
            members = [torch.nn.Sequential(*create_mlp(*sizes)) for _ in range(self.config.members)]
        losses = []
        for index, network in enumerate(members):
            random = np.random.default_rng([self._seed, index])
            generator = torch.Generator().manual_seed(int(random.integers(2**62)))
            rows = self._training_rows(random)
            optimizer = torch.optim.Adam(network.parameters(), lr=self.config.learning_rate)
            for _ in range(self.config.gradient_steps):
                batch = rows[random.integers(len(rows), size=self.config.batch_size)]
                # Without noise, the network copies an observed command, and errors accumulate (Ke et al., 2021).
                noise = torch.randn(inputs[batch].shape, generator=generator)
                noisy = inputs[batch] + self.config.observation_noise * noise
                loss = torch.nn.functional.mse_loss(network(noisy), targets[batch])
                optimizer.zero_grad()
                loss.backward()
                optimizer.step()
            losses.append(loss.item())
        self.network, self._loss = torch.nn.Sequential(*members), float(np.mean(losses))

    def _training_rows(self, random: np.random.Generator) -> np.ndarray:
        """Return the row indices of a bootstrap sample of the demonstrations, for training one network."""
        # A run that is resumed after further episodes trains again: `self.episodes` is then larger than this number.
        groups, number = np.array(self._groups), self.config.demonstration_episodes
        sampled = random.integers(1, number + 1, size=number)
        return np.concatenate([np.flatnonzero(groups == demonstration) for demonstration in sampled])

    def policy(self, description: Mapping[str, Any]) -> Policy:
        """Return the base policy: the ensemble as one network, whose output is limited to the demonstrated range.

        Raises:
            InputError: If there were fewer demonstrations than `demonstration_episodes`.
        """
        self._check_trained()
        members: list[Any] = [
            [layer for layer in member.children() if hasattr(layer, "weight")] for member in self.network.children()
        ]
        layers = []
        for depth in range(len(members[0])):
            weights = [member[depth].weight.detach().numpy().astype(float) for member in members]
            biases = [member[depth].bias.detach().numpy().astype(float) for member in members]
            if depth == len(members[0]) - 1:
                weights = [self._scale[:, None] * weight for weight in weights]
                biases = [self._scale * bias + self._center for bias in biases]
            weight = np.concatenate(weights) if depth == 0 else block_diag(*weights)
            layers.append((weight.astype(np.float32), np.concatenate(biases).astype(np.float32)))
        chunks = np.array(self._actions)
        low, high = chunks.min(axis=0) - MIN_SCALE, chunks.max(axis=0) + MIN_SCALE
        ensemble = self.config.members
        return Policy(
            layers,
            {
                **description,  # its limits are those of the environment's actions; those below are of chunks
                "format": FORMAT,
                "pool": 1,
                "activation": "relu",
                "squash": "clip",
                "action_low": np.tile(low, ensemble).tolist(),
                "action_high": np.tile(high, ensemble).tolist(),
                "chunk": [ensemble, self.config.chunk_steps, self._num_outputs],
            },
        )

    def _is_trained(self) -> bool:
        return len(self.network) > 0

    def state(self) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Return the state that a resumed run continues from: the demonstrations."""
        arrays = {"observations": np.array(self._observations), "actions": np.array(self._actions)}
        values = {"episodes": self.episodes, "num_outputs": self._num_outputs}
        return arrays | {"groups": np.array(self._groups)}, values

    def restore(self, arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
        """Restore a result of `state`; raise KeyError if it does not fit this learner."""
        self._observations, self._actions = [*arrays["observations"]], [*arrays["actions"]]
        self._groups = arrays["groups"].tolist()
        self.episodes, self._num_outputs = values["episodes"], values["num_outputs"]
        if self.episodes >= self.config.demonstration_episodes:
            self._train()
