"""Learner PPO: learning, resumption, export, bootstrapping, and settings that it does not have."""

from types import SimpleNamespace

import numpy as np
import pytest
from gymnasium import spaces
from random_episodes import OBSERVATION, check_learning_resumes, learn, make_learner

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import learner_arguments
from guiderail.tools.learning.learner_config import make_config, resolve_preset

SETTINGS = {"net_arch": "8,8", "n_steps": 16, "batch_size": 8}


def test_learner_acts_learns_and_resumes_bit_for_bit():
    check_learning_resumes(resolve_preset(None, "ppo", SETTINGS))


def test_exported_policy_acts_as_the_model():
    config = resolve_preset(None, "ppo", SETTINGS)
    learner = make_learner(config)
    learn(learner, 5, np.random.default_rng(0))
    expected = learner.model.predict(OBSERVATION, deterministic=True)[0]
    np.testing.assert_allclose(learner.policy({"observation_shape": [3]})(OBSERVATION), expected, atol=1e-6)


def test_settings_reach_the_algorithm():
    ppo = make_learner(make_config("ppo", {"n_epochs": 3, "n_steps": 32, "ent_coef": 0.1}))
    assert (ppo.model.n_epochs, ppo.model.n_steps, ppo.model.ent_coef) == (3, 32, 0.1)
    with pytest.raises(InputError, match="preset tqc_fast has settings that ppo does not have"):
        resolve_preset("tqc_fast", "ppo")


def run_episode(learner, cost, length=4):
    learner.on_episode_start()
    for step in range(length):
        is_last, action = step == length - 1, learner.act(OBSERVATION)
        learner.on_step(Transition(OBSERVATION, action, 2.0, OBSERVATION, is_last, False, {"cost": cost}))
    learner.on_episode_end({"success": 0})


def test_multiplier_follows_the_cost_of_episodes_above_the_limit():
    """By hand: the first training knows one episode, with a cost of 4, the second one two, with a mean of 2."""
    config = make_config("ppo", {"n_steps": 8, "net_arch": "4", "cost_limit": 1.0, "multiplier_rate": 0.5})
    learner = make_learner(config)
    for cost in (1.0, 0.0):
        run_episode(learner, cost)
    assert learner.multiplier == pytest.approx(0.5 * (4.0 - 1.0))
    run_episode(learner, 1.0)
    np.testing.assert_allclose(learner.model.rollout_buffer.rewards[:4, 0], (2.0 - 1.5 * 1.0) / (1.0 + 1.5))
    restored = make_learner(config)
    restored.restore(*learner.state())
    for each in (learner, restored):
        run_episode(each, 0.0)
        assert each.multiplier == pytest.approx(1.5 + 0.5 * ((0.0 + 4.0) / 2 - 1.0))
        assert each.metrics()["train/multiplier"] == each.multiplier
        for _ in range(10):
            run_episode(each, 0.0)
        assert each.multiplier == 0.0  # not negative


def test_cost_limit_needs_a_cost():
    learner = make_learner(make_config("ppo", {"cost_limit": 0.0}))
    learner.on_episode_start()
    transition = Transition(OBSERVATION, learner.act(OBSERVATION), 2.0, OBSERVATION, False, False, {})
    with pytest.raises(InputError, match="info has no cost"):
        learner.on_step(transition)


def test_learner_bootstraps_a_time_limit():
    """By hand: with γ = 1, the stored reward of a truncated step is its reward plus the next state's value."""
    learner = make_learner(make_config("ppo", {"n_steps": 8, "gamma": 1.0, "net_arch": "4"}))
    next_observation = np.full(3, 0.5, np.float32)
    value = float(learner._value(next_observation))
    for truncated, terminated, expected in ((True, False, 2.0 + value), (False, True, 2.0)):
        learner.on_episode_start()
        action = learner.act(OBSERVATION)
        learner.on_step(Transition(OBSERVATION, action, 2.0, next_observation, terminated, truncated, {}))
        buffer = learner.model.rollout_buffer
        assert buffer.rewards[buffer.pos - 1, 0] == pytest.approx(expected)


def test_learner_bootstraps_before_a_failed_simulation():
    learner = make_learner(make_config("ppo", {"n_steps": 8, "gamma": 0.5, "net_arch": "4"}))
    reached, failure = np.full(3, 0.5, np.float32), {"simulation_failure": "diverged"}
    buffer = learner.model.rollout_buffer
    for is_last, expected in ((False, 2.0 + 0.5 * float(learner._value(reached))), (True, 2.0)):
        learner.on_episode_start()
        learner.on_step(Transition(OBSERVATION, learner.act(OBSERVATION), 2.0, reached, is_last, False, {}))
        if is_last:  # the next episode fails in its first step
            learner.on_episode_start()
        learner.on_step(Transition(reached, learner.act(reached), 0.0, reached, False, True, failure))
        assert buffer.rewards[buffer.pos - 1, 0] == pytest.approx(expected)


def test_learner_discards_the_action_before_a_failure():
    learner = make_learner(make_config("ppo", {"n_steps": 8, "net_arch": "4"}))
    learner.on_episode_start()
    failure = {"simulation_failure": "no solution"}
    learner.on_step(Transition(OBSERVATION, learner.act(OBSERVATION), 0.0, OBSERVATION, False, True, failure))
    assert learner.model.rollout_buffer.pos == 0
    learner.on_episode_start()
    correction = np.ones(2, np.float32)  # action of a supervisor, without a call of the learner's `act`
    learner.on_step(Transition(OBSERVATION, correction, 0.0, OBSERVATION, False, False, {}))
    assert learner.model.rollout_buffer.pos == 0


def test_images_are_refused():
    learner = make_config("ppo", {})
    task = SimpleNamespace(observation_space=spaces.Box(0, 255, (8, 8, 3), np.uint8))
    with pytest.raises(InputError, match="ppo takes no images"):
        learner_arguments(SimpleNamespace(learner=learner), task)


@pytest.mark.parametrize("name", ["demonstration_episodes", "symmetry", "num_envs"])
def test_settings_of_other_learners_are_refused(name):
    with pytest.raises(InputError, match=f"ppo has no setting '{name}'"):
        resolve_preset(None, "ppo", {name: 1})
