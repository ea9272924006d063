"""Trained policies: weights and a description in files without code, evaluated with NumPy."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import digest, read_bytes

FORMAT = "guiderail policy 2"
MAX_WEIGHTS_SIZE = 200_000_000  # [bytes]; a policy of 256 × 256 units has 0.3 million
MAX_DESCRIPTION_SIZE = 1_000_000  # [bytes]


class Policy:
    """Deterministic policy: a feed-forward network whose output is squashed by a tanh or clipped.

    It computes the same action as Stable-Baselines3's `predict(deterministic=True)`, in single precision. It only needs
    NumPy, so that a robot's computer needs neither PyTorch nor the learner.

    Args:
        layers: Weight (out, in) and bias (out,) of each layer, first to last.
        description: Content of `policy.json`: `observation_shape`, the limits `action_low` and `action_high`,
            `activation` ("relu", the default, "normalized_relu" or "tanh") and `squash` ("tanh", the default, or
            "clip"). Images need `pool`, the side [pixels] of the squares over which pixels are averaged. `image_shape`,
            (height, width, channels), declares that observations are vectors [image / 255, state] (see
            `ImageObservation`).
        encoder: Weight (out, in, 3, 3) and bias (out,) of each convolution of an image, with stride 2 and a ReLU.

    Raises:
        ValueError: If the description is incomplete, `activation` or `squash` is unknown, the sizes of the layers do
            not match each other, observation and action, or a number is not finite.
    """

    def __init__(
        self,
        layers: Sequence[tuple[np.ndarray, np.ndarray]],
        description: Mapping[str, Any],
        encoder: Sequence[tuple[np.ndarray, np.ndarray]] = (),
    ):
        self._layers, self._encoder = (
            [(np.asarray(weight, np.float32), np.asarray(bias, np.float32)) for weight, bias in each]
            for each in (layers, encoder)
        )
        self.description = dict(description)
        activation = self.description.setdefault("activation", "relu")
        if activation not in ("relu", "normalized_relu", "tanh"):
            raise ValueError(f"a policy has no activation {activation!r}")
        self._squash = self.description.get("squash", "tanh")
        if self._squash not in ("tanh", "clip"):
            raise ValueError(f"a policy has no squashing function {self._squash!r}")
        self._activation = np.tanh if activation == "tanh" else partial(np.maximum, np.float32(0))
        self._normalizes = activation == "normalized_relu"
        try:
            self._shape = tuple(description["observation_shape"])
            image = description.get("image_shape", self._shape if len(self._shape) == 3 else None)
            self._image_shape = None if image is None else tuple(image)
            self._low, self._high = (np.asarray(description[f"action_{end}"], np.float32) for end in ("low", "high"))
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError("a description needs observation_shape, action_low and action_high, as numbers") from error
        self._check()

    @property
    def layers(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Weight (out, in) and bias (out,) of each layer, first to last."""
        return list(self._layers)

    def _check(self) -> None:
        """Raise a ValueError if description and layers are inconsistent."""
        image = self._image_shape
        if any(type(n) is not int or n < 1 for n in (*self._shape, *(image or ()), self.description.get("pool", 1))):
            raise ValueError("observation_shape, image_shape and pool must be positive whole numbers")
        if self._low.ndim != 1 or self._low.shape != self._high.shape or not (self._low < self._high).all():
            raise ValueError("action_low and action_high must be vectors of one size, the first below the second")
        if image is not None and (len(image) != 3 or math.prod(image) > math.prod(self._shape)):
            raise ValueError("image_shape must be (height, width, channels) and fit into the observation")
        if image is not None and "pool" not in self.description:
            raise ValueError("a policy of images needs `pool`, the side of the squares over which pixels are averaged")
        if any(bias.ndim != 1 for _, bias in (*self._encoder, *self._layers)):
            raise ValueError("a bias has one number for each output of its layer")
        sizes = [self._num_features(), *(len(bias) for _, bias in self._layers)]
        expected = [(out, into) for into, out in pairwise(sizes)]
        if not self._layers or [weight.shape for weight, _ in self._layers] != expected or sizes[-1] != len(self._low):
            raise ValueError(f"layers must be a chain from {sizes[0]} features to {len(self._low)} action entries")
        numbers = [self._low, self._high, *(array for layer in (*self._encoder, *self._layers) for array in layer)]
        if any(array.dtype != np.float32 or not np.isfinite(array).all() for array in numbers):
            raise ValueError("weights and limits must be finite and of single precision")

    def _num_features(self) -> int:
        """Return the number of inputs of the first layer."""
        if self._image_shape is None:
            if self._encoder:
                raise ValueError("convolutions need an image in the observation")
            return math.prod(self._shape)
        channels, sides = self._image_shape[2], [side // self.description["pool"] for side in self._image_shape[:2]]
        for weight, bias in self._encoder:
            if weight.shape != (len(bias), channels, 3, 3) or min(sides) < 3:
                raise ValueError("convolutions must be a chain of 3 × 3 kernels that fit into the image")
            channels, sides = len(bias), [(side - 1) // 2 for side in sides]
        return channels * math.prod(sides) + math.prod(self._shape) - math.prod(self._image_shape)

    @classmethod
    def load(cls, folder: Path | str) -> Policy:
        """Read the policy that a training run saved in a folder as `policy.safetensors` and `policy.json`.

        Raises:
            InputError: If a file is missing or damaged.
        """
        folder = Path(folder)
        weights, description = folder / "policy.safetensors", folder / "policy.json"
        for path in (weights, description):
            if not path.is_file():
                raise InputError(
                    f"{folder} holds no {path.name}: train a policy first, or finish the run with --resume (--episodes "
                    "ends it early)"
                )
        try:
            values = json.loads(read_bytes(description, "description of a policy", MAX_DESCRIPTION_SIZE))
            arrays = load(read_bytes(weights, "policy's weights", MAX_WEIGHTS_SIZE))
            if values["format"] != FORMAT or values.pop("digest") != _digest(arrays, values):
                raise ValueError("the format or the digest differs")
            if "members" not in values:
                return cls._of_arrays(arrays, values)
            members = [
                Policy._of_arrays(
                    {name.removeprefix(start): arrays[name] for name in arrays if name.startswith(start)}, each
                )
                for each, start in zip(values["members"], (f"{i}." for i in range(len(values["members"]))), strict=True)
            ]
            if sum(len(member._arrays()) for member in members) != len(arrays):
                raise ValueError("every array belongs to a network")
            return Ensemble(
                members, {name: value for name, value in values.items() if name not in ("members", "format")}
            )
        except (SafetensorError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
            raise InputError(
                f"the policy in {folder} is damaged or of another version: write it again with guiderail train --resume"
            ) from error

    @classmethod
    def _of_arrays(cls, arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> Policy:
        """Return the policy of arrays as `_arrays` returns them; raise a ValueError or KeyError if they do not fit."""
        if len(arrays) % 2:
            raise ValueError("a layer has a weight and a bias")
        kinds = [name.split(".")[0] for name in arrays if name.endswith(".weight")]
        layers, encoder = (
            [(arrays[f"{kind}.{i}.weight"], arrays[f"{kind}.{i}.bias"]) for i in range(kinds.count(kind))]
            for kind in ("layers", "encoder")
        )
        return cls(layers, description, encoder)

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return weights and biases by name."""
        arrays: dict[str, np.ndarray] = {}
        for kind, stored in (("layers", self._layers), ("encoder", self._encoder)):
            for index, (weight, bias) in enumerate(stored):
                arrays |= {f"{kind}.{index}.weight": weight, f"{kind}.{index}.bias": bias}
        return arrays

    def save(self, folder: Path | str, write: Callable[[Path, bytes], Any] = Path.write_bytes) -> None:
        """Write `policy.safetensors` and `policy.json` into a folder, which is created if it is missing.

        `write` is called with the path and the content of each file.

        Raises:
            InputError: If the folder cannot be created.
        """
        folder = Path(folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{folder} cannot be created ({error.strerror}): name another folder") from error
        arrays, values = self._arrays(), self.description | {"format": FORMAT}
        values["digest"] = _digest(arrays, values)
        write(folder / "policy.safetensors", save(arrays))
        write(folder / "policy.json", json.dumps(values, indent=2).encode() + b"\n")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the action (A,) for one observation, in the units of the action space.

        Raises:
            ValueError: If the shape of the observation differs from `observation_shape`.
        """
        observation = np.asarray(observation)
        if observation.shape != self._shape:
            raise ValueError(f"the policy was trained on observations {self._shape}, not {observation.shape}")
        hidden = self._features(observation)
        for weight, bias in self._layers[:-1]:
            hidden = self._activate(weight @ hidden + bias)
        weight, bias = self._layers[-1]
        output = weight @ hidden + bias
        if self._squash == "clip":
            return np.clip(output, self._low, self._high)
        squashed = np.tanh(output)
        return self._low + np.float32(0.5) * (squashed + np.float32(1)) * (self._high - self._low)

    def _activate(self, features: np.ndarray) -> np.ndarray:
        if self._normalizes:
            features = features - features.mean()
            features = features / np.sqrt((features * features).mean() + np.float32(1e-5))
        return self._activation(features)

    def _features(self, observation: np.ndarray) -> np.ndarray:
        """Return the inputs of the first layer: features of the image, channel by channel, then the state."""
        if self._image_shape is None:
            return observation.astype(np.float32).ravel()
        height, width, channels = self._image_shape
        if observation.ndim == 3:
            image, state = np.moveaxis(observation, -1, 0).astype(np.float32) / np.float32(255), np.empty(0, np.float32)
        else:
            pixels, state = np.split(observation.astype(np.float32), [math.prod(self._image_shape)])
            image = pixels.reshape(channels, height, width)
        if (side := self.description["pool"]) > 1:
            image = image[:, : height // side * side, : width // side * side]
            image = image.reshape(channels, height // side, side, width // side, side).mean((2, 4), dtype=np.float32)
        for weight, bias in self._encoder:
            patches = np.lib.stride_tricks.sliding_window_view(image, (3, 3), axis=(1, 2))[:, ::2, ::2]
            image = np.maximum(np.tensordot(weight, patches, ((1, 2, 3), (0, 3, 4))) + bias[:, None, None], 0)
        return np.concatenate([image.ravel(), state])


@dataclass(frozen=True)
class RimSearch:
    """Lissajous figure that is added to an action while a workpiece has not entered its fixture.

    Where a contact does not show the direction to a hole, a policy stands still on the rim, and the figure moves the
    workpiece over it. It depends only on the observation.

    Args:
        time: Entry of the observation with the time, from −1 to 1 in an episode.
        height: Entry with the height.
        above: Value of this entry above which the workpiece is on the rim.
        after: Fraction of the episode after which the figure is added.
        amplitude: Amplitude in the units of an action.
        cycles: Cycles in an episode of the action's first and second entry.

    Raises:
        TypeError: If an argument is missing or no number.
        ValueError: If a number is not finite, an entry is negative, or there are not two numbers of cycles.
    """

    time: int
    height: int
    above: float
    after: float
    amplitude: float
    cycles: tuple[float, float]

    def __post_init__(self) -> None:
        numbers = (self.above, self.after, self.amplitude, *self.cycles)
        if any(type(entry) is not int or entry < 0 for entry in (self.time, self.height)) or len(self.cycles) != 2:
            raise ValueError("a search has entries of the observation, and two numbers of cycles")
        if not all(map(math.isfinite, numbers)):
            raise ValueError("the numbers of a search must be finite")

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return what is added to the first two entries of the action, (2,)."""
        passed = 0.5 * (float(observation[self.time]) + 1.0)
        if passed < self.after or observation[self.height] <= self.above:
            return np.zeros(2)
        angles = 2.0 * np.pi * passed * np.array(self.cycles)
        return self.amplitude * np.array([np.sin(angles[0]), np.cos(angles[1])])


class Ensemble(Policy):
    """Policy of several networks; its action is the mean of theirs, with the `RimSearch` of its description, if any.

    Args:
        members: Policies with the same observations and limits of actions, at least one.
        description: Content of `policy.json`; default: the description of the first member.

    Raises:
        ValueError: If the members differ in their observations or limits of actions.
    """

    def __init__(self, members: Sequence[Policy], description: Mapping[str, Any] | None = None):
        self.members = list(members)
        first = self.members[0]
        self.description = dict(first.description if description is None else description)
        for member in self.members:
            for name in ("observation_shape", "action_low", "action_high"):
                if list(member.description[name]) != list(first.description[name]):
                    raise ValueError(f"the policies of an ensemble need the same {name}")
        self.description["members"] = [member.description for member in self.members]
        search = self.description.get("search")
        self._search = None if search is None else RimSearch(**search)
        self._low, self._high = first._low, first._high
        if self._search is not None:
            is_vector, last = len(first._shape) == 1, max(self._search.time, self._search.height)
            if len(self._low) < 2 or not is_vector or last >= first._shape[0]:
                raise ValueError("a search moves two entries of an action, by entries of a vector that is observed")

    @property
    def layers(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Not available, because an ensemble has several networks.

        Raises:
            InputError: Always.
        """
        raise InputError("an ensemble has several networks: name one of the runs that it was made from")

    def _arrays(self) -> dict[str, np.ndarray]:
        return {f"{i}.{name}": array for i, each in enumerate(self.members) for name, array in each._arrays().items()}

    def actions(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions of all networks, (M, A), for one observation."""
        return np.stack([member(observation) for member in self.members])

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return the mean of the networks' actions and the search, (A,), for one observation."""
        action = self.actions(observation).mean(axis=0)
        if self._search is None:
            return action
        action[:2] += self._search(observation).astype(np.float32)
        return np.clip(action, self._low, self._high)

    def disagreement(self, observation: np.ndarray) -> float:
        """Return the standard deviation of the networks' actions, mean over the entries of the action."""
        return float(self.actions(observation).std(axis=0).mean())


def _digest(arrays: Mapping[str, np.ndarray], description: Mapping[str, Any]) -> str:
    """Return the digest of weights and description, by which damaged files are detected."""
    return digest(arrays, json.dumps(description, sort_keys=True))
