"""Whether somebody who acts sees and moves what an environment has."""

from __future__ import annotations

from collections.abc import Callable

import gymnasium
import numpy as np

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.rollouts.rollout import Act


def suits(acts: Callable[[gymnasium.Env], Act], env: gymnasium.Env) -> bool:
    """Whether what it says to a few observations are actions of the environment's shape.

    A few, because a rule may look at a number that isn't there only in the middle of an episode.
    """
    acting, shape = acts(env), env.observation_space.shape or ()
    try:
        found = {np.shape(acting(np.full(shape, value, np.float32))) for value in np.linspace(-1.0, 1.0, 21)}
    except (IndexError, ValueError):
        return False
    return found == {env.action_space.shape}


def as_learned(policy: Policy, env: gymnasium.Env) -> Act:
    """A learned policy, in an environment that may be another one than where it learned.

    Raises:
        InputError: if what it sees or moves is not this environment's.
    """
    if not suits(lambda env: policy, env):
        raise InputError("what the policy saw or moved where it learned is not what this environment has: change --env")
    return policy
