"""Whether somebody who acts sees and moves what an environment has."""

from collections.abc import Callable

import gymnasium
import numpy as np

from guiderail.tools.rollouts.rollout import Act


def suits(acts: Callable[[gymnasium.Env], Act], env: gymnasium.Env) -> bool:
    """Whether an observation of zeros gets an action of the environment's shape."""
    try:
        found = np.shape(acts(env)(np.zeros(env.observation_space.shape or (), np.float32)))
    except (IndexError, ValueError):
        return False
    return found == env.action_space.shape
