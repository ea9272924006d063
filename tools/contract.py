"""Checks that an environment of a user keeps Gymnasium's contract, with one sentence for each fault."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from numbers import Real
from typing import Any

import gymnasium
import numpy as np

from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.tools.spaces import describe_space, has_layout

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
