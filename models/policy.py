"""A trained policy as it leaves a run: weights that hold no code, and the NumPy that evaluates them."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save

from guiderail.models.errors import InputError

FORMAT = "guiderail policy 1"


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
            ValueError: for an activation that it does not know.
        """
        self._layers = layers
        self.description = dict(description)
        self._shape = tuple(description["observation_shape"])
        activation = self.description.setdefault("activation", "relu")
        if activation not in ("relu", "normalized_relu"):
            raise ValueError(f"a policy has no activation {activation!r}")
        self._normalizes = activation == "normalized_relu"
        self._low = np.asarray(description["action_low"], np.float32)
        self._high = np.asarray(description["action_high"], np.float32)

    @classmethod
    def load(cls, folder: Path) -> "Policy":
        """The policy of a run.

        Raises:
            InputError: if there is none, or it is damaged.
        """
        weights, description = folder / "policy.safetensors", folder / "policy.json"
        for path in (weights, description):
            if not path.is_file():
                raise InputError(f"{folder} holds no {path.name}: train it first, or finish it with --resume")
        try:
            values = json.loads(description.read_text(encoding="utf-8"))
            if values["format"] != FORMAT:
                raise ValueError("another format")
            arrays = load_file(weights)
            count = len(arrays) // 2
            layers = [(arrays[f"layers.{i}.weight"], arrays[f"layers.{i}.bias"]) for i in range(count)]
            policy = cls(layers, values)
            policy(np.zeros(policy._shape))
        except (SafetensorError, ValueError, KeyError, TypeError, OSError) as error:
            raise InputError(
                f"the policy in {folder} is damaged or of another version: write it anew with guiderail train --resume"
            ) from error
        return policy

    def save(self, folder: Path, write: Callable[[Path, bytes], Any] = Path.write_bytes) -> None:
        """Writes `policy.safetensors` and `policy.json`; `write` is how, such as a whole file or none."""
        arrays: dict[str, np.ndarray] = {}
        for index, (weight, bias) in enumerate(self._layers):
            arrays |= {f"layers.{index}.weight": weight, f"layers.{index}.bias": bias}
        write(folder / "policy.safetensors", save(arrays))
        write(folder / "policy.json", json.dumps(self.description, indent=2).encode() + b"\n")

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
