"""The learners: Stable-Baselines3's SAC and TQC with the settings of the thesis and with a robust one.

Only the networks, the replay buffer and the gradient step are Stable-Baselines3's. Acting and deciding when to train
are here, so that everything that a run depends on has a name and can be written to a checkpoint.
"""

import copy
import random
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch.nn.utils import parameters_to_vector

from guiderail.models.errors import InputError

ALGORITHMS = {"sac": SAC, "tqc": TQC}
IMAGE_POOL = 5  # pixels; 110×144×3 becomes 22×28×3


@dataclass(frozen=True)
class Preset:
    """How a learner learns. A decision is one action of the policy; it lasts `hold` control steps."""

    algorithm: str = "tqc"
    learning_rate: float = 3e-4
    discount: float = 0.995  # of one control step: a decision is discounted by discount**hold
    soft_update: float = 0.02
    train_every: int = 8  # decisions between two trainings
    gradient_steps: int = 24  # in one training
    batch_size: int = 64
    buffer_size: int = 1_000_000
    learning_starts: int = 100  # decisions drawn uniformly before the first training
    entropy: str = "auto_0.1"  # "auto", "auto_<initial value>", or a number
    units: tuple[int, ...] = (256, 256)  # of the hidden layers
    steady_episodes: int = 0  # the first ones, in which one action drawn uniformly is kept all the time
    practise: float = 0.0  # part of the episodes, evenly spread, that are acted without exploring
    averaging: float = 0.003  # how far the averaged actor follows at each gradient step; 0 for no averaged actor


_TABLE_4_1 = Preset(
    learning_rate=1e-3, discount=0.99, gradient_steps=8, batch_size=256, entropy="auto", averaging=0.0
)  # batch and buffer of table 3.2, as table 4.1 has none
_TABLE_3_2 = replace(_TABLE_4_1, learning_rate=8e-4, discount=0.95, learning_starts=1000)
_QUICK = Preset(learning_rate=1e-3, discount=0.998, gradient_steps=8, entropy="auto")

PRESETS = {
    # Measured on the connector: small batches, a moderate learning rate, and an averaged actor, because a single one
    # swings from episode to episode. Four of five episodes do not explore: white actions find the hole by wiggling, so
    # that the critic learns little about the mean, and a policy that always succeeds in training fails by itself.
    "robust": Preset(
        learning_rate=7e-4,
        train_every=4,
        gradient_steps=16,
        units=(128, 128),
        steady_episodes=8,
        practise=0.8,
        averaging=0.01,
    ),
    # Cheap enough to watch: the narrow passage within a minute.
    "quick": _QUICK,
    # The same, but the first episodes each keep to one random action. sKGRL reacts slowly: actions drawn anew at every
    # decision seldom lead it around an obstacle, and one seed of three settled between obstacle and zone.
    "steady": replace(_QUICK, steady_episodes=10),
    "table_4_1_simulation": _TABLE_4_1,
    "table_4_1_robot": replace(_TABLE_4_1, soft_update=0.01, discount=0.995, entropy="auto_0.1"),
    "table_3_2_iiwa": _TABLE_3_2,
    "table_3_2_sara": replace(_TABLE_3_2, algorithm="sac", learning_rate=1e-3, discount=0.98),
}


def resolve_preset(name: str, algorithm: str, settings: Mapping[str, Any] | None = None) -> Preset:
    """The preset of that name for an algorithm, with single settings replaced.

    Raises:
        InputError: for an unknown preset, algorithm or setting, or a value out of range.
    """
    if name not in PRESETS:
        raise InputError(f"there is no preset {name!r}: choose one of {', '.join(PRESETS)}")
    if algorithm not in ALGORITHMS:
        raise InputError(f"there is no algorithm {algorithm!r}: choose one of {', '.join(sorted(ALGORITHMS))}")
    known = {field.name for field in fields(Preset)}
    values = asdict(PRESETS[name]) | {"algorithm": algorithm}
    for key, value in (settings or {}).items():
        if key not in known or key == "algorithm":
            raise InputError(f"a learner has no setting {key!r}: choose one of {', '.join(sorted(known))}")
        values[key] = _as_setting(key, value, values[key])
    preset = Preset(**values)
    _check(preset)
    return preset


def _as_setting(key: str, value: Any, example: Any) -> Any:
    """The value, given as text or as a number, with the type that the setting has."""
    try:
        if isinstance(example, tuple):
            return tuple(int(v) for v in (value.split(",") if isinstance(value, str) else value))
        if isinstance(example, int) and not float(value).is_integer():
            raise ValueError(value)
        return type(example)(float(value)) if isinstance(example, int) else type(example)(value)
    except (TypeError, ValueError):
        raise InputError(f"the learner's {key} cannot be {value!r}: give a value such as {example!r}") from None


def _check(preset: Preset) -> None:
    """Refuses settings that no learner can use."""
    for key in ("train_every", "gradient_steps", "batch_size", "buffer_size", "learning_starts"):
        if getattr(preset, key) < 1:
            raise InputError(f"the learner's {key} must be at least 1, not {getattr(preset, key)}")
    if preset.steady_episodes < 0:
        raise InputError(f"the learner's steady_episodes must not be negative, not {preset.steady_episodes}")
    if not 0 <= preset.practise <= 1:
        raise InputError(f"the learner's practise must be between 0 and 1, not {preset.practise}")
    if not (np.isfinite(preset.learning_rate) and preset.learning_rate > 0):
        raise InputError(f"the learner's learning_rate must be positive, not {preset.learning_rate}")
    for key, low in (("discount", 0.0), ("soft_update", 0.0), ("averaging", -1e-300)):
        if not low < getattr(preset, key) <= 1:
            raise InputError(f"the learner's {key} must be between 0 and 1, not {getattr(preset, key)}")
    if not preset.units or min(preset.units) < 1:
        raise InputError(f"the learner's units must be positive numbers, one a hidden layer, not {preset.units}")
    initial = preset.entropy.removeprefix("auto").removeprefix("_")
    try:
        usable = (preset.entropy == "auto") or float(initial) > 0
    except ValueError:
        usable = False
    if not usable:
        raise InputError(f"the learner's entropy must be auto, auto_0.1 or a positive number, not {preset.entropy!r}")


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


class Learner:
    """An off-policy algorithm of Stable-Baselines3 that is told when to act, to remember and to learn."""

    def __init__(self, preset: Preset, env: gymnasium.Env, *, hold: int, seed: int, decisions: int):
        """
        Args:
            preset: how to learn.
            env: for its spaces only.
            hold: control steps that an action lasts.
            seed: of the networks, and of everything drawn in training.
            decisions: the most that this run can take, so that the replay buffer asks for no more memory than it uses.
        """
        networks: dict[str, Any] = {"net_arch": list(preset.units), "optimizer_kwargs": {"fused": True}}
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
            gamma=preset.discount**hold,
            ent_coef=preset.entropy if preset.entropy.startswith("auto") else float(preset.entropy),
            policy_kwargs=networks,
            seed=seed,
            device="cpu",
        )
        self.model.set_logger(Logger(folder=None, output_formats=[]))
        self.random = np.random.default_rng(seed)
        self.averaged = copy.deepcopy(self.model.actor) if preset.averaging else None
        self.episodes = 0
        self._practises = False
        self._steady: np.ndarray | None = None

    def begin(self) -> None:
        """Begins an episode, and decides how it explores."""
        self.episodes += 1
        share = self.preset.practise
        self._practises = int(self.episodes * share) > int((self.episodes - 1) * share)
        self._steady = self._uniform() if self.episodes <= self.preset.steady_episodes else None

    def act(self, observation: np.ndarray) -> np.ndarray:
        """An exploring action: uniform until learning starts, then drawn from the policy.

        White actions blur what an action is worth: on the connector they find the hole by wiggling, whatever the policy
        wants. Episodes that keep to one action, or to the policy's mean, say what that action or that mean is worth.
        """
        if self._steady is not None:
            return self._steady
        if self.decisions < self.preset.learning_starts:
            return self._uniform()
        if not self._practises:
            return self.model.predict(observation, deterministic=False)[0]
        with torch.no_grad():
            return self.actor()._predict(self.model.policy.obs_to_tensor(observation)[0], deterministic=True)[0].numpy()

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
        self.model.replay_buffer.add(
            observation, following, action, np.array([reward]), np.array([terminated or truncated]), infos
        )
        self.decisions += 1

    def learn(self) -> None:
        """Trains if it is time to: every `train_every` decisions of the whole run, whatever the episodes' lengths."""
        if self.decisions < self.preset.learning_starts or self.decisions % self.preset.train_every:
            return
        self.model.train(self.preset.gradient_steps, self.preset.batch_size)
        if self.averaged is not None:
            follow = 1.0 - (1.0 - self.preset.averaging) ** self.preset.gradient_steps
            with torch.no_grad():
                for mean, value in zip(self.averaged.parameters(), self.model.actor.parameters(), strict=True):
                    mean.lerp_(value, follow)

    def actor(self) -> Any:
        """The network whose mean action is the result: the averaged one where there is one."""
        return self.model.actor if self.averaged is None else self.averaged

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
        buffer = self.model.replay_buffer
        arrays |= {f"buffer/{k}": getattr(buffer, k)[: buffer.size()] for k in self._buffer_names()}
        arrays["random/torch"] = torch.get_rng_state().numpy()
        kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 (Stable-Baselines3 samples from it)
        arrays["random/numpy"] = np.asarray(keys)
        return arrays, {
            "decisions": self.decisions,
            "episodes": self.episodes,
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
        torch.set_rng_state(tensors["random/torch"])
        kind, *rest = values["numpy"]
        np.random.set_state((kind, arrays["random/numpy"], *rest))  # noqa: NPY002
        version, state, gauss = values["python"]
        random.setstate((version, tuple(state), gauss))
        self.random.bit_generator.state = values["own"]

    @staticmethod
    def _buffer_names() -> tuple[str, ...]:
        return ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")
