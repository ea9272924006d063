"""Environment with spaces only, for tests of learners without a simulation."""

import gymnasium
from gymnasium import spaces


class SpacesOnlyEnv(gymnasium.Env):
    """Environment with an observation space and an action space, which cannot be reset or stepped."""

    observation_space: gymnasium.Space = spaces.Box(-1, 1, (3,))
    action_space: gymnasium.Space = spaces.Box(-1, 1, (2,))

    def __init__(self, observation_space=None, action_space=None):
        """Construct the environment; a space of None is that of the class."""
        self.observation_space = self.observation_space if observation_space is None else observation_space
        self.action_space = self.action_space if action_space is None else action_space
