import contextlib
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib.common.torch_layers import BatchRenorm1d
from spaces_only_env import SpacesOnlyEnv
from stable_baselines3 import DDPG

from guiderail.diagrams.envs.task_diagram import Symmetry
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.checkpoint import load_checkpoint, save_checkpoint
from guiderail.tools.learning.learner import LEARNERS, learner_arguments, register_learner
from guiderail.tools.learning.learner_config import PRESETS, resolve_preset
from guiderail.tools.learning.networks import export_layers, export_policy
from guiderail.tools.learning.off_policy import OffPolicyLearner
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import run_training

SETTINGS = {"net_arch": "8", "batch_size": 4, "learning_starts": 6, "train_freq": 4, "gradient_steps": 2}


@pytest.fixture
def config():
    return resolve_preset("tqc_contact", "tqc", SETTINGS)


def make(config, action_repeat=1, seed=0, **options):
    options |= {"action_repeat": action_repeat, "seed": seed, "max_transitions": 50}
    return LEARNERS.get(config.algorithm)(config, SpacesOnlyEnv(), **options)


def transition(observation, action, reward, next_observation, terminated=False, truncated=False):
    return Transition(observation, action, reward, next_observation, terminated, truncated, {})


def learn_from_random_transitions(learner, number, seed=0):
    """Store a number of random transitions, and train after each as configured."""
    random = np.random.default_rng(seed)
    for _ in range(number):
        observation, next_observation = random.uniform(-1, 1, (2, 3)).astype(np.float32)
        learner.store(transition(observation, learner.act(observation), random.normal(), next_observation))
        learner.learn()


def weights(learner):
    return torch.nn.utils.parameters_to_vector(learner.model.actor.parameters()).detach().numpy().copy()


def test_presets_have_the_values_of_the_thesis():
    simulation, robot = PRESETS["table_4_1_simulation"], PRESETS["table_4_1_robot"]
    for table, tau, gamma, entropy in ((simulation, 0.02, 0.99, "auto"), (robot, 0.01, 0.995, "auto_0.1")):
        assert (table.learning_rate, table.train_freq, table.gradient_steps) == (1e-3, 8, 8)
        assert (table.tau, table.gamma, table.ent_coef) == (tau, gamma, entropy)
        assert (table.batch_size, table.buffer_size, table.net_arch) == (256, 10**6, (256, 256))
    for name, rate, gamma in (("table_3_2_iiwa", 8e-4, 0.95), ("table_3_2_sara", 1e-3, 0.98)):
        table = PRESETS[name]
        assert (table.learning_rate, table.gamma, table.tau) == (rate, gamma, 0.02)
        assert (table.train_freq, table.gradient_steps, table.learning_starts) == (8, 8, 1000)


@pytest.mark.parametrize("algorithm", ["sac", "tqc"])
@pytest.mark.parametrize("name", PRESETS)
def test_preset_constructs_a_learner_of_every_algorithm(name, algorithm):
    learner = make(replace(resolve_preset(name, algorithm), net_arch=(4,)))
    assert learner.act(np.zeros(3, np.float32)).shape == (2,)


def test_gamma_per_control_step_depends_on_action_repeat(config):
    assert make(config, action_repeat=5).model.gamma == pytest.approx(make(config).model.gamma ** 5)


def test_training_follows_the_number_of_transitions(config):
    learner = make(config)
    before = weights(learner)
    learn_from_random_transitions(learner, 7)
    np.testing.assert_array_equal(weights(learner), before)
    learn_from_random_transitions(learner, 1)
    assert not np.array_equal(weights(learner), before)
    assert learner.model._n_updates == 2
    learn_from_random_transitions(learner, 12)
    assert learner.model._n_updates == 8


def test_averaged_actor_lags_behind_the_actor(config):
    learner = make(config)
    start = weights(learner)
    learn_from_random_transitions(learner, 40)
    averaged = torch.nn.utils.parameters_to_vector(learner.averaged.parameters()).detach().numpy()
    moved = np.linalg.norm(averaged - start)
    assert 0 < moved < np.linalg.norm(weights(learner) - start)
    assert learner.actor() is learner.averaged
    plain = make(replace(config, actor_ema=0.0))
    assert plain.actor() is plain.model.actor


def test_time_limit_is_bootstrapped(config):
    learner = make(config)
    observation = np.zeros(3, np.float32)
    for terminated, truncated in ((True, False), (False, True), (False, False)):
        learner.store(transition(observation, np.zeros(2), 0.0, observation, terminated, truncated))
    buffer = learner.model.replay_buffer
    is_terminal = buffer.dones[:3, 0] * (1 - buffer.timeouts[:3, 0])
    np.testing.assert_array_equal(is_terminal, [1, 0, 0])


def test_replay_buffer_has_symmetric_copies(config):
    half_turn = Symmetry.of_signs((-1.0, -1.0, 1.0), (-1.0, 1.0))
    learner, plain = (make(each, symmetry=half_turn) for each in (config, replace(config, symmetry=False)))
    for each in (learner, plain):
        each.store(transition(np.array([1, 2, 3.0]), np.array([0.5, 0.25]), 7.0, np.array([4, 5, 6.0]), True))
    buffer = learner.model.replay_buffer
    assert (buffer.size(), plain.model.replay_buffer.n_envs, learner.transitions) == (1, 1, 1)
    np.testing.assert_array_equal(buffer.observations[0], [[1, 2, 3], [-1, -2, 3]])
    np.testing.assert_array_equal(buffer.next_observations[0], [[4, 5, 6], [-4, -5, 6]])
    np.testing.assert_array_equal(buffer.actions[0], [[0.5, 0.25], [-0.5, 0.25]])
    np.testing.assert_array_equal(buffer.rewards[0], [7, 7])
    np.testing.assert_array_equal(buffer.dones[0], [1, 1])
    learn_from_random_transitions(learner, 49)  # fills the buffer of 50 transitions
    assert (buffer.size(), buffer.full) == (50, False)


def test_restored_learner_continues_bit_for_bit(config):
    first = make(config)
    learn_from_random_transitions(first, 23)
    arrays, values = (part.copy() for part in first.state())
    arrays = {key: value.copy() for key, value in arrays.items()}
    learn_from_random_transitions(first, 17, seed=1)
    expected = weights(first)
    second = make(config, seed=99)
    second.restore(arrays, values)
    learn_from_random_transitions(second, 17, seed=1)
    np.testing.assert_array_equal(weights(second), expected)


def test_learner_starts_from_another_run(bead_config, bead_run):
    config = replace(bead_config.learner, init_from=str(bead_run))
    with contextlib.closing(make_environment("Bead", {})) as env:
        learner = LEARNERS.get("tqc")(
            config, env, **learner_arguments(bead_config, env.unwrapped.diagram) | {"seed": 8}
        )
    arrays, values = load_checkpoint(bead_run / "checkpoint" / "state.safetensors")
    initial, state = learner.state()
    learned = [key for key in arrays if not key.startswith(("random/", "selection/"))]
    assert learned
    assert [key for key in learned if not np.array_equal(np.ravel(initial[key]), np.ravel(arrays[key]))] == []
    assert state["transitions"] == values["learner"]["transitions"]
    assert state["selection"] == {"rows": {}}
    assert state["greedy_successes"] == 0
    assert state["exploration"] == np.random.default_rng(8).bit_generator.state


def test_learner_starts_from_a_run_with_several_processes(bead_config, tmp_path):
    run_training(RunFolder(tmp_path), replace(bead_config, learner=replace(bead_config.learner, num_envs=1)))
    arrays, values = load_checkpoint(RunFolder(tmp_path).checkpoint)
    config = replace(bead_config.learner, init_from=str(tmp_path))
    with contextlib.closing(make_environment("Bead", {})) as env:
        learner = LEARNERS.get("tqc")(config, env, **learner_arguments(bead_config, env.unwrapped.diagram))
    assert (learner.transitions, learner.episodes) == (values["learner"]["transitions"], bead_config.episodes)
    initial = learner.state()[0]
    for name in ("policy/actor.mu.weight", "buffer/rewards"):
        np.testing.assert_array_equal(initial[name], arrays[name])


@pytest.mark.parametrize(
    ("num_stored", "buffer_size", "message"),
    [
        (5, 4, "holds 5 transitions: give --set buffer_size=6 or more, not 4"),
        (5, 5, "holds 5 transitions: give --set buffer_size=6 or more, not 5"),
        (20, 30, "is full of 20 transitions: give --set buffer_size=20, not 30"),
        (5, 6, ""),
        (20, 20, ""),
    ],
)
def test_replay_buffer_of_another_run_must_fit(num_stored, buffer_size, message, config, tmp_path):
    first = make(replace(config, buffer_size=20))
    learn_from_random_transitions(first, num_stored)
    arrays, values = first.state()
    (tmp_path / "checkpoint").mkdir()
    save_checkpoint(RunFolder(tmp_path).checkpoint, arrays, {"learner": values})
    with pytest.raises(InputError, match=message) if message else contextlib.nullcontext():
        learn_from_random_transitions(make(replace(config, buffer_size=buffer_size, init_from=str(tmp_path))), 3)


def test_init_from_refuses_runs_of_other_learners(bead_config, bead_run, config, tmp_path):
    with pytest.raises(InputError, match="other observations"):
        make(replace(config, init_from=str(bead_run)))
    with pytest.raises(InputError, match="no checkpoint"):
        make(replace(config, init_from=str(tmp_path)))


def actions_of(learner, episodes, number=4):
    """Return the first actions of several episodes at a constant observation, (episodes, number, 2)."""
    actions = []
    for _ in range(episodes):
        learner.on_episode_start()
        actions.append([learner.act(np.ones(3, np.float32)) for _ in range(number)])
    return np.array(actions)


def test_constant_episodes_repeat_one_action(config):
    actions = actions_of(make(replace(config, constant_episodes=3)), 4)
    assert (actions[:3] == actions[:3, :1]).all()
    assert len(np.unique(actions[:3, 0], axis=0)) == 3
    assert len(np.unique(actions[3], axis=0)) == 4


@pytest.mark.parametrize("bounds", [(-1, 1), (-2, 2), (0, 3)])
def test_greedy_episodes_act_as_the_exported_policy(bounds, config, monkeypatch):
    monkeypatch.setattr(SpacesOnlyEnv, "action_space", spaces.Box(*bounds, (2,)))
    learner = make(replace(config, constant_episodes=0, greedy_episode_fraction=0.5))
    learn_from_random_transitions(learner, 20)
    exploring, greedy = actions_of(learner, 2)
    assert len(np.unique(exploring, axis=0)) == 4
    assert (greedy == greedy[0]).all()
    policy = export_policy(learner.actor(), {"observation_shape": [3]})
    np.testing.assert_allclose(greedy[0], policy(np.ones(3, np.float32)), atol=1e-6)


def test_number_of_greedy_episodes_is_the_fraction(config):
    for fraction in (0.0, 0.25, 0.75, 1.0):
        learner = make(replace(config, constant_episodes=0, greedy_episode_fraction=fraction))
        learn_from_random_transitions(learner, 20)
        greedy = [len(np.unique(actions, axis=0)) == 1 for actions in actions_of(learner, 8)]
        assert sum(greedy) == 8 * fraction


def test_episodes_explore_until_learning_starts(config):
    learner = make(
        replace(config, constant_episodes=0, learning_starts=12, greedy_episode_fraction=1.0, selection_window=3)
    )
    for is_learning in (False, False, True, True):  # 8 transitions per episode: the 12th is in the second episode
        learner.on_episode_start()
        assert learner.is_learning() is is_learning
        learn_from_random_transitions(learner, 8)
        learner.on_episode_end({"success": 1})
    assert learner.state()[1]["greedy_successes"] == 2


def test_extended_actions_have_the_configured_length(config):
    extending = replace(config, constant_episodes=0, learning_starts=1, ez_greedy=0.2, ez_greedy_longest=5)
    learner = make(extending)
    learn_from_random_transitions(learner, 20)
    exploring = actions_of(learner, 1, number=400)[0]
    repeated = (np.diff(exploring, axis=0) == 0.0).all(axis=1)
    runs = [len(run) for run in "".join("r" if r else " " for r in repeated).split()]
    assert max(runs) == extending.ez_greedy_longest - 1  # an action of n transitions is repeated n − 1 times
    assert 0.2 < repeated.mean() < 0.5  # of 4 + 3 actions on average, the last 3 are equal: 2 / 7 repetitions
    greedy = make(replace(extending, greedy_episode_fraction=1.0))
    learn_from_random_transitions(greedy, 20)
    actions = actions_of(greedy, 1, number=50)[0]
    assert (actions == actions[0]).all()


def test_extended_actions_end_when_greedy_episodes_succeed(config):
    extending = replace(
        config, constant_episodes=0, learning_starts=1, greedy_episode_fraction=0.5, ez_greedy=1.0, ez_greedy_until=2
    )
    learner = make(extending)
    learn_from_random_transitions(learner, 20)
    for success, is_extended in ((None, True), (True, True), (True, False), (True, False), (False, True)):
        if success is not None:
            learner.on_episode_end({"success": int(success)})  # greedy episode
        restored = make(extending, seed=9)
        restored.restore(*learner.state())
        for each in (restored, learner):
            exploring = actions_of(each, 1, number=30)[0]
            assert bool((np.diff(exploring, axis=0) == 0.0).all(axis=1).any()) is is_extended
        learner.on_episode_end({"success": 0})  # exploring episode, which is not counted
        learner.on_episode_start()


def test_restored_learner_is_in_the_same_episode(config):
    first = make(replace(config, constant_episodes=2, greedy_episode_fraction=0.5))
    learn_from_random_transitions(first, 20)
    actions_of(first, 3)
    arrays, values = first.state()
    arrays = {key: value.copy() for key, value in arrays.items()}
    expected = actions_of(first, 3)
    second = make(first.config, seed=9)
    second.restore(arrays, values)
    np.testing.assert_array_equal(actions_of(second, 3), expected)


def test_result_is_the_selected_actor_also_when_restored(config):
    first = make(
        replace(config, constant_episodes=0, greedy_episode_fraction=1.0, selection_window=3, learning_starts=1)
    )
    greedy = []
    for episode, success in enumerate([True, True, True, False]):
        first.on_episode_start()
        greedy.append(first.actor().state_dict()["mu.weight"].clone())
        learn_from_random_transitions(first, 8, seed=episode)
        first.on_episode_end({"success": int(success)})
    arrays, values = first.state()
    second = make(first.config, seed=9)
    second.restore({key: value.copy() for key, value in arrays.items()}, values)
    for learner in (first, second):
        torch.testing.assert_close(learner.selected_actor().state_dict()["mu.weight"], greedy[2], rtol=0, atol=0)
    assert not torch.equal(greedy[2], first.actor().state_dict()["mu.weight"])


def test_another_algorithm_is_added_as_one_class(monkeypatch):
    """DDPG is deterministic and has no entropy coefficient, unlike SAC and TQC."""
    monkeypatch.setattr(LEARNERS, "_entries", dict(LEARNERS._entries))

    @register_learner("ddpg")
    class DdpgLearner(OffPolicyLearner):
        algorithm = DDPG

        def explore(self, observation):
            return np.clip(super().explore(observation) + 0.1 * self.random.standard_normal(2), -1, 1)

    learner = make(resolve_preset("tqc_contact", "ddpg", SETTINGS))
    learn_from_random_transitions(learner, 24)
    arrays, values = learner.state()
    second = make(learner.config, seed=9)
    second.restore({key: value.copy() for key, value in arrays.items()}, values)
    np.testing.assert_array_equal(weights(second), weights(learner))
    policy, observation = learner.policy({"observation_shape": [3]}), np.full(3, 0.3, np.float32)
    expected = learner.actor()._predict(torch.as_tensor(observation)[None]).detach().numpy()[0]
    np.testing.assert_allclose(policy(observation), expected, atol=1e-6)
    assert not np.array_equal(learner.explore(observation), learner.explore(observation))


@pytest.mark.parametrize("order", ["lla", "all", "laln", "lnal", "lnl", "laal", "ll"])
def test_export_refuses_layers_in_another_order(order):
    kinds = {"l": lambda: torch.nn.Linear(3, 3), "a": torch.nn.ReLU, "n": lambda: BatchRenorm1d(3)}
    layers = [kinds[letter]() for letter in order]
    with pytest.raises(InputError, match="can't be exported"):
        export_layers(layers, spaces.Box(-1, 1, (3,)), {"observation_shape": [3], "squash": "clip"})


def test_transition_is_not_stored_when_the_simulation_failed(config):
    """The transition before the failure becomes the last of the episode, and is bootstrapped."""
    learner, observation = make(config), np.zeros(3, np.float32)
    completed = transition(observation, np.zeros(2), 1.0, observation)
    failed = replace(completed, reward=0.0, truncated=True, info={"simulation_failure": "it diverged"})
    for transitions in ((failed,), (completed, failed)):
        learner.on_episode_start()
        for each in transitions:
            learner.on_step(each)
    buffer = learner.model.replay_buffer
    assert (buffer.size(), learner.transitions) == (1, 1)
    assert (buffer.dones[0], buffer.timeouts[0]) == (1, 1)


def test_episode_with_interventions_is_not_selected(config):
    learner = make(replace(config, greedy_episode_fraction=1.0, constant_episodes=0, learning_starts=1))
    learn_from_random_transitions(learner, 2)
    for interventions, num_successes in ((0, 1), (2, 1), (0, 2)):
        learner.on_episode_start()
        assert learner.is_greedy
        learner.on_episode_end({"success": 1, "interventions": interventions})
        assert learner.greedy_successes == num_successes
    assert len(learner.selection._open) == 2


def test_symmetry_is_off_when_demonstrations_are_corrected():
    task = SimpleNamespace(symmetry="both", near_symmetry="all", num_steps=10)
    learner = SimpleNamespace(symmetry="near", takes_images=True)
    config = SimpleNamespace(episodes=1, action_repeat=1, seed=0, learner=learner)
    for is_supervised, via_points, symmetry in ((False, {}, "all"), (True, {}, None), (False, (1.0, 2.0), None)):
        config.human_in_the_loop, config.environment = is_supervised, {"via_points": via_points} if via_points else {}
        assert learner_arguments(config, task)["symmetry"] == symmetry
