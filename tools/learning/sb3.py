"""Adapters for Stable-Baselines3: callbacks, a replay buffer with demonstrations, and state as checkpoint arrays."""

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.type_aliases import ReplayBufferSamples
from stable_baselines3.common.vec_env import VecNormalize

from guiderail.models.common.errors import InputError, brief
from guiderail.tools.evaluation.episode import Callback, Transition
from guiderail.tools.learning.checkpoint import entries_of
from guiderail.tools.learning.learner import Learner


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


def module_arrays(
    modules: Mapping[str, torch.nn.Module], optimizers: Mapping[str, torch.optim.Optimizer]
) -> dict[str, np.ndarray]:
    """Return the parameters and buffers of modules and the moments of optimizers as arrays by name."""
    arrays: dict[str, np.ndarray] = {}
    for name, module in modules.items():
        arrays |= {f"{name}/{key}": value.cpu().numpy() for key, value in module.state_dict().items()}
    for name, optimizer in optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{name}/{index}/{key}": value.cpu().numpy() for key, value in moments.items()}
    return arrays


def restore_modules(
    arrays: Mapping[str, Any],
    modules: Mapping[str, torch.nn.Module],
    optimizers: Mapping[str, torch.optim.Optimizer],
) -> None:
    """Restore modules and optimizers from a result of `module_arrays`; the moments of optimizers must be tensors."""
    for name, module in modules.items():
        load_module(module, entries_of(arrays, name))
    for name, optimizer in optimizers.items():
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in entries_of(arrays, f"optimizer/{name}").items():
            index, moment = key.split("/")
            moments.setdefault(int(index), {})[moment] = value
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})


def load_module(module: torch.nn.Module, arrays: Mapping[str, Any]) -> None:
    """Set the parameters and buffers of a module from arrays or tensors by name.

    Each array is reshaped to the module's shape, because safetensors stores 0-d arrays, such as step counters, as 1-d.
    """
    shapes = {name: value.shape for name, value in module.state_dict().items()}
    tensors = {name: torch.as_tensor(value) for name, value in arrays.items()}
    module.load_state_dict({name: value.reshape(shapes.get(name, value.shape)) for name, value in tensors.items()})


def random_state() -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the states of the global random generators, which Stable-Baselines3 samples from.

    Returns:
        Arrays by name, and JSON-serializable values.
    """
    kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 (Stable-Baselines3 samples from it)
    arrays = {"random/torch": torch.get_rng_state().numpy(), "random/numpy": np.asarray(keys)}
    if torch.cuda.is_initialized():  # so that a resumed run samples the same numbers
        arrays["random/cuda"] = torch.cuda.get_rng_state().numpy()
    version, state, gauss = random.getstate()
    return arrays, {"numpy": [kind, *rest], "python": [version, list(state), gauss]}


def restore_random(arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
    """Set the global random generators to the states that `random_state` returned."""
    torch.set_rng_state(torch.from_numpy(np.array(arrays["random/torch"])))
    if "random/cuda" in arrays:
        torch.cuda.set_rng_state(torch.from_numpy(np.array(arrays["random/cuda"])))
    kind, *rest = values["numpy"]
    np.random.set_state((kind, arrays["random/numpy"], *rest))  # noqa: NPY002
    version, state, gauss = values["python"]
    random.setstate((version, tuple(state), gauss))


class Sb3Callbacks(Callback):
    """Adapter that calls callbacks of Stable-Baselines3 in the episodes of a run.

    The callbacks receive the learner's `model`, an algorithm of Stable-Baselines3. `num_timesteps` counts the run's
    transitions, including those before it was resumed. `locals` has the entries `infos`, `rewards`, `dones`, `actions`
    and `new_obs`, each of length 1 as for one environment.

    Attributes:
        is_stopped: True once a callback returned False from `on_step`; training ends after the episode.
    """

    def __init__(self, callbacks: Any, learner: Learner):
        """Construct the adapter for one or several callbacks of Stable-Baselines3."""
        model = getattr(learner, "model", None)
        if model is None:
            raise InputError(f"{type(learner).__name__} has no Stable-Baselines3 model, which its callbacks need")
        callback_list = list(callbacks) if isinstance(callbacks, list | tuple) else [callbacks]
        for callback in callback_list:
            if not isinstance(callback, BaseCallback):
                raise InputError(f"{brief(callback)} is no callback of Stable-Baselines3: derive it from BaseCallback")
        self._model, self._callback, self._is_started = model, CallbackList(callback_list), False
        # Transitions of the run that `init_from` names are not counted.
        self._learner, self._first = learner, getattr(learner, "transitions", 0)
        self.is_stopped = False

    def on_episode_start(self) -> None:
        """Report the start of training before the first episode, and the start of a rollout in each episode."""
        if not self._is_started:
            self._model.num_timesteps = getattr(self._learner, "transitions", 0) - self._first
            self._callback.init_callback(self._model)
            self._callback.on_training_start({"self": self._model}, {})
            self._is_started = True
        self._callback.on_rollout_start()

    def on_step(self, transition: Transition) -> None:
        """Call `on_step` of the callbacks."""
        self._model.num_timesteps += 1
        self._callback.update_locals(
            {
                "infos": [dict(transition.info)],
                "rewards": [transition.reward],
                "dones": [transition.is_last],
                "actions": [transition.action],
                "new_obs": transition.next_observation[None],
            }
        )
        self.is_stopped = not self._callback.on_step() or self.is_stopped

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Report the end of the rollout."""
        self._callback.on_rollout_end()
        return {}

    def close(self) -> None:
        """Report the end of training."""
        if self._is_started:
            self._callback.on_training_end()
