"""Loop over the actions of an episode, with callbacks, and the progress bar of many episodes."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.tools.contract import checked_reset, checked_step
from guiderail.tools.evaluation.episode import Callback, EnvCallback, PolicyFn, Transition, as_action
from guiderail.tools.evaluation.policies import as_policy
from guiderail.tools.spaces import (
    describe_space,
    has_layout,
    has_values,
)

if TYPE_CHECKING:
    from rich.console import Console


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
    from guiderail.tools.evaluation.metrics import Episode, episode_row, outside_row

    if not isinstance(env, gymnasium.Env):
        raise InputError(f"an episode runs in an environment, as gymnasium.make returns it, not in {brief(env)}")
    if not callable(act):
        act = as_policy(act)
    if seed is not None and (seed := as_whole(seed, "a seed")) < 0:
        raise InputError(f"a seed is a whole number of at least 0, not {seed}")
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
        episode_row(Episode(index, base.trace, total, terms, info))
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
    columns = callback.on_episode_end(row)
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


WINDOW = 10  # default number of last episodes over which success and return are averaged
INTERVAL = 10.0  # time between lines if standard error is not a terminal [s]


class EpisodeProgress:
    """Progress bar on a terminal; elsewhere, in a log file or a pipe, lines with the same content.

    It is a context manager; call `update` with the row of each episode.
    """

    def __init__(
        self,
        episodes: int,
        *,
        name: str = "training",
        window: int | None = WINDOW,
        console: Console | None = None,
        asks: bool = False,
    ):
        """Construct the progress.

        Args:
            episodes: Number of episodes of the whole run, including those before it was resumed.
            name: Name of the bar.
            window: Number of last episodes over which success and return are averaged; None for all episodes.
            console: Console; standard error by default, so that results can be piped.
            asks: True if the program asks questions while the bar is shown. The bar is then redrawn only after
                episodes, so that it covers no question.
        """
        # slow to import
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

        from guiderail.tools.console import PrintableConsole

        self._console = console or PrintableConsole(stderr=True)
        self._episodes, self._name = episodes, name
        self._done, self._count, self._window = 0, 0, window
        self._recent: deque[tuple[float, float]] = deque(maxlen=window)
        self._max_violation = float("-inf")
        self._reports_success = False
        self._started = self._printed = time.monotonic()
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[status]}"),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            console=self._console,
            auto_refresh=not asks,
            disable=not self._console.is_terminal,
        )
        self._task = self._bar.add_task(name, total=episodes, status="")

    def __enter__(self) -> EpisodeProgress:
        self._bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.stop()

    def update(self, row: Mapping[str, Any]) -> None:
        """Add a finished episode, given its row."""
        from guiderail.tools.evaluation.metrics import REPORTS_SUCCESS  # imports pandas, which takes a second

        self._done, self._count = int(row["episode"]) + 1, self._count + 1
        self._recent.append((float(row["success"]), float(row["return"])))
        self._reports_success |= bool(row.get(REPORTS_SUCCESS, True))
        violation = float(row.get("max_commanded_violation", -math.inf))
        self._max_violation = float(np.maximum(self._max_violation, violation))  # NaN if any violation is NaN
        self._bar.update(self._task, completed=self._done, status=self.status(), refresh=True)
        now = time.monotonic()
        is_due = self._count == 1 or self._done == self._episodes or now - self._printed > INTERVAL
        if self._bar.disable and is_due:
            self._printed = now
            text = f"{self._name} {self._done}/{self._episodes}  {self.status()}  {self._remaining(now)}"
            self._console.print(text, soft_wrap=True)

    def status(self) -> str:
        """Return success rate and mean return of the last episodes, and the largest violation of all, as text.

        At least one `update` must precede the call. The success rate is left out if the environment reports no success.
        """
        from guiderail.tools.evaluation.metrics import TOLERANCE, VIOLATION  # imports pandas, which takes a second

        success, returns = (sum(values) / len(self._recent) for values in zip(*self._recent, strict=True))
        violation = "none" if self._max_violation <= TOLERANCE else f"{self._max_violation:.1e} {VIOLATION}"
        prefix = "" if self._window is None else f"last {len(self._recent)}: "
        prefix += f"success {success:.0%}  " if self._reports_success else ""
        return f"{prefix}return {returns:.1f}  largest violation {violation}"

    def _remaining(self, now: float) -> str:
        if self._done == self._episodes:
            return f"done in {now - self._started:.0f} s"
        return f"{(now - self._started) / self._count * (self._episodes - self._done):.0f} s left"
