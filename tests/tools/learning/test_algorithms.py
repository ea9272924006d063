"""TD3 and CrossQ; demonstrations in every batch; dropout of the critics."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from random_episodes import OBSERVATION, check_learning_resumes, learn, make_learner
from stable_baselines3 import DDPG

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import LEARNERS, Learner, register_learner
from guiderail.tools.learning.learner_config import config_values, make_config, resolve_preset
from guiderail.tools.learning.networks import DemonstrationReplayBuffer, DroppedNormalizedReLU
from guiderail.tools.learning.off_policy import TD3_NOISE, OffPolicyLearner

OFF_POLICY = {"net_arch": "8", "batch_size": 4, "learning_starts": 6, "train_freq": 4, "gradient_steps": 2}
ALGORITHMS = ["td3", "crossq"]


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_learner_acts_learns_and_resumes_bit_for_bit(algorithm):
    check_learning_resumes(resolve_preset(None, algorithm, OFF_POLICY))


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_exported_policy_acts_as_the_model(algorithm):
    """CrossQ's normalization by running statistics is part of the exported layers."""
    config = resolve_preset(None, algorithm, OFF_POLICY)
    learner = make_learner(replace(config, actor_ema=0.0))
    learn(learner, 5, np.random.default_rng(0))
    expected = learner.model.predict(OBSERVATION, deterministic=True)[0]
    np.testing.assert_allclose(learner.policy({"observation_shape": [3]})(OBSERVATION), expected, atol=1e-6)


@pytest.mark.parametrize("algorithm", ["td3", "ddpg"])
def test_deterministic_policy_explores_with_noise(algorithm, monkeypatch):
    monkeypatch.setitem(LEARNERS._entries, "ddpg", type("Ddpg", (OffPolicyLearner,), {"algorithm": DDPG}))
    learner = make_learner(resolve_preset(None, algorithm, OFF_POLICY))
    actions = np.array([learner.explore(OBSERVATION) for _ in range(300)])
    np.testing.assert_allclose(actions.std(axis=0), TD3_NOISE, atol=0.02)
    assert np.abs(actions).max() <= 1.0


def make_with_demonstrations(fraction, **more_settings):
    settings = {"net_arch": "4", "batch_size": 8, "learning_starts": 50, "demonstration_episodes": 2, **more_settings}
    return make_learner(resolve_preset(None, "tqc", {**settings, "demonstration_fraction": fraction}))


def fill(learner, episodes, length=5):
    for episode in range(episodes):
        learner.on_episode_start()
        for _ in range(length):
            learner.store(
                Transition(np.full(3, episode, np.float32), np.zeros(2), episode, OBSERVATION, False, False, {})
            )


@pytest.mark.parametrize("fraction", [0.25, 0.5, 0.75])
def test_every_batch_has_its_fraction_of_demonstrations(fraction):
    learner = make_with_demonstrations(fraction)
    fill(learner, 5)
    assert learner.model.replay_buffer.num_demonstrated == 10
    # Ten batches in one sample, as in the fast training step.
    for batch in learner.model.replay_buffer.sample(10 * 8).rewards.view(10, 8):
        assert (batch < 2).float().mean() == fraction
    arrays, values = learner.state()
    restored = make_with_demonstrations(fraction)
    restored.restore(arrays, values)
    assert restored.model.replay_buffer.num_demonstrated == 10


def test_demonstrations_are_not_overwritten():
    learner = make_with_demonstrations(0.5, buffer_size=15)
    fill(learner, 7)
    rewards = learner.model.replay_buffer.rewards[:, 0]
    np.testing.assert_array_equal(rewards[:10], [0.0] * 5 + [1.0] * 5)
    np.testing.assert_array_equal(rewards[10:15], [6.0] * 5)


def test_demonstrations_that_fill_the_buffer_are_refused():
    learner = make_with_demonstrations(0.5, buffer_size=8)
    with pytest.raises(InputError, match="fill the replay buffer of 8 transitions"):
        fill(learner, 2)
    assert learner.model.replay_buffer.num_demonstrated == 8


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"demonstration_fraction": 0.5}, "needs demonstrations: give --set demonstration_episodes"),
        ({"demonstrator": "runs/a"}, "demonstrator acts in the demonstrations: give --set demonstration_episodes"),
        ({"demonstration_episodes": 1, "init_from": "runs/a"}, "demonstration_episodes does not work with init_from"),
        ({"algorithm": "crossq", "net_arch.dropout": 0.01}, "leave net_arch.dropout=0.01 out"),
        ({"algorithm": "crossq", "demonstration_fraction": 0.5}, "needs demonstrations"),
    ],
)
def test_settings_that_exclude_each_other_are_named(settings, message):
    settings = {"algorithm": "tqc"} | settings
    with pytest.raises(InputError, match=message):
        resolve_preset(None, settings.pop("algorithm"), settings)


def test_newest_row_is_the_last_added_also_in_a_full_buffer():
    box = spaces.Box(-1.0, 1.0, (1,))
    buffer = DemonstrationReplayBuffer(4, box, box, device="cpu")
    for step in range(6):
        buffer.num_demonstrated = min(step, 2)
        buffer.add(*np.zeros((3, 1, 1)), np.array([float(step)]), np.array([False]), [{}])
        assert buffer.rewards[buffer.newest] == step


@pytest.mark.parametrize("algorithm", ["sac", "tqc"])
def test_dropout_is_applied_to_the_critics_in_training_only(algorithm):
    config = resolve_preset(
        None, algorithm, {"net_arch": "8", "batch_size": 4, "learning_starts": 6, "net_arch.dropout": 0.5}
    )
    learner = make_learner(config)
    learn(learner, 4, np.random.default_rng(0))
    critic = learner.model.critic
    assert any(isinstance(layer, DroppedNormalizedReLU) for layer in critic.q_networks[0])
    batch = torch.zeros(1, 3), torch.zeros(1, 2)
    first, second = (critic(*batch)[0].detach().numpy() for _ in range(2))
    np.testing.assert_array_equal(first, second)
    critic.set_training_mode(True)
    assert not np.array_equal(critic(*batch)[0].detach().numpy(), critic(*batch)[0].detach().numpy())


def test_configuration_is_restored_from_its_values():
    values = config_values(resolve_preset(None, "td3"))
    assert make_config("td3", {k: v for k, v in values.items() if k != "algorithm"}) == resolve_preset(None, "td3")


def test_probability_of_an_action_grows_over_base_motion_steps():
    settings = {"net_arch": "8", "learning_starts": 10_000, "exploration.base_motion_steps": 2000}
    learner = make_learner(resolve_preset(None, "sac", settings))
    learner._constant_action = None
    fractions = []
    for learner.transitions in (0, 1000, 2000):
        fractions.append(np.mean([learner.act(OBSERVATION).any() for _ in range(300)]))
    assert fractions[0] == 0.0
    assert 0.4 < fractions[1] < 0.6
    assert fractions[2] == 1.0


class Stored(Learner):
    stored = ("best", "highest", "random")

    def __init__(self):
        self.best, self.highest, self.random = np.zeros(2), -np.inf, np.random.default_rng(0)

    def act(self, observation):
        return self.best

    def policy(self, description):
        raise NotImplementedError


def test_stored_attributes_are_the_state_of_a_learner():
    first, second = Stored(), Stored()
    first.best, first.highest = first.random.standard_normal(2), 3.0
    second.restore(*first.state())
    np.testing.assert_array_equal(second.best, first.best)
    assert (second.highest, second.random.normal()) == (3.0, first.random.normal())
    assert not first.has_diverged()
    first.best[0] = np.nan
    assert first.has_diverged()
    Stored.stored = ("best", "hihgest")
    with pytest.raises(InputError, match="Stored has no attribute 'hihgest', which it names in stored"):
        first.state()
    Stored.stored = None
    with pytest.raises(InputError, match="Stored names nothing in stored"):
        first.state()


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        (
            {"on_step": lambda self, observation, reward: None},
            r"on_step of Wrong must have the parameters \(self, trans",
        ),
        (
            {"policy": lambda self: None},
            r"policy of Wrong must have the parameters \(self, description\), not \(self\)",
        ),
    ],
)
def test_learner_is_refused_when_a_method_lacks_parameters(attributes, message):
    with pytest.raises(InputError, match=message):
        register_learner("wrong")(type("Wrong", (Stored,), attributes))
