"""Policies that know nothing: what a learned one is compared with, and what guidance must withstand."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, cast

import gymnasium
import numpy as np

from guiderail.diagrams.envs.options import STANDARD
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.evaluation.rollout import Callback, PolicyFn

REPEATS = 10  # decisions that a held action lasts
TURNS = 0.1  # how likely corner actions turn into another corner at a decision

# Makes the actions of an episode from its random generator and the size of an action.
Choose = Callable[[np.random.Generator, int], PolicyFn]


def zero(rng: np.random.Generator, size: int) -> PolicyFn:
    """The action of zero, which leaves guidance to itself: where it has demonstrations, those."""
    return lambda observation: np.zeros(size, np.float32)


def uniform_random(rng: np.random.Generator, size: int) -> PolicyFn:
    """Uniform in [−1, 1], anew at every decision: an make_baseline policy."""
    return lambda observation: rng.uniform(-1.0, 1.0, size)


def constant(rng: np.random.Generator, size: int) -> PolicyFn:
    """One action for the whole episode, uniform in [−1, 1]."""
    return _repeated(lambda: rng.uniform(-1.0, 1.0, size), lambda count: False)


def random_hold(rng: np.random.Generator, size: int) -> PolicyFn:
    """Uniform, each for `REPEATS` decisions: they lead further than white ones."""
    return _repeated(lambda: rng.uniform(-1.0, 1.0, size), lambda count: count % REPEATS == 0)


def bang_bang(rng: np.random.Generator, size: int) -> PolicyFn:
    """Full deflection, that turns into another corner now and then."""
    return _repeated(lambda: rng.choice([-1.0, 1.0], size), lambda count: rng.uniform() < TURNS)


def random_corner(rng: np.random.Generator, size: int) -> PolicyFn:
    """Full deflection into one corner for the whole episode."""
    return _repeated(lambda: rng.choice([-1.0, 1.0], size), lambda count: False)


def _repeated(choose: Callable[[], np.ndarray], turns: Callable[[int], bool]) -> PolicyFn:
    count, action = 0, choose()

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal count, action
        if count > 0 and turns(count):
            action = choose()
        count += 1
        return action

    return act


BASELINES: dict[str, Choose] = {
    one.__name__: one for one in (zero, uniform_random, constant, random_hold, bang_bang, random_corner)
}


class BaselinePolicy(Callback):
    """Actions that look at nothing, chosen anew for every episode from a random generator of its own."""

    def __init__(self, choose: Choose, env: gymnasium.Env, seed: int = 0):
        """
        Args:
            choose: makes the actions of an episode.
            env: for its actions' size only.
            seed: of the generators; episode i has [seed, i].
        """
        self._choose, self._seed, self._episode = choose, seed, -1
        self._size = int(np.prod(env.action_space.shape or ()))
        self._act: PolicyFn = zero(np.random.default_rng(0), self._size)

    def on_episode_start(self) -> None:
        """The next episode's actions."""
        self._episode += 1
        self._act = self._choose(np.random.default_rng([self._seed, self._episode]), self._size)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """An action (A,) in [−1, 1]."""
        return self._act(observation)


still = partial(BaselinePolicy, zero)
"""What acts by zero, for an environment."""


def always(env: gymnasium.Env, action: np.ndarray) -> BaselinePolicy:
    """The same action in every episode."""
    return BaselinePolicy(lambda rng, size: lambda observation: np.asarray(action, np.float32), env)


def scripted_policies(task: str, difficulty: str = STANDARD) -> Mapping[str, PolicyFn]:
    """Return a task's scripted policies by name, the default for `difficulty` first; none if it is not guiderail's."""
    return TASKS.get(task).scripted_policies(difficulty) if task in TASKS.names() else {}


def find_scripted_policy(task: str, name: str, difficulty: str = STANDARD) -> PolicyFn:
    """Return a task's scripted policy by its name; "scripted" is the default for the difficulty.

    Raises:
        InputError: If there is none of that name.
    """
    policies = scripted_policies(task, difficulty)
    if name == "scripted" and policies:
        return next(iter(policies.values()))
    if name not in policies:
        raise InputError(f"{task} has no policy {name!r}: {did_you_mean(name, [*policies, *BASELINES])}")
    return policies[name]


def make_baseline(task: str, name: str, seed: int = 0) -> Callable[[gymnasium.Env], PolicyFn]:
    """Return a function from an environment to a baseline policy or a task's scripted policy of that name.

    Raises:
        InputError: If there is none.
    """
    if name in BASELINES:
        return lambda env: BaselinePolicy(BASELINES[name], env, seed)
    find_scripted_policy(task, name)

    def make_policy(env: gymnasium.Env) -> PolicyFn:
        config = getattr(cast(Any, env.unwrapped).task.declaration, "config", None)
        return find_scripted_policy(task, name, getattr(config, "difficulty", STANDARD))

    return make_policy
