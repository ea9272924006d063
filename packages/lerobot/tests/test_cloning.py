"""Behavior cloning: it learns a demonstrator's actions, and resumes."""

from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces
from spaces_only_env import SpacesOnlyEnv

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import learner_arguments
from guiderail.tools.learning.learner_config import make_config
from guiderail_lerobot.cloning import BcLearner
from guiderail_lerobot.config import BcConfig, ChunkConfig


def make(**settings):
    return BcLearner(BcConfig(**settings), SpacesOnlyEnv(), seed=0)


def demonstrator_action(observation):
    return np.array([0.5 * observation[0], -0.8 * observation[1] * observation[2]], np.float32)


def record_demonstrations(learner, episodes, rng, length=20):
    for _ in range(episodes):
        learner.on_episode_start()
        for step in range(length):
            observation, next_observation = rng.uniform(-1, 1, (2, 3)).astype(np.float32)
            action, is_last = demonstrator_action(observation), step == length - 1
            learner.on_step(Transition(observation, action, 0.0, next_observation, False, is_last, {}))
        learner.on_episode_end({"success": 1})


def test_behavior_cloning_acts_as_the_demonstrator():
    settings = {"demonstration_episodes": 4, "gradient_steps": 400, "net_arch": (32, 32)}
    learner = make(**settings)
    rng = np.random.default_rng(0)
    record_demonstrations(learner, 3, rng)
    with pytest.raises(InputError, match="bc trains after 4 demonstrations: give at least that many --episodes"):
        learner.policy({})
    arrays, values = learner.state()
    arrays = {key: value.copy() for key, value in arrays.items()}
    record_demonstrations(learner, 1, np.random.default_rng(5))
    record_demonstrations(learner, 1, rng)  # no effect: bc learns from the first four episodes only
    observations = np.random.default_rng(1).uniform(-0.8, 0.8, (50, 3)).astype(np.float32)
    policy = learner.policy({"observation_shape": [3]})
    errors = [policy(observation) - demonstrator_action(observation) for observation in observations]
    assert np.sqrt(np.mean(np.square(errors))) < 0.1
    np.testing.assert_allclose(learner.act(observations[0]), policy(observations[0]), atol=1e-6)
    assert learner.metrics()["train/loss"] < 0.02
    assert learner.metrics() == {}
    restored = make(**settings)
    restored.restore(arrays, values)
    record_demonstrations(restored, 1, np.random.default_rng(5))
    np.testing.assert_array_equal(restored.act(observations[1]), learner.act(observations[1]))


def test_behavior_cloning_refuses_zero_demonstrations():
    assert make_config("bc", {"demonstration_episodes": 1}).demonstration_episodes == 1
    with pytest.raises(InputError, match="learns from demonstrations"):
        make_config("bc", {"demonstration_episodes": 0})


@pytest.mark.parametrize("config", [BcConfig(), ChunkConfig()])
def test_images_are_refused_by_cloning(config):
    task = SimpleNamespace(observation_space=spaces.Box(0, 255, (8, 8, 3), np.uint8))
    with pytest.raises(InputError, match=f"{config.algorithm} takes no images"):
        learner_arguments(SimpleNamespace(learner=config), task)
