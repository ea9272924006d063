"""Learners without an environment, and episodes of random observations and rewards for them."""

import numpy as np
from spaces_only_env import SpacesOnlyEnv

from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import LEARNERS


def make_learner(config, seed=0):
    return LEARNERS.get(config.algorithm)(config, SpacesOnlyEnv(), action_repeat=1, seed=seed, max_transitions=80)


def learn(learner, episodes, rng, length=7):
    """Train on random episodes; return the learner's actions."""
    actions = []
    for _ in range(episodes):
        learner.on_episode_start()
        observation = rng.uniform(-1, 1, 3).astype(np.float32)
        for step in range(length):
            action = learner.act(observation)
            next_observation, is_last = rng.uniform(-1, 1, 3).astype(np.float32), step == length - 1
            learner.on_step(Transition(observation, action, float(rng.normal()), next_observation, False, is_last, {}))
            actions.append(action)
            observation = next_observation
        learner.on_episode_end({"success": 0})
    return np.array(actions)
