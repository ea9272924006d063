"""Loop over the actions of an episode, with callbacks."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import gymnasium

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.tools.evaluation.episode import Callback, EnvCallback, PolicyFn, Transition, as_action
from guiderail.tools.evaluation.policies import as_policy
from guiderail.tools.spaces import (
    checked_reset,
    checked_step,
    describe_space,
    has_layout,
    has_values,
)


def rollout(
    env: gymnasium.Env,
    act: PolicyFn,
    *callbacks: Callback,
    index: int = 0,
    seed: int | None = None,
    held_out: bool = False,
    options: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Run one episode and return its statistics as a table row.

    Afterwards the environment's trace contains the episode. An environment of another package has no trace, and its row
    has fewer columns; see `outside_row`.

    Args:
        env: Environment.
        act: Policy, a function or an object with a `predict` method; if it is a `Callback`, its callback methods are
            called too.
        callbacks: Callbacks, called in this order, after the policy.
        index: Number of the episode, for its row.
        seed: Seed of the reset, a whole number of at least 0. None: the random stream continues, or the seed is 0 if
            `held_out` is True.
        held_out: True to sample the conditions from the held-out distribution instead of that of training.
        options: Options of the reset.

    Raises:
        InputError: If `env` is no environment, `act` is no policy, the seed is invalid, the reset is refused, an action
            is invalid, an environment of another package raises an exception or breaks Gymnasium's contract
            (`checked_step`), or a callback returns wrong columns (`new_columns`).
    """
    from guiderail.tools.evaluation.metrics import episode_row, outside_row

    if not callable(act):
        act = as_policy(act)
    seed = None if seed is None else as_whole(seed, "a seed", 0)
    base: Any = env.unwrapped
    is_own = hasattr(base, "trace")
    reset_options = None if options is None else dict(options)
    if held_out:  # an environment of another package has no such option: its conditions depend on the seed
        seed = seed or 0
        reset_options = {"held_out": True, **(reset_options or {})} if is_own else reset_options or None
    reset = env.reset if is_own else partial(checked_reset, env)
    step = env.step if is_own else partial(checked_step, env)
    observation, _ = reset(seed=seed, options=reset_options)
    if isinstance(act, Callback) and act not in callbacks:
        callbacks = (act, *callbacks)
    for callback in callbacks:
        callback.on_episode_start()
    total, terms = 0.0, dict.fromkeys(base.diagram.reward_terms if is_own else (), 0.0)
    infos: list[Mapping[str, Any]] = []  # `info` of each step, for an environment without a trace
    is_over = False
    while not is_over:
        action, privileged = as_action(act(observation), env), getattr(base, "privileged", None)
        if not is_own:
            _check_action(action, env)
        next_observation, reward, terminated, truncated, info = step(action)
        transition = Transition(
            observation, action, float(reward), next_observation, terminated, truncated, info,
            privileged, getattr(base, "privileged", None),
        )  # fmt: skip
        total += transition.reward
        terms = {name: value + float(info[name]) for name, value in terms.items()}
        if not is_own:
            infos.append(info)
        for callback in callbacks:
            callback.on_step(transition)
        observation, is_over = next_observation, transition.is_last
    row = (
        episode_row(index, base.trace, total, terms, info)
        if is_own
        else outside_row(index, total, infos, is_terminated=terminated)
    )
    for callback in callbacks:
        row |= new_columns(callback, row)
    return row


def _check_action(action: Any, env: gymnasium.Env) -> None:
    """Raise an InputError if an action does not have the layout of the action space, or is outside a discrete space."""
    space = env.action_space
    if not has_layout(action, space):
        raise InputError(
            f"the policy returned {brief(action)}, and the actions of this environment have the shape "
            f"{describe_space(space) if space.shape is None else space.shape}"
        )
    if not has_values(action, space):
        values = describe_space(space)
        if isinstance(space, gymnasium.spaces.Discrete):
            values = f"{space.start} to {space.start + space.n - 1}"
        raise InputError(f"the policy returned {brief(action)}, and the actions of this environment are {values}")


def new_columns(callback: Callback, row: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the columns that a callback adds to an episode's row."""
    columns = callback.on_episode_end(row) or {}
    if not isinstance(columns, Mapping):
        raise InputError(f"{type(callback).__name__}.on_episode_end must return a dictionary, not {brief(columns)}")
    if taken := sorted(set(columns) & set(row)):
        raise InputError(
            f"{type(callback).__name__}.on_episode_end returns the column {taken[0]!r}, which every episode has "
            "already: choose another name"
        )
    return columns


class Paths(EnvCallback):
    """Callback that adds the commanded and measured poses, (n, O) each, to an episode's row."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return the columns `commanded` and `measured`."""
        trace = self.base.trace
        return {"commanded": trace.commanded.copy(), "measured": trace.measured.copy()}
