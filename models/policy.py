"""A trained policy as it leaves a run: weights that hold no code, and the NumPy that evaluates them."""

import json
import math
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import digest, read_bytes

FORMAT = "guiderail policy 2"
MOST_WEIGHTS = 200_000_000  # [bytes] a policy of 256 × 256 units has 0.3 million
MOST_DESCRIPTION = 1_000_000  # [bytes]


class Policy:
    """The deterministic action of an actor: a feed-forward network of rectified layers, squashed by tanh.

    Evaluates what Stable-Baselines3's `predict(deterministic=True)` does, in single precision as there, with NumPy
    alone: a robot that runs a skill needs neither PyTorch nor the learner.
    """

    def __init__(self, layers: list[tuple[np.ndarray, np.ndarray]], description: Mapping[str, Any]):
        """
        Args:
            layers: weight (out, in) and bias (out,) of each layer, first to last.
            description: what `policy.json` holds: the shapes and limits of observation and action, `activation`
                ("relu" unless given, or "normalized_relu"), and `pool`, the side of the squares of pixels that an image
                is averaged over.

        Raises:
            ValueError: for a description that lacks something, an activation that it does not know, layers that don't
                follow each other from observation to action, or a number that is not finite.
        """
        self._layers = layers
        self.description = dict(description)
        activation = self.description.setdefault("activation", "relu")
        if activation not in ("relu", "normalized_relu"):
            raise ValueError(f"a policy has no activation {activation!r}")
        self._normalizes = activation == "normalized_relu"
        try:
            self._shape = tuple(description["observation_shape"])
            self._low, self._high = (np.asarray(description[f"action_{end}"], np.float32) for end in ("low", "high"))
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError("a description has the observation's shape, and the action's limits as numbers") from error
        self._check()

    def _check(self) -> None:
        """Raises a ValueError where what is known of the policy doesn't fit together."""
        if any(type(n) is not int or n < 1 for n in (*self._shape, self.description.get("pool", 1))):
            raise ValueError("a shape, and the side of a square of pixels, are positive whole numbers")
        if self._low.ndim != 1 or self._low.shape != self._high.shape or not (self._low < self._high).all():
            raise ValueError("an action has a lower limit below an upper one for each of its numbers")
        if len(self._shape) == 3 and "pool" not in self.description:
            raise ValueError("of an image the side of the squares of pixels is said, that it is averaged over")
        sizes = [self._num_features(), *(len(bias) for _, bias in self._layers)]
        expected = [(out, into) for into, out in pairwise(sizes)]
        if not self._layers or [weight.shape for weight, _ in self._layers] != expected or sizes[-1] != len(self._low):
            raise ValueError(f"layers lead from {sizes[0]} features to {len(self._low)} actions, one after the other")
        numbers = [self._low, self._high, *(array for layer in self._layers for array in layer)]
        if any(array.dtype != np.float32 or not np.isfinite(array).all() for array in numbers):
            raise ValueError("weights and limits are finite and of single precision")

    def _num_features(self) -> int:
        """How many numbers the first layer sees of an observation."""
        if len(self._shape) != 3:
            return math.prod(self._shape)
        height, width, channels = self._shape
        return (height // self.description["pool"]) * (width // self.description["pool"]) * channels

    @classmethod
    def load(cls, folder: Path | str) -> "Policy":
        """Read the policy that a run left in its folder.

        Args:
            folder: Folder with `policy.safetensors` and `policy.json`.

        Raises:
            InputError: If a file is missing or damaged.
        """
        folder = Path(folder)
        weights, description = folder / "policy.safetensors", folder / "policy.json"
        for path in (weights, description):
            if not path.is_file():
                raise InputError(f"{folder} holds no {path.name}: train it first, or finish it with --resume")
        try:
            values = json.loads(read_bytes(description, "description of a policy", MOST_DESCRIPTION))
            arrays = load(read_bytes(weights, "policy's weights", MOST_WEIGHTS))
            if values["format"] != FORMAT or values.pop("digest") != _digest(arrays, values):
                raise ValueError("the format or the digest differs")
            if len(arrays) % 2:
                raise ValueError("a layer has a weight and a bias")
            layers = [(arrays[f"layers.{i}.weight"], arrays[f"layers.{i}.bias"]) for i in range(len(arrays) // 2)]
            return cls(layers, values)
        except (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(
                f"the policy in {folder} is damaged or of another version: write it anew with guiderail train --resume"
            ) from error

    def save(self, folder: Path | str, write: Callable[[Path, bytes], Any] = Path.write_bytes) -> None:
        """Writes `policy.safetensors` and `policy.json`; `write` is how, such as a whole file or none."""
        folder = Path(folder)
        arrays: dict[str, np.ndarray] = {}
        for index, (weight, bias) in enumerate(self._layers):
            arrays |= {f"layers.{index}.weight": weight, f"layers.{index}.bias": bias}
        values = self.description | {"format": FORMAT}
        values["digest"] = _digest(arrays, values)
        write(folder / "policy.safetensors", save(arrays))
        write(folder / "policy.json", json.dumps(values, indent=2).encode() + b"\n")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """The action for one observation, in the units of the action space.

        Raises:
            ValueError: if the observation has another shape than those the policy was trained on.
        """
        observation = np.asarray(observation)
        if observation.shape != self._shape:
            raise ValueError(f"the policy was trained on observations {self._shape}, not {observation.shape}")
        hidden = self._features(observation)
        for weight, bias in self._layers[:-1]:
            hidden = self._activate(weight @ hidden + bias)
        weight, bias = self._layers[-1]
        squashed = np.tanh(weight @ hidden + bias)
        return self._low + np.float32(0.5) * (squashed + np.float32(1)) * (self._high - self._low)

    def _activate(self, features: np.ndarray) -> np.ndarray:
        if self._normalizes:
            features = features - features.mean()
            features = features / np.sqrt((features * features).mean() + np.float32(1e-5))
        return np.maximum(features, np.float32(0))

    def _features(self, observation: np.ndarray) -> np.ndarray:
        """What the first layer sees: the numbers as they are, an image channel by channel in [0, 1], averaged."""
        if observation.ndim != 3:
            return observation.astype(np.float32).ravel()
        side = self.description["pool"]
        height, width, channels = (n // side if i < 2 else n for i, n in enumerate(observation.shape))
        image = observation[: height * side, : width * side].astype(np.float32) / np.float32(255)
        image = image.reshape(height, side, width, side, channels).mean((1, 3), dtype=np.float32)
        return image.transpose(2, 0, 1).ravel()


def _digest(arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> str:
    return digest(arrays, json.dumps(description, sort_keys=True))
