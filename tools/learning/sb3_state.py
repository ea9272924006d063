"""State of Stable-Baselines3 networks, optimizers and random generators, as arrays and values of a checkpoint."""

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch


def module_arrays(
    modules: Mapping[str, torch.nn.Module], optimizers: Mapping[str, torch.optim.Optimizer]
) -> dict[str, np.ndarray]:
    """Return the parameters and buffers of modules and the moments of optimizers, by names that start with theirs."""
    arrays: dict[str, np.ndarray] = {}
    for name, module in modules.items():
        arrays |= {f"{name}/{key}": value.numpy() for key, value in module.state_dict().items()}
    for name, optimizer in optimizers.items():
        for index, moments in optimizer.state_dict()["state"].items():
            arrays |= {f"optimizer/{name}/{index}/{key}": value.numpy() for key, value in moments.items()}
    return arrays


def restore_modules(
    tensors: Mapping[str, torch.Tensor],
    modules: Mapping[str, torch.nn.Module],
    optimizers: Mapping[str, torch.optim.Optimizer],
) -> None:
    """Set modules and optimizers to what `module_arrays` returned, as tensors."""
    for name, module in modules.items():
        own = {k[len(name) + 1 :]: v for k, v in tensors.items() if k.startswith(name + "/")}
        # Files hold arrays of at least one dimension; a counter of steps has none.
        shapes = {key: value.shape for key, value in module.state_dict().items()}
        module.load_state_dict({k: v.reshape(shapes.get(k, v.shape)) for k, v in own.items()})
    for name, optimizer in optimizers.items():
        moments: dict[int, dict[str, torch.Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith(f"optimizer/{name}/"):
                _, _, index, moment = key.split("/")
                moments.setdefault(int(index), {})[moment] = value
        optimizer.load_state_dict({"state": moments, "param_groups": optimizer.state_dict()["param_groups"]})


def random_state() -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the states of the random generators that Stable-Baselines3 draws from, those of the process."""
    kind, keys, *rest = np.random.get_state(legacy=True)  # noqa: NPY002 (Stable-Baselines3 samples from it)
    arrays = {"random/torch": torch.get_rng_state().numpy(), "random/numpy": np.asarray(keys)}
    return arrays, {"numpy": [kind, *rest], "python": random.getstate()}


def restore_random(arrays: Mapping[str, np.ndarray], values: Mapping[str, Any]) -> None:
    """Set the random generators of the process to what `random_state` returned."""
    torch.set_rng_state(torch.from_numpy(np.array(arrays["random/torch"])))
    kind, *rest = values["numpy"]
    np.random.set_state((kind, arrays["random/numpy"], *rest))  # noqa: NPY002
    version, state, gauss = values["python"]
    random.setstate((version, tuple(state), gauss))
