"""Gymnasium's contract: layouts of spaces, values to test a policy, and checks of an environment's results.

The layout of a space consists of its kind, the shapes and numbers of values of its parts, and the names of the parts.
Bounds of a `Box` and its data type do not belong to it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import deepcopy
from numbers import Real
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from guiderail.models.common.errors import InputError, brief, naming_failures

NUM_PROBES = 21  # number of values with which a policy is tested


def _parts(space: Any) -> dict[Any, Any] | None:
    """Return the parts of a `Dict` by name or of a `Tuple` by index; None for another space."""
    if isinstance(space, spaces.Dict):
        return dict(space.spaces)
    return dict(enumerate(space.spaces)) if isinstance(space, spaces.Tuple) else None


def layout(space: Any) -> Any:
    """Return the layout of a space, which equals the layout of another space if a policy can take both; None for None.

    A number of values is counted from the space's `start`. Spaces that are no arrays have their own equality.
    """
    if (parts := _parts(space)) is not None:
        return type(space).__name__, {name: layout(part) for name, part in parts.items()}
    if isinstance(space, spaces.Discrete):
        return "Discrete", int(space.n), int(space.start)
    if isinstance(space, spaces.MultiDiscrete):
        return "MultiDiscrete", space.nvec.tolist(), space.start.tolist()
    if isinstance(space, spaces.MultiBinary):
        return "MultiBinary", space.shape
    shape = getattr(space, "shape", None)
    return space if shape is None or isinstance(space, spaces.Text) else ("Box", tuple(shape))


def takes_observations(given: Any, space: Any) -> bool:
    """Return True if a model with the observation space `given` takes the observations of an environment's `space`.

    The model's images may have the channels first where the environment has them last: Stable-Baselines3 converts them.
    """
    own, other = _parts(given), _parts(space)
    if own is not None and other is not None and type(given) is type(space):
        return own.keys() == other.keys() and all(takes_observations(own[name], other[name]) for name in own)
    if layout(given) == layout(space):
        return True
    is_image = isinstance(given, spaces.Box) and isinstance(space, spaces.Box) and given.dtype == np.uint8
    return is_image and len(space.shape) == 3 and given.shape == (space.shape[2], *space.shape[:2])


def describe_space(space: Any) -> str:
    """Return the layout of a space as text, such as `(3,)`, `Discrete(4)` or `{goal: (2,), phase: Discrete(3)}`."""
    if (parts := _parts(space)) is not None:
        if isinstance(space, spaces.Tuple):
            return f"({', '.join(map(describe_space, parts.values()))})"
        return f"{{{', '.join(f'{name}: {describe_space(part)}' for name, part in parts.items())}}}"
    return str(tuple(space.shape)) if isinstance(space, spaces.Box) else " ".join(str(space).split())


def probes(space: Any) -> Iterator[Any]:
    """Yield `NUM_PROBES` observations of a space, to test a policy.

    A `Box` of floating-point numbers has constant arrays from −1 to 1; a scripted policy may read some components only
    for certain values of the others. Spaces that are no arrays are sampled, without a change of their random stream.
    """
    space = deepcopy(space)
    space.seed(0)
    for index in range(NUM_PROBES):
        yield _probe(space, index)


def _probe(space: Any, index: int) -> Any:
    parts = _parts(space)
    if parts is not None:
        values = {name: _probe(part, index) for name, part in parts.items()}
        return values if isinstance(space, spaces.Dict) else tuple(values.values())
    if isinstance(space, spaces.Discrete):
        return space.start + np.int64(index % space.n)
    if isinstance(space, spaces.MultiDiscrete):
        return (space.start + index % space.nvec).astype(space.dtype)
    if isinstance(space, spaces.MultiBinary):
        return np.full(space.shape, index % 2, space.dtype)
    if not isinstance(space, spaces.Box):
        return space.sample()
    value = np.linspace(-1.0, 1.0, NUM_PROBES)[index]
    if space.dtype.kind == "f":
        return np.full(space.shape, value, np.float32 if space.dtype == np.float64 else space.dtype)
    low, high = space.low.astype(float), space.high.astype(float)
    return np.round(low + (value + 1.0) / 2.0 * (high - low)).astype(space.dtype)


def has_layout(value: Any, space: Any) -> bool:
    """Return True if a value has the parts and shapes of a space; bounds and data types are not compared."""
    if (parts := _parts(space)) is not None:
        if isinstance(space, spaces.Dict):
            return isinstance(value, Mapping) and value.keys() == parts.keys() and _all_fit(value, parts)
        return isinstance(value, tuple | list) and len(value) == len(parts) and _all_fit(value, parts)
    shape = getattr(space, "shape", None)
    if shape is None or isinstance(space, spaces.Text):
        return bool(space.contains(value))
    try:
        return value is not None and np.shape(value) == tuple(shape)
    except (TypeError, ValueError):  # ragged, or no array
        return False


def _all_fit(values: Any, parts: Mapping[Any, Any]) -> bool:
    return all(has_layout(values[name], part) for name, part in parts.items())


def has_values(value: Any, space: Any) -> bool:
    """Return True if a value of a space's layout is in range in every part that has finitely many values."""
    if (parts := _parts(space)) is not None:
        return all(has_values(value[name], part) for name, part in parts.items())
    if isinstance(space, spaces.Discrete):
        first, number = space.start, space.n
    elif isinstance(space, spaces.MultiDiscrete):
        first, number = space.start, space.nvec
    elif isinstance(space, spaces.MultiBinary):
        first, number = 0, 2
    else:
        return True
    try:
        counted = np.asarray(value) - first
        return bool(((counted >= 0) & (counted < number)).all())
    except TypeError:  # not numbers
        return False


def from_tensors(value: Any) -> Any:
    """Return a policy's action in which tensors are NumPy arrays; an action without tensors is returned unchanged.

    Tensors may have gradients, be on a device, be sparse, or have a data type that NumPy lacks.
    """
    if isinstance(value, Mapping):
        return {name: from_tensors(entry) for name, entry in value.items()} if _has_tensor(value.values()) else value
    if isinstance(value, list | tuple):
        return [from_tensors(entry) for entry in value] if _has_tensor(value) else value
    if not _is_tensor(value):
        return value
    try:
        if hasattr(value, "get") and not hasattr(value, "detach"):  # CuPy
            return np.asarray(value.get())
        tensor = value.detach().cpu()
        tensor = tensor.to_dense() if getattr(tensor, "is_sparse", False) else tensor
        is_unknown = str(tensor.dtype) in {"torch.bfloat16", "torch.float8_e4m3fn", "torch.float8_e5m2"}
        tensor = tensor.float() if is_unknown else tensor
        return np.asarray(tensor.resolve_conj().resolve_neg().numpy())
    except Exception as error:  # of another library
        raise InputError(
            f"the policy returned {brief(value)}, which cannot be converted to an array: return a NumPy array"
        ) from error


def _has_tensor(values: Any) -> bool:
    return any(_is_tensor(value) or (isinstance(value, list | tuple) and _has_tensor(value)) for value in values)


def _is_tensor(value: Any) -> bool:
    is_foreign_array = hasattr(value, "__cuda_array_interface__") and hasattr(value, "get")
    return callable(getattr(value, "detach", None)) or is_foreign_array


_UNCHANGED = (gymnasium.error.ResetNeeded,)  # exceptions of an environment that are part of the contract


def checked_reset(
    env: gymnasium.Env, seed: int | None = None, options: Mapping[str, Any] | None = None
) -> tuple[Any, dict[str, Any]]:
    """Reset an environment; return the observation and `info`."""
    with naming_failures("the environment's reset", *_UNCHANGED):
        try:
            result: Any = env.reset(seed=seed, options=None if options is None else dict(options))
        except TypeError as error:
            if not re.search(r"reset\(\) got an unexpected keyword argument '(seed|options)'", str(error)):
                raise
            raise InputError(
                f"the environment's reset lacks an argument ({error}): declare it as reset(self, *, seed=None, "
                "options=None)"
            ) from error
    return check_reset_result(env, result)


def check_reset_result(env: gymnasium.Env, result: Any) -> tuple[Any, dict[str, Any]]:
    """Return the result of a reset; see `checked_reset` for the errors."""
    if not (isinstance(result, tuple) and len(result) == 2):
        raise InputError(
            f"the environment's reset returned {_count(result)}: it returns two values, the observation and info"
        )
    _check_observation(result[0], env, "reset")
    _check_info(result[1], "reset")
    return result


def checked_step(env: gymnasium.Env, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Step an environment; return observation, reward, terminated, truncated and `info`."""
    with naming_failures("the environment's step", *_UNCHANGED), naming_wrong_counts():
        result: Any = env.step(action)
    return check_step_result(env, result)


@contextmanager
def naming_wrong_counts() -> Iterator[None]:
    """Convert the error of a wrapper that unpacks a wrong number of results of a step to an `InputError`."""
    try:
        yield
    except (TypeError, ValueError) as error:
        if not re.search("to unpack|cannot unpack", str(error)):
            raise
        raise InputError(
            f"the environment's step does not return five values, or a wrapper cannot unpack them ({error}): return "
            "observation, reward, terminated, truncated and info"
        ) from error


def check_step_result(env: gymnasium.Env, result: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
    """Return the result of a step with a reward of type float; see `checked_step` for the errors."""
    if not (isinstance(result, tuple) and len(result) == 5):
        old = ", as in the former package gym" if isinstance(result, tuple) and len(result) == 4 else ""
        raise InputError(
            f"the environment's step returned {_count(result)}{old}: it returns five values, observation, reward, "
            "terminated, truncated and info"
        )
    observation, reward, terminated, truncated, info = result
    _check_observation(observation, env, "step")
    number = _scalar(reward)
    if not isinstance(number, Real) or isinstance(number, bool | np.bool_) or not math.isfinite(number):
        raise InputError(f"the environment returned {brief(reward)} as reward: a reward is a finite number")
    if has_nan(observation):
        raise InputError("the environment returned an observation that contains NaN: check its step")
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        value = _scalar(flag)
        if not (isinstance(value, bool | np.bool_) or (isinstance(value, Real) and value in (0, 1))):
            raise InputError(f"the environment returned {brief(flag)} as {name}: it is True or False")
    _check_info(info, "step")
    return observation, float(number), bool(_scalar(terminated)), bool(_scalar(truncated)), info


def check_values(env: gymnasium.Env, observation: Any, action: Any = None) -> None:
    """Check that an observation, and an action that is not None, are within their spaces and have their data types."""
    for name, value, space in (
        ("observation", observation, env.observation_space),
        ("action", action, env.action_space),
    ):
        if value is not None and not space.contains(value):
            dtype = getattr(value, "dtype", None)
            kind = "" if dtype is None else f" of type {dtype}"
            raise InputError(
                f"the {name} {brief(value)}{kind} is not in the environment's {name} space {brief(space)}: correct the "
                "space, or the value"
            )


def has_nan(observation: Any) -> bool:
    """Return True if an observation, or one of its entries, is an array of floating-point numbers with NaN."""
    if isinstance(observation, Mapping):
        return any(map(has_nan, observation.values()))
    if isinstance(observation, tuple):
        return any(map(has_nan, observation))
    is_array = isinstance(observation, np.ndarray | np.floating)
    return is_array and observation.dtype.kind == "f" and bool(np.isnan(observation).any())


def _scalar(value: Any) -> Any:
    """Return the element of a NumPy array or a tensor without dimensions; another value is returned unchanged."""
    return value.item() if getattr(value, "shape", None) == () and hasattr(value, "item") else value


def _check_observation(observation: Any, env: gymnasium.Env, source: str) -> None:
    space = env.observation_space
    if space is not None and not has_layout(observation, space):
        shape = getattr(observation, "shape", None)
        what = brief(observation) if shape is None else f"an array of shape {tuple(shape)}"
        raise InputError(
            f"the environment's {source} returned the observation {what}, and its observation space is "
            f"{describe_space(space)}: return observations of that space"
        )


def _check_info(info: Any, source: str) -> None:
    if not isinstance(info, Mapping):
        raise InputError(f"the environment's {source} returned {brief(info)} as info: info is a dictionary")


def _count(result: Any) -> str:
    return f"{len(result)} values" if isinstance(result, tuple) else brief(result)
