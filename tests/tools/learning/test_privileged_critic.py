"""Privileged critic: critics observe hidden values, the actor and the saved policy do not."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import SAC
from torch.nn.utils import parameters_to_vector

from guiderail import make_env
from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.learning.off_policy import OffPolicyLearner, SacLearner, TqcLearner

OBSERVED, HIDDEN = 5, 3
SETTINGS = {"net_arch": "16", "batch_size": 8, "learning_starts": 4, "symmetry": False, "privileged_critic": True}


class Vector(gymnasium.Env):
    observation_space = spaces.Box(-1, 1, (OBSERVED,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)
    privileged_space = spaces.Box(-np.inf, np.inf, (HIDDEN,), np.float32)


class PlainSac(OffPolicyLearner):
    algorithm = SAC


class PlainTqc(OffPolicyLearner):
    algorithm = TQC


def make(kind=TqcLearner, env=None, symmetry=None, transitions=40, **settings):
    config = resolve_preset("tqc_contact", "tqc", SETTINGS | settings)
    learner = kind(config, env or Vector(), action_repeat=1, seed=0, max_transitions=100, symmetry=symmetry)
    random = np.random.default_rng(1)
    for _ in range(transitions):
        observation, next_observation = random.uniform(-1, 1, (2, OBSERVED)).astype(np.float32)
        hidden, next_hidden = random.uniform(-1, 1, (2, HIDDEN)).astype(np.float32)
        action, reward = random.uniform(-1, 1, 2).astype(np.float32), float(hidden.sum())
        learner.store(Transition(observation, action, reward, next_observation, False, False, {}, hidden, next_hidden))
    return learner


@pytest.mark.parametrize("kind", [TqcLearner, SacLearner, PlainTqc, PlainSac])
def test_actor_and_saved_policy_ignore_hidden_values(kind, tmp_path):
    learner = make(kind)
    model = learner.model
    assert model.actor.latent_pi[0].in_features == OBSERVED
    critic = next(parameter for parameter in model.critic.parameters() if parameter.ndim == 2)
    assert critic.shape[1] == OBSERVED + HIDDEN + 2
    policy = learner.policy({"observation_shape": [OBSERVED]})
    policy.save(tmp_path)
    loaded, observation = Policy.load(tmp_path), np.linspace(-1, 1, OBSERVED, dtype=np.float32)
    assert loaded(observation).shape == (2,)
    for hidden in (np.zeros(HIDDEN), np.full(HIDDEN, 5.0)):
        extended = np.concatenate([observation, hidden]).astype(np.float32)
        action = learner.actor()._predict(model.policy.obs_to_tensor(extended)[0], deterministic=True)
        np.testing.assert_allclose(action.detach().numpy()[0], loaded(observation), atol=1e-6)
    with pytest.raises(ValueError, match="trained on observations"):
        loaded(np.zeros(OBSERVED + HIDDEN, np.float32))


def test_critic_depends_on_hidden_values():
    learner = make()
    hidden_values = (torch.full((1, HIDDEN), value) for value in (0.0, 1.0))
    observations = [torch.cat([torch.zeros(1, OBSERVED), hidden], 1) for hidden in hidden_values]
    values = [learner.model.critic(observation, torch.zeros(1, 2)) for observation in observations]
    assert not torch.allclose(*values)


def test_only_a_privileged_critic_learns_a_hidden_reward():
    """The reward is the sum of the hidden values; without them, the error of a critic is the reward's variance."""

    def error(privileged):
        learner = make(transitions=90, gamma=0.01, learning_rate=3e-3, privileged_critic=privileged)
        learner.model.train(400, 32)
        buffer = learner.model.replay_buffer
        size = buffer.size()
        observations, actions = (torch.from_numpy(array[:size, 0]) for array in (buffer.observations, buffer.actions))
        with torch.no_grad():
            values = learner.model.critic(observations, actions).mean(dim=(1, 2))
        return float((values - torch.from_numpy(buffer.rewards[:size, 0])).square().mean())

    assert error(True) < 0.3 * error(False)


def test_symmetry_transforms_hidden_values():
    signs = [(-1.0, 1.0, 1.0, 1.0, 1.0), (1.0, -1.0), (1.0, -1.0, 1.0)]
    config = resolve_preset("tqc_contact", "tqc", SETTINGS | {"symmetry": True})
    arguments = {"action_repeat": 1, "seed": 0, "max_transitions": 10}
    learner = TqcLearner(config, Vector(), symmetry=Symmetry.of_signs(*signs), **arguments)
    observation, hidden = np.arange(1.0, 6.0, dtype=np.float32), np.arange(6.0, 9.0, dtype=np.float32)
    learner.store(Transition(observation, np.ones(2, np.float32), 0.0, -observation, False, False, {}, hidden, -hidden))
    original, mirrored = learner.model.replay_buffer.observations[0]
    np.testing.assert_array_equal(original, [*observation, *hidden])
    np.testing.assert_array_equal(mirrored, [*(observation * signs[0]), *(hidden * signs[2])])
    with pytest.raises(InputError, match="symmetry of what a privileged critic observes"):
        TqcLearner(config, Vector(), symmetry=Symmetry.of_signs(*signs[:2]), **arguments)


def test_state_is_restored_exactly():
    learner, restored = make(), make(transitions=0)
    restored.restore(*learner.state())
    for each in (learner, restored):
        torch.manual_seed(3)
        np.random.seed(3)  # noqa: NPY002
        each.model.train(4, 8)
    expected, result = (parameters_to_vector(each.model.critic.parameters()) for each in (learner, restored))
    torch.testing.assert_close(result, expected, rtol=0, atol=0)


def test_insertion_declares_pose_and_exact_wrench():
    env = make_env("BncConnector", sensing="robot", difficulty="hard", guidance="kgrl")
    assert env.privileged_space.shape == (9,)
    env.reset(seed=0)
    assert env.privileged is None  # not evaluated unless requested
    env.observes_privileged = True
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    np.testing.assert_allclose(env.privileged[:2] * 2e-3, info["jack_offset"], rtol=1e-6)


def test_symmetry_of_the_connector_applies_to_hidden_values():
    """A quarter turn of the jack offset transforms the privileged observation by the declared matrix."""
    env = make_env("BncConnector", difficulty="hard", guidance="kgrl", reward="aligned", time_step=0.01)
    env.observes_privileged = True
    symmetry = env.diagram.near_symmetry
    offset, hidden = np.array([2.8e-3, 0.4e-3]), []
    for turned in (offset, [-offset[1], offset[0]]):
        env.reset(seed=0, options={"offset": tuple(turned)})
        hidden.append(env.privileged.copy())
    np.testing.assert_allclose(symmetry.privileged[0] @ hidden[0], hidden[1], atol=1e-6)


def test_rollout_passes_hidden_values_to_callbacks_only():
    env = make_env("GridClamp", fixture_offset="none", action_repeat=25, seconds=2.0)
    env.observes_privileged = True
    transitions = []

    class Observer:
        on_episode_start = staticmethod(lambda: None)
        on_step = staticmethod(transitions.append)
        on_episode_end = staticmethod(lambda row: {})

    rollout(env, lambda observation: np.full(env.action_space.shape, -1.0, np.float32), Observer(), seed=1)
    assert all(transition.privileged.shape == (9,) for transition in transitions)
    np.testing.assert_array_equal(transitions[0].next_privileged, transitions[1].privileged)
    assert not np.array_equal(transitions[0].privileged, transitions[-1].next_privileged)
