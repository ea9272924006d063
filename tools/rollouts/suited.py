"""Whether somebody who acts sees and moves what an environment has."""

from collections.abc import Callable

import gymnasium
import numpy as np

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
