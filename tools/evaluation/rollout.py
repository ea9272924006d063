"""The loop of an episode: the same one for training, evaluation, replays, films, studies, stress and driving."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.metrics import Episode, episode_row

PolicyFn = Callable[[np.ndarray], np.ndarray]
COUNTED = {"collision", "saturation", "fallback"}


@dataclass(frozen=True)
class Transition:
    """A decision of an episode and what followed; `info` is the environment's."""

    observation: np.ndarray
    action: np.ndarray
    reward: float
    following: np.ndarray
    terminated: bool
    truncated: bool
    info: Mapping[str, Any]

    @property
    def is_last(self) -> bool:
        """Whether the episode is over."""
        return self.terminated or self.truncated


class Callback:
    """Watches an episode: a learner, a camera, a witness."""

    def on_episode_start(self) -> None:
        """Called after the environment was reset."""

    def on_step(self, decision: Transition) -> None:
        """Called after every decision."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Called with the episode's row; what it returns are further columns."""
        return {}


class EnvCallback(Callback):
    """One that also looks at what an environment's step doesn't return.

    Attributes:
        env: the environment.
        base: the same without its wrappers.
    """

    def __init__(self, env: gymnasium.Env):
        """
        Args:
            env: the environment.
        """
        self.env: Any = env
        self.base: Any = env.unwrapped


def check_seed(seed: int) -> None:
    """Refuses a seed that no environment takes.

    Raises:
        InputError: if it is negative, or does not fit into 31 bits.
    """
    if not 0 <= seed < 2**31:
        raise InputError(f"a seed is a whole number from 0 to {2**31 - 1}, not {seed}")


def rollout(
    env: gymnasium.Env,
    act: PolicyFn,
    *observers: Callback,
    index: int = 0,
    seed: int | None = None,
    held_out: bool = False,
    options: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Runs one episode and returns its row; the environment's trace is still that episode's afterwards.

    Args:
        env: the environment.
        act: the policy; one that is an observer too is told of the episode.
        observers: who watches.
        index: the row's number.
        seed: of the reset; unless given, the next conditions that training would meet.
        held_out: whether the conditions are ones that training never meets; then the seed decides them.
        options: of the reset.
    """
    observation = (
        reset_held_out(env, seed or 0, **(options or {}))
        if held_out
        else env.reset(seed=seed, options=None if options is None else dict(options))[0]
    )
    tally = _Tally(env)
    watching = (tally, *([act] if isinstance(act, Callback) and act not in observers else []), *observers)
    for observer in watching:
        observer.on_episode_start()
    over = False
    while not over:
        action = act(observation)
        following, reward, terminated, truncated, info = env.step(action)
        decision = Transition(observation, action, float(reward), following, terminated, truncated, info)
        for observer in watching:
            observer.on_step(decision)
        observation, over = following, decision.is_last
    row = tally.row(index)
    for observer in watching:
        row |= observer.on_episode_end(row)
    return row


class Paths(EnvCallback):
    """Adds the poses that were commanded and measured, (n, O) each, to an episode's row."""

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """`commanded` and `measured`."""
        trace = self.base.trace
        return {"commanded": trace.commanded.copy(), "measured": trace.measured.copy()}


class _Tally(EnvCallback):
    """Adds up what the trace and the ledger don't hold. (Where the simulation failed or a person ended the episode
    there is no ledger: then what was seen until there takes its place.)
    """

    def on_episode_start(self) -> None:
        self._terms: dict[str, float] = dict.fromkeys(self.base.task.reward_terms, 0.0)
        self._total, self._worst = 0.0, {"max_commanded_violation": -np.inf, "max_measured_violation": -np.inf}
        self._last: Mapping[str, Any] = {}

    def on_step(self, decision: Transition) -> None:
        self._total += decision.reward
        self._last = decision.info
        for name, key in zip(self._worst, ("constraint_violation", "measured_violation"), strict=True):
            self._worst[name] = max(self._worst[name], decision.info[key])
        for name in self._terms:
            self._terms[name] += float(decision.info[name])

    def row(self, index: int) -> dict[str, Any]:
        """The episode's row."""
        trace = self.base.trace
        force = np.asarray(trace.force)
        seen = {"peak_force": force.max(initial=0.0), "mean_force": force.mean() if len(force) else 0.0, **self._worst}
        if "ledger" not in self._last and trace.signals.keys() >= COUNTED:
            from guiderail.systems.safety_ledger import SafetyLedger  # Drake takes a second

            seen |= SafetyLedger.counts(trace.signals)
        failed = "simulation_failure" in self._last
        return episode_row(
            Episode(
                index=index,
                trace=trace,
                ledger={**seen, **self._last.get("ledger", {})},
                total=self._total,
                terms=self._terms,
                success=bool(self._last["is_success"]),
                termination="simulation_failure" if failed else self._last["termination"],
            )
        )


def reset_held_out(env: gymnasium.Env, seed: int, **options: Any) -> np.ndarray:
    """Starts an episode with conditions that training never meets; `options` are further ones of the reset."""
    return env.reset(seed=seed, options={"held_out": True} | options)[0]


def suits(acts: Callable[[gymnasium.Env], PolicyFn], env: gymnasium.Env) -> bool:
    """Whether what it says to a few observations are actions of the environment's shape.

    A few, because a rule may look at a number that isn't there only in the middle of an episode.
    """
    acting, shape = acts(env), env.observation_space.shape or ()
    try:
        found = {np.shape(acting(np.full(shape, value, np.float32))) for value in np.linspace(-1.0, 1.0, 21)}
    except (IndexError, ValueError):
        return False
    return found == {env.action_space.shape}


def as_learned(policy: Policy, env: gymnasium.Env) -> PolicyFn:
    """A learned policy, in an environment that may be another one than where it learned.

    Raises:
        InputError: if what it sees or moves is not this environment's.
    """
    if not suits(lambda env: policy, env):
        raise InputError("what the policy saw or moved where it learned is not what this environment has: change --env")
    return policy
