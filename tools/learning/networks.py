"""Networks of Stable-Baselines3 learners: images, activations, export, and critics that observe more than the actor."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib.common.torch_layers import BatchRenorm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy


class FirstEntries(BaseFeaturesExtractor):
    """Feature extractor of an actor: the first entries of the critics' larger observation."""

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
    """Make an environment provide privileged observations for the critics of an algorithm.

    Returns:
        An environment with the spaces of the critics, a policy class whose actor observes the entries of `env` only,
        and the number of privileged entries.

    Raises:
        InputError: If the task declares no privileged observation or no symmetry of it, or the algorithm has no critic
            apart from its actor.
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
    """Return an observation and its symmetric copies, (n,) each, with the privileged entries of each appended."""
    assert privileged is not None  # because `observe_privileged` was called
    hidden = [privileged]
    if symmetry is not None and symmetry.privileged is not None:
        hidden.extend(symmetry.privileged @ privileged)
    return [np.concatenate(pair) for pair in zip(observations, hidden, strict=True)]


IMAGE_POOL = 5  # side of the averaged squares [pixels]; 110×144×3 becomes 22×28×3


class AveragePooledImage(BaseFeaturesExtractor):
    """Features of an image: the averages of squares of pixels, as one vector (thesis, 4.4.1).

    Without pooling, an image of 110×144×3 needs a first layer of twelve million weights per network, and a gradient
    step takes most of a second on one core. The details that a task needs are larger than a pixel.
    """

    def __init__(self, observation_space: spaces.Box, pool: int):
        """Construct the extractor for images (channels, height, width), with squares of side `pool` [pixels]."""
        channels, height, width = observation_space.shape
        super().__init__(observation_space, channels * (height // pool) * (width // pool))
        self.pool = pool

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map images (batch, channels, height, width) in [0, 1] to features (batch, features)."""
        return torch.nn.functional.avg_pool2d(observations, self.pool).flatten(1)


class NormalizedReLU(torch.nn.Module):
    """Layer normalization without learned parameters, followed by a rectifier."""

    kind = "normalized_relu"

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Map features (…, units) to the same shape."""
        return torch.relu(torch.nn.functional.layer_norm(features, features.shape[-1:]))


class DroppedNormalizedReLU(NormalizedReLU):
    """Dropout, followed by layer normalization and a rectifier (DroQ; Hiraoka et al., 2022)."""

    def __init__(self, probability: float):
        """Construct the module, which drops each feature with a probability in training mode."""
        super().__init__()
        self.dropout = torch.nn.Dropout(probability)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Map features (…, units) to the same shape."""
        return super().forward(self.dropout(features))


def add_dropout(critic: Any, probability: float) -> None:
    """Replace the activations of the critics by activations with dropout."""
    for network in critic.q_networks:
        for index, layer in enumerate(network):
            if not isinstance(layer, torch.nn.Linear):
                network[index] = DroppedNormalizedReLU(probability)


def export_policy(actor: Any, description: Mapping[str, Any]) -> Policy:
    """Return the policy of a Stable-Baselines3 actor: linear layers with rectifiers between them, and a final tanh.

    `description` holds further entries of the policy's description, such as the observation's shape.

    Raises:
        InputError: If the actor has other layers.
    """
    layers = [*actor.latent_pi, actor.mu] if hasattr(actor, "latent_pi") else [*actor.mu][:-1]
    pool = getattr(actor.features_extractor, "pool", 1)
    return export_layers(layers, actor.action_space, {"pool": pool, "squash": "tanh", **description})


def export_layers(layers: Sequence[torch.nn.Module], space: Any, description: Mapping[str, Any]) -> Policy:
    """Return the policy of a network's layers; batch renormalization is merged into the next linear layer.

    Args:
        layers: Linear layers with one kind of activation between them.
        space: Action space.
        description: Entries of the policy's description.

    Raises:
        InputError: If there are other layers.
    """
    linear: list[tuple[torch.Tensor, torch.Tensor]] = []
    activations: list[str | None] = []
    scale, shift = torch.ones(1), torch.zeros(1)
    for layer in layers:
        if isinstance(layer, torch.nn.Linear):
            linear.append((layer.weight * scale, layer.bias + layer.weight @ shift.expand(layer.in_features)))
            scale, shift = torch.ones(1), torch.zeros(1)
        elif isinstance(layer, BatchRenorm):
            renorm: Any = layer  # its buffers have no type
            scale = renorm.scale / (renorm.ra_var + renorm.eps).sqrt()
            shift = renorm.bias - renorm.ra_mean * scale
        else:
            activations.append(_ACTIVATIONS.get(type(layer), getattr(layer, "kind", None)))
    if len(activations) + 1 != len(linear) or len({*activations}) != 1 or None in activations:
        raise InputError(
            f"an actor of {', '.join(type(layer).__name__ for layer in layers)} can't be exported: use linear layers "
            "with one kind of rectifier between them"
        )
    return Policy(
        [(weight.detach().numpy().copy(), bias.detach().numpy().copy()) for weight, bias in linear],
        {
            "format": FORMAT,
            "pool": 1,
            "action_low": space.low.tolist(),
            "action_high": space.high.tolist(),
            "activation": activations[0],
            **description,
        },
    )


_ACTIVATIONS = {torch.nn.ReLU: "relu", torch.nn.Tanh: "tanh"}
