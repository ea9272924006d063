"""Learners without an environment, and episodes of random observations and rewards for them."""

import numpy as np
from spaces_only_env import SpacesOnlyEnv

from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import LEARNERS

OBSERVATION = np.array([0.3, -0.2, 0.9], np.float32)


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


def check_learning_resumes(config):
    """Check that a learner acts and learns, and that its stored state learns on bit for bit."""
    learner = make_learner(config)
    before = learner.policy({"observation_shape": [3]})(OBSERVATION)
    rng = np.random.default_rng(0)
    learn(learner, 4, rng)
    assert not np.array_equal(learner.policy({"observation_shape": [3]})(OBSERVATION), before)
    arrays, values = learner.state()
    arrays = {key: value.copy() for key, value in arrays.items()}
    expected = learn(learner, 3, np.random.default_rng(1))
    restored = make_learner(config, seed=9)
    restored.restore(arrays, values)
    np.testing.assert_array_equal(learn(restored, 3, np.random.default_rng(1)), expected)
    policies = [each.policy({"observation_shape": [3]}) for each in (learner, restored)]
    np.testing.assert_array_equal(*[policy(OBSERVATION) for policy in policies])
    assert not learner.has_diverged()
