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
from guiderail.tools.evaluation.rollout import Transition, rollout
from guiderail.tools.learning.config import resolve_preset
from guiderail.tools.learning.networks import SpacesOnlyEnv
from guiderail.tools.learning.off_policy import OffPolicyLearner, SacLearner, TqcLearner
from guiderail.tools.learning.pipelined import PipelinedLearner

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
        seen, then = random.uniform(-1, 1, (2, OBSERVED)).astype(np.float32)
        hidden, following = random.uniform(-1, 1, (2, HIDDEN)).astype(np.float32)
        action = random.uniform(-1, 1, 2).astype(np.float32)
        learner.store(Transition(seen, action, float(hidden.sum()), then, False, False, {}, hidden, following))
    return learner


@pytest.mark.parametrize("kind", [TqcLearner, SacLearner, PlainTqc, PlainSac])
def test_actor_and_saved_policy_do_not_observe_what_is_hidden(kind, tmp_path):
    learner = make(kind)
    model = learner.model
    assert model.actor.latent_pi[0].in_features == OBSERVED
    critic = next(parameter for name, parameter in model.critic.named_parameters() if parameter.ndim == 2)
    assert critic.shape[1] == OBSERVED + HIDDEN + 2
    policy = learner.policy({"observation_shape": [OBSERVED]})
    policy.save(tmp_path)
    loaded, seen = Policy.load(tmp_path), np.linspace(-1, 1, OBSERVED, dtype=np.float32)
    assert loaded(seen).shape == (2,)
    # The action is that of the actor, whatever is hidden.
    for hidden in (np.zeros(HIDDEN), np.full(HIDDEN, 5.0)):
        everything = np.concatenate([seen, hidden]).astype(np.float32)
        action = learner.actor()._predict(model.policy.obs_to_tensor(everything)[0], deterministic=True)
        np.testing.assert_allclose(action.detach().numpy()[0], loaded(seen), atol=1e-6)
    with pytest.raises(ValueError, match="trained on observations"):
        loaded(np.zeros(OBSERVED + HIDDEN, np.float32))


def test_critic_depends_on_what_is_hidden():
    learner = make()
    values = [
        learner.model.critic(torch.cat([torch.zeros(1, OBSERVED), torch.full((1, HIDDEN), h)], 1), torch.zeros(1, 2))
        for h in (0.0, 1.0)
    ]
    assert not torch.allclose(*values)


def test_reward_of_what_is_hidden_is_learned_by_a_privileged_critic_only():
    """The reward is the sum of the hidden numbers; a critic without them is left with its variance."""

    def error(privileged):
        env = Vector()
        learner = make(env=env, transitions=90, gamma=0.01, learning_rate=3e-3, privileged_critic=privileged)
        learner.model.train(400, 32)
        buffer = learner.model.replay_buffer
        size = buffer.size()
        seen, taken = (torch.from_numpy(each[:size, 0]) for each in (buffer.observations, buffer.actions))
        with torch.no_grad():
            values = learner.model.critic(seen, taken).mean(dim=(1, 2))
        return float((values - torch.from_numpy(buffer.rewards[:size, 0])).square().mean())

    assert error(True) < 0.3 * error(False)


@pytest.mark.parametrize(("plain", "fast"), [(PlainSac, SacLearner), (PlainTqc, TqcLearner)])
def test_fast_step_equals_that_of_stable_baselines3(plain, fast):
    learners = [make(kind, learning_rate=1e-4) for kind in (plain, fast)]
    np.random.seed(0)  # noqa: NPY002 (Stable-Baselines3 samples from it)
    batches = learners[0].model.replay_buffer.sample(4 * 8)
    each = iter(zip(*[of_all.split(8) for of_all in batches], strict=True))
    samplers = (lambda _, env=None: type(batches)(*next(each)), lambda _, env=None: batches)
    for learner, sample in zip(learners, samplers, strict=True):
        learner.model.replay_buffer.sample = sample
        torch.manual_seed(0)
        learner.model.train(4, 8)
    for network in ("actor", "critic", "critic_target"):
        expected, result = (parameters_to_vector(getattr(x.model, network).parameters()).detach() for x in learners)
        torch.testing.assert_close(result, expected, rtol=0, atol=2e-6)


def test_symmetry_acts_on_what_is_hidden():
    signs = [(-1.0, 1.0, 1.0, 1.0, 1.0), (1.0, -1.0), (1.0, -1.0, 1.0)]
    config = resolve_preset("tqc_contact", "tqc", SETTINGS | {"symmetry": True})
    arguments = {"action_repeat": 1, "seed": 0, "max_transitions": 10}
    learner = TqcLearner(config, Vector(), symmetry=Symmetry.of_signs(*signs), **arguments)
    seen, hidden = np.arange(1.0, 6.0, dtype=np.float32), np.arange(6.0, 9.0, dtype=np.float32)
    learner.store(Transition(seen, np.ones(2, np.float32), 0.0, -seen, False, False, {}, hidden, -hidden))
    original, mirrored = learner.model.replay_buffer.observations[0]
    np.testing.assert_array_equal(original, [*seen, *hidden])
    np.testing.assert_array_equal(mirrored, [*(seen * signs[0]), *(hidden * signs[2])])
    with pytest.raises(InputError, match="symmetry of what a privileged critic observes"):
        TqcLearner(config, Vector(), symmetry=Symmetry.of_signs(*signs[:2]), **arguments)


def test_state_is_restored_exactly():
    learner, other = make(), make(transitions=0)
    other.restore(*learner.state())
    for one in (learner, other):
        torch.manual_seed(3)
        np.random.seed(3)  # noqa: NPY002
        one.model.train(4, 8)
    expected, result = (parameters_to_vector(one.model.critic.parameters()) for one in (learner, other))
    torch.testing.assert_close(result, expected, rtol=0, atol=0)


def test_learner_raises_when_nothing_privileged_is_declared():
    class Plain(gymnasium.Env):
        observation_space, action_space = Vector.observation_space, Vector.action_space

    with pytest.raises(InputError, match="privileged_critic out"):
        make(env=Plain(), transitions=0)
    assert make(env=SpacesOnlyEnv(Vector()), transitions=0)._num_privileged == HIDDEN


def test_insertion_declares_pose_and_exact_wrench():
    env = make_env("BncConnector", sensing="robot", difficulty="hard", guidance="kgrl")
    assert env.privileged_space.shape == (9,)
    env.reset(seed=0)
    assert env.privileged is None  # evaluated only if a learner uses it
    env.observes_privileged = True
    observation, info = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    np.testing.assert_allclose(env.privileged[:2] * 2e-3, info["jack_offset"], rtol=1e-6)


def test_symmetry_of_the_connector_holds_for_what_is_hidden():
    """A quarter turn of jack offset and action turns the privileged observation by its declared matrix."""
    env = make_env("BncConnector", difficulty="hard", guidance="kgrl", reward="aligned", time_step=0.01)
    env.observes_privileged = True
    symmetry = env.task.near_symmetry
    offset, hidden = np.array([2.8e-3, 0.4e-3]), []
    for turned in (offset, [-offset[1], offset[0]]):
        env.reset(seed=0, options={"offset": tuple(turned)})
        hidden.append(env.privileged.copy())
    np.testing.assert_allclose(symmetry.privileged[0] @ hidden[0], hidden[1], atol=1e-6)


def test_rollout_passes_what_is_hidden_to_callbacks_only():
    env = make_env("GridClamp", fixture_offset="none", action_repeat=50)
    env.observes_privileged = True
    transitions = []

    class Observer:
        on_episode_start = staticmethod(lambda: None)
        on_step = staticmethod(transitions.append)
        on_episode_end = staticmethod(lambda row: {})

    rollout(env, lambda observation: np.full(env.action_space.shape, -1.0, np.float32), Observer(), seed=1)
    assert all(one.privileged.shape == (9,) for one in transitions)
    np.testing.assert_array_equal(transitions[0].next_privileged, transitions[1].privileged)
    assert not np.array_equal(transitions[0].privileged, transitions[-1].next_privileged)


def test_pipelined_learner_restores_a_pending_episode():
    """The pending episode of a checkpoint contains the hidden values, too."""

    def pipelined():
        config = resolve_preset("tqc_contact", "tqc", SETTINGS | {"train_freq": 1, "gradient_steps": 1})
        named = {"action_repeat": 1, "seed": 0, "max_transitions": 100, "symmetry": None}
        env = SpacesOnlyEnv(Vector())
        return PipelinedLearner(TqcLearner(config, env, **named), ((config, env), named), waits=True)

    def episode(learner, seed):
        random = np.random.default_rng(seed)
        learner.on_episode_start()
        for _ in range(8):
            seen, hidden = random.uniform(-1, 1, OBSERVED), random.uniform(-1, 1, HIDDEN)
            seen, hidden = seen.astype(np.float32), hidden.astype(np.float32)
            action = learner.act(seen)
            learner.on_step(Transition(seen, action, 1.0, seen, False, False, {}, hidden, hidden))
        learner.on_episode_end({"termination": "success", "success": True})

    whole, resumed = pipelined(), pipelined()
    episode(whole, 0)
    arrays, values = whole.state()
    assert arrays["pending/privileged"].shape == (8, HIDDEN)
    random_state = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    whole.submit_episode()
    whole.finish()
    torch.set_rng_state(random_state[0])
    np.random.set_state(random_state[1])  # noqa: NPY002
    resumed.restore(arrays, values)
    resumed.finish()
    seen = np.linspace(-1, 1, OBSERVED, dtype=np.float32)
    policies = [learner.policy({"observation_shape": [OBSERVED]}) for learner in (whole, resumed)]
    np.testing.assert_array_equal(policies[0](seen), policies[1](seen))
