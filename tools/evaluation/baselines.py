"""Policies that show the success rate of a task without learning: baseline policies, and a task's scripted policies.

Baseline policies ignore the observation.
"""

from collections.abc import Callable, Mapping
from copy import copy
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np

from guiderail.diagrams.envs.options import STANDARD
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.evaluation.episode import Callback, PolicyFn
from guiderail.tools.evaluation.policies import ENDINGS

HOLD = 10  # number of times that `random_hold` applies each action
SWITCH_PROBABILITY = 0.1  # probability per action that `bang_bang` samples a corner again

# Function that makes the policy of an episode from a random generator and the size of an action.
BaselineFactory = Callable[[np.random.Generator, int], PolicyFn]
# Function that makes a policy for an environment.
MakePolicy = Callable[[gymnasium.Env], PolicyFn]


def zero(rng: np.random.Generator, size: int) -> PolicyFn:
    """Return the policy of zero actions: guidance alone, which follows the demonstrations if there are any."""
    return lambda observation: np.zeros(size, np.float32)


def uniform_random(rng: np.random.Generator, size: int) -> PolicyFn:
    """Return a policy of independent uniform actions in [−1, 1]."""
    return lambda observation: rng.uniform(-1.0, 1.0, size)


def constant(rng: np.random.Generator, size: int) -> PolicyFn:
    """Return a policy of one uniform action in [−1, 1] for the whole episode."""
    return _repeat(lambda: rng.uniform(-1.0, 1.0, size), lambda count: False)


def random_hold(rng: np.random.Generator, size: int) -> PolicyFn:
    """Return a policy of uniform actions, each applied `HOLD` times to move further than with independent actions."""
    return _repeat(lambda: rng.uniform(-1.0, 1.0, size), lambda count: count % HOLD == 0)


def bang_bang(rng: np.random.Generator, size: int) -> PolicyFn:
    """Return a policy of actions at a corner of [−1, 1]^size, which is sampled again with `SWITCH_PROBABILITY`."""
    return _repeat(lambda: rng.choice([-1.0, 1.0], size), lambda count: rng.uniform() < SWITCH_PROBABILITY)


def random_corner(rng: np.random.Generator, size: int) -> PolicyFn:
    """Return a policy of one random corner of [−1, 1]^size for the whole episode."""
    return _repeat(lambda: rng.choice([-1.0, 1.0], size), lambda count: False)


def _repeat(sample: Callable[[], np.ndarray], is_due: Callable[[int], bool]) -> PolicyFn:
    """Return a policy that repeats a sampled action until `is_due(number of actions so far)`, then samples again."""
    count, action = 0, sample()

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal count, action
        if count > 0 and is_due(count):
            action = sample()
        count += 1
        return action

    return act


BASELINES: dict[str, BaselineFactory] = {
    factory.__name__: factory for factory in (zero, uniform_random, constant, random_hold, bang_bang, random_corner)
}


class BaselinePolicy(Callback):
    """Policy that ignores the observation, with a new random generator in every episode."""

    def __init__(self, factory: BaselineFactory, env: gymnasium.Env, seed: int = 0):
        """Construct the policy with the action size of `env`; the generator of episode number i has the seed [seed, i].

        The episodes are numbered from 0. `start_episode` sets the number of the next episode.
        """
        self._factory, self._seed, self._episode = factory, seed, -1
        self._size = int(np.prod(env.action_space.shape or ()))
        self._act: PolicyFn = zero(np.random.default_rng(0), self._size)

    def start_episode(self, number: int) -> None:
        """Set the number of the next episode, so that it does not depend on the earlier episodes of this process."""
        self._episode = number - 1

    def on_episode_start(self) -> None:
        """Make the policy of the next episode."""
        self._episode += 1
        with naming_failures(f"the baseline policy {getattr(self._factory, '__name__', brief(self._factory))}"):
            self._act = self._factory(np.random.default_rng([self._seed, self._episode]), self._size)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Return an action (A,) in [−1, 1]."""
        return self._act(observation)


zero_policy: MakePolicy = partial(BaselinePolicy, zero)
"""Make the policy of zero actions for an environment."""


def digest_of(make_policy: MakePolicy) -> str | None:
    """Return an identifier of a function that makes a policy, for the names of stored files.

    It is the name of a baseline policy, with the seed unless that is 0. The result is None for functions other than
    `partial(BaselinePolicy, FACTORY)` with a factory of `BASELINES`, because they may read files and variables.
    """
    if isinstance(make_policy, partial) and make_policy.func is BaselinePolicy and {*make_policy.keywords} <= {"seed"}:
        for name, factory in BASELINES.items():
            if make_policy.args == (factory,):
                seed = make_policy.keywords.get("seed", 0)
                return f"{name} {seed}" if seed else name
    return None


def constant_policy(env: gymnasium.Env, action: np.ndarray) -> BaselinePolicy:
    """Return the policy that returns the same action (A,) at every step of every episode."""
    return BaselinePolicy(lambda rng, size: lambda observation: np.asarray(action, np.float32), env)


def scripted_policies(task: str, difficulty: str = STANDARD) -> Mapping[str, PolicyFn]:
    """Return a task's scripted policies by name, the default for `difficulty` first; empty for an unregistered task."""
    if task not in TASKS.names():
        return {}
    policies, defaults = TASKS.get(task).scripted_policies, TASKS.get(task).scripted_defaults
    first = [defaults[difficulty]] if difficulty in defaults else []
    return {policy.__name__: copy(policy) for policy in (*first, *policies)}  # a policy with state is not shared


def find_scripted_policy(task: str, name: str, difficulty: str = STANDARD) -> PolicyFn:
    """Return a task's scripted policy by its name; "scripted" is the default for the difficulty."""
    policies = scripted_policies(task, difficulty)
    if name == "scripted" and policies:
        return next(iter(policies.values()))
    if name not in policies:
        hint = _file_hint(name) or did_you_mean(name, [*policies, *BASELINES])
        raise InputError(f"{task} has no policy {name!r}: {hint}")
    return policies[name]


def _file_hint(name: str) -> str:
    """Return advice on how to give a policy's file, if `name` ends in .py or lacks the ending of a file; else ""."""
    if name.endswith(".py"):
        return f"give the file with the name of its function, as {name}:FUNCTION"
    file = next((name + ending for ending in ENDINGS if Path(name + ending).is_file()), None)
    return "" if file is None else f"to evaluate the file {file}, give its whole name"


def make_baseline(task: str, name: str, seed: int = 0) -> MakePolicy:
    """Return a function that makes a baseline policy, or a scripted policy of a task, for an environment.

    The name is a key of `BASELINES`, the name of a scripted policy, or "scripted" for the default of the difficulty.
    `seed` is the seed of a baseline policy's random generators.
    """
    if name in BASELINES:
        return partial(BaselinePolicy, BASELINES[name], seed=seed)
    find_scripted_policy(task, name)

    def make_policy(env: gymnasium.Env) -> PolicyFn:
        config = getattr(cast(Any, env.unwrapped).diagram, "config", None)
        return find_scripted_policy(task, name, getattr(config, "difficulty", STANDARD))

    return make_policy
