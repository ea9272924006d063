"""Networks and replay buffer of Stable-Baselines3 learners: images, activations, export, privileged critics."""

from __future__ import annotations

import copy
import math
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib.common.torch_layers import BatchRenorm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy

if TYPE_CHECKING:
    from guiderail.diagrams.envs.task_diagram import Symmetry


class SpacesOnlyEnv(gymnasium.Env):
    """Environment with only the spaces of another environment, for sending to another process."""

    def __init__(self, env: gymnasium.Env, observation_space: spaces.Box | None = None):
        """Copy the spaces of `env`; `observation_space` replaces its observation space if given."""
        self.observation_space, self.action_space = observation_space or env.observation_space, env.action_space
        self.privileged_space = getattr(env.unwrapped, "privileged_space", None)


class FirstEntries(BaseFeaturesExtractor):
    """Feature extractor of an actor: the first entries of the critics' larger observation."""

    def __init__(self, observation_space: spaces.Box, number: int):
        """Construct the extractor of the first `number` entries of an observation (n,)."""
        super().__init__(observation_space, number)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map observations (batch, n) to features (batch, number)."""
        return observations[:, : self._features_dim]


def asymmetric_policy(policy: Any, num_observed: int) -> type:
    """Return a Stable-Baselines3 policy class whose actor observes only the first `num_observed` entries.

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
        An environment with the spaces of the critics, a policy class whose actor observes only the observation of
        `env`, and the number of privileged entries.
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
    infinite = np.full(observed.shape[0] + hidden.shape[0], np.inf, np.float32)
    critic = SpacesOnlyEnv(env, spaces.Box(-infinite, infinite))
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


RANDOM_SHIFT = 4  # largest random shift of convolved images [pixels] (DrQ)
IMAGE_POOL = 5  # side of the averaged squares [pixels]; 110×144×3 becomes 22×28×3
CHANNELS = (32, 32, 32)  # output channels of the convolutions, each 3×3 with stride 2


def image_shape(space: Any) -> tuple[int, int, int] | None:
    """Return the shape (height, width, channels) of the image in a space's observations; None if there is none."""
    height_width_channels = space.shape if is_image_space(space) else getattr(space, "image_shape", None)
    return None if height_width_channels is None else tuple(height_width_channels)


def packed_space(space: spaces.Box) -> spaces.Box:
    """Return the space of `pack_observation`: vectors of uint8."""
    shape = image_shape(space)
    assert shape is not None
    size = math.prod(shape) + 4 * (0 if len(space.shape) == 3 else space.shape[0] - math.prod(shape))
    return spaces.Box(0, 255, (size,), np.uint8)


def pack_observation(observation: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Return an observation with an image as a vector of uint8, channel by channel, followed by the state's bytes.

    The observation is an image (height, width, channels) of uint8, or a vector [image / 255, state] of float32 whose
    image is ordered channel by channel. A replay buffer of packed vectors needs one byte per pixel and channel, and the
    packing loses nothing.
    """
    if observation.ndim == 3:
        return np.moveaxis(observation, -1, 0).ravel()
    pixels, state = np.split(observation.astype(np.float32), [math.prod(shape)])
    return np.concatenate([np.rint(pixels * 255).astype(np.uint8), state.view(np.uint8)])


class ImageFeatures(BaseFeaturesExtractor):
    """Features of a packed observation: the features of the image, followed by the state.

    The image's features are the averages of squares of pixels, the pixels (thesis, 4.4.1), or the outputs of
    convolutions. In training mode, the image of a convolutional extractor is shifted at random (DrQ; Yarats et al.,
    2021).

    Without pooling or convolutions, an image of 110×144×3 needs twelve million weights in a first layer of 256 units.

    Attributes:
        pool: Side of the averaged squares [pixels]; 1 without pooling.
        convolutions: Convolutions, each followed by a ReLU; empty without convolutions.
    """

    def __init__(self, observation_space: spaces.Box, shape: tuple[int, int, int], encoder: str):
        """Construct the extractor of packed observations with images of height, width and channels.

        The encoder is "average_pooling", "convolutional" or "pixels" (none). In training mode, images are shifted by
        up to `RANDOM_SHIFT` pixels before convolutions.
        """
        height, width, channels = shape
        side_of_squares = IMAGE_POOL if encoder == "average_pooling" else 1
        sides = [side // side_of_squares for side in (height, width)]
        if encoder == "convolutional":
            for _ in CHANNELS:
                sides = [(side - 1) // 2 for side in sides]
        if min(sides) < 1:
            raise InputError(f"an image of {height} x {width} pixels is too small for {encoder.replace('_', ' ')}")
        self._num_pixels = height * width * channels
        num_state = (observation_space.shape[0] - self._num_pixels) // 4
        maps = CHANNELS[-1] if encoder == "convolutional" else channels
        super().__init__(observation_space, maps * math.prod(sides) + num_state)
        self._num_state = num_state
        self.pool, self._shape = side_of_squares, (channels, height, width)
        inputs = [channels, *CHANNELS[:-1]]
        pairs = zip(inputs, CHANNELS, strict=True) if encoder == "convolutional" else ()
        self.convolutions = torch.nn.ModuleList(torch.nn.Conv2d(*pair, 3, stride=2) for pair in pairs)

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map packed observations (batch, n), as numbers of any type, to features (batch, features)."""
        image = observations[:, : self._num_pixels].float().unflatten(1, self._shape) / 255
        state = observations[:, self._num_pixels :].to(torch.uint8).flatten().view(torch.float32)
        if not self.convolutions:
            features = torch.nn.functional.avg_pool2d(image, self.pool)
        else:
            features = self._shift(image) if self.training else image
            for convolution in self.convolutions:
                features = torch.relu(convolution(features))
        return torch.cat([features.flatten(1), state.view(len(image), self._num_state)], dim=1)

    def _shift(self, images: torch.Tensor) -> torch.Tensor:
        """Shift each image by whole pixels; the border repeats the outermost pixels."""
        number, _, height, width = images.shape
        shifts = torch.randint(-RANDOM_SHIFT, RANDOM_SHIFT + 1, (2, number, 1)).to(images.device)
        rows = (torch.arange(height, device=images.device) + shifts[0]).clamp(0, height - 1)
        columns = (torch.arange(width, device=images.device) + shifts[1]).clamp(0, width - 1)
        indices = torch.arange(number, device=images.device)[:, None, None]
        return images.permute(0, 2, 3, 1)[indices, rows[:, :, None], columns[:, None, :]].permute(0, 3, 1, 2)


class DetachedFeatures(BaseFeaturesExtractor):
    """Features of another extractor, without gradients: the actor uses the critic's encoder but does not train it."""

    def __init__(self, observation_space: spaces.Box, features: ImageFeatures):
        super().__init__(observation_space, features.features_dim)
        self.features: Any = features

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Map packed observations (batch, n) to features (batch, features)."""
        with torch.no_grad():
            return self.features(observations)


def share_encoder(model: Any) -> None:
    """Make the actor of an actor-critic algorithm use the critic's encoder, which only the critic's loss trains.

    This is the architecture of DrQ (Yarats et al., 2021). Target critics shift images at random as well.
    """
    actor, critic = model.actor, model.critic
    if getattr(model, "actor_target", None) is not None:
        raise InputError(f"{type(model).__name__} has a target actor and no shared encoder: choose tqc, sac or crossq")
    actor.features_extractor = DetachedFeatures(model.observation_space, critic.features_extractor)
    trained = [value for name, value in actor.named_parameters() if not name.startswith("features_extractor.")]
    policy = model.policy
    actor.optimizer = policy.optimizer_class(trained, lr=model.lr_schedule(1), **policy.optimizer_kwargs)
    if getattr(model, "critic_target", None) is not None:
        model.critic_target.features_extractor.train()


class NormalizedReLU(torch.nn.Module):
    """Layer normalization without learned parameters, followed by a ReLU."""

    kind = "normalized_relu"

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Map features (…, units) to the same shape."""
        return torch.relu(torch.nn.functional.layer_norm(features, features.shape[-1:]))


class DroppedNormalizedReLU(NormalizedReLU):
    """Dropout, followed by layer normalization and a ReLU (DroQ; Hiraoka et al., 2022)."""

    def __init__(self, probability: float):
        super().__init__()
        self.dropout = torch.nn.Dropout(probability)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """Map features (…, units) to the same shape."""
        return super().forward(self.dropout(features))


def add_dropout(critic: Any, probability: float) -> None:
    """Replace each activation of the critics by a `DroppedNormalizedReLU`."""
    for network in critic.q_networks:
        for index, layer in enumerate(network):
            if not isinstance(layer, torch.nn.Linear):
                network[index] = DroppedNormalizedReLU(probability)


def export_policy(actor: Any, description: Mapping[str, Any]) -> Policy:
    """Return the policy of a Stable-Baselines3 actor: linear layers with activations between them, and a final tanh.

    The entries of `description`, such as the observation's shape, are added to the policy's description.
    """
    layers = [*actor.latent_pi, actor.mu] if hasattr(actor, "latent_pi") else [*actor.mu][:-1]
    features = actor.features_extractor
    features = features.features if isinstance(features, DetachedFeatures) else features
    encoder = [_arrays(layer) for layer in getattr(features, "convolutions", ())]
    pool = {"pool": getattr(features, "pool", 1)}
    return export_layers(layers, actor.action_space, {**pool, "squash": "tanh", **description}, encoder)


def _arrays(layer: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return copies of the weight and bias of a layer."""
    return layer.weight.detach().cpu().numpy().copy(), layer.bias.detach().cpu().numpy().copy()


def export_layers(
    layers: Sequence[torch.nn.Module],
    space: Any,
    description: Mapping[str, Any],
    encoder: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> Policy:
    """Return the policy of optional convolutions, followed by linear layers with one kind of activation between them.

    Batch renormalization is merged into the next linear layer.

    Args:
        layers: Layers from input to output.
        space: Action space.
        description: Entries to add to the policy's description.
        encoder: Weight (out, in, 3, 3) and bias (out,) of each convolution.
    """
    linear: list[tuple[torch.Tensor, torch.Tensor]] = []
    activations: list[str | None] = []
    order = ""  # a letter for each layer
    scale, shift = torch.ones(1), torch.zeros(1)
    for layer in copy.deepcopy([*layers]):
        layer.cpu()
        if isinstance(layer, torch.nn.Linear):
            linear.append((layer.weight * scale, layer.bias + layer.weight @ shift.expand(layer.in_features)))
            scale, shift = torch.ones(1), torch.zeros(1)
            order += "l"
        elif isinstance(layer, BatchRenorm):
            renorm: Any = layer  # its buffers have no type
            scale = renorm.scale / (renorm.ra_var + renorm.eps).sqrt()
            shift = renorm.bias - renorm.ra_mean * scale
            order += "n"
        else:
            activations.append(_ACTIVATIONS.get(type(layer), getattr(layer, "kind", None)))
            order += "a"
    if not re.fullmatch("n?l(an?l)+", order) or len({*activations}) != 1 or None in activations:
        raise InputError(
            f"an actor of {', '.join(type(layer).__name__ for layer in layers)} can't be exported: use linear layers "
            "with one kind of activation between them: ReLU, normalized ReLU or tanh"
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
        encoder,
    )


_ACTIVATIONS = {torch.nn.ReLU: "relu", torch.nn.Tanh: "tanh"}


class DemonstrationReplayBuffer(ReplayBuffer):
    """Replay buffer with a fixed fraction of demonstrated transitions in every batch (RLPD; Ball et al., 2023).

    The first `num_demonstrated` rows are the demonstrations; a full buffer overwrites only the rows after them.

    Attributes:
        fraction: Fraction of demonstrations in a batch, once the buffer also has other transitions.
        num_demonstrated: Number of rows of demonstrations.
    """

    fraction = 0.5
    num_demonstrated = 0

    def add(self, *args: np.ndarray, **kwargs: np.ndarray) -> None:  # type: ignore[override]
        """Add a row; once the buffer is full, overwrite the oldest row after the demonstrations."""
        if self.num_demonstrated >= self.buffer_size:
            raise InputError(
                f"the demonstrations fill the replay buffer of {self.buffer_size} transitions: give a larger "
                "--set buffer_size=..."
            )
        super().add(*args, **kwargs)  # type: ignore[arg-type]
        if self.full and self.pos < self.num_demonstrated:
            self.pos = self.num_demonstrated

    @property
    def newest(self) -> int:
        """Index of the row that was added last."""
        is_wrapped = self.full and self.pos == self.num_demonstrated
        return self.buffer_size - 1 if is_wrapped else self.pos - 1

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> ReplayBufferSamples:
        """Return a batch with evenly spaced demonstrated rows.

        Several batches can be sampled at once and then divided into equal parts: the numbers of demonstrations in the
        parts differ by at most one.
        """
        size, first = self.size(), self.num_demonstrated
        if not 0 < first < size:
            return super().sample(batch_size, env)
        count = np.arange(batch_size + 1) * self.fraction
        is_demonstrated = np.diff(np.floor(count + 1e-9)) > 0
        low, high = np.where(is_demonstrated, 0, first), np.where(is_demonstrated, first, size)
        # NumPy's global generator is used, as in Stable-Baselines3's own buffers.
        indices = np.random.randint(low, high)  # noqa: NPY002
        return self._get_samples(indices, env=env)
