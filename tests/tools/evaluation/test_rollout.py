import itertools

import gymnasium
import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BASELINES, BaselinePolicy
from guiderail.tools.evaluation.episode import Callback
from guiderail.tools.evaluation.metrics import COLUMNS
from guiderail.tools.evaluation.rollout import rollout


class Recorder(Callback):
    """Callback that records its calls."""

    def __init__(self):
        self.calls = []

    def on_episode_start(self):
        self.calls.append("start")

    def on_step(self, transition):
        self.calls.append(transition)

    def on_episode_end(self, row):
        self.calls.append("end")
        return {"transitions": len(self.calls) - 2}


def test_callbacks_are_called_from_start_to_end():
    env, recorder = make_environment("Bead", {"action_repeat": 2}), Recorder()
    row = rollout(env, lambda observation: np.array([0.5, -1.0]), recorder, index=7, seed=3)
    first, *transitions, last = recorder.calls
    assert (first, last) == ("start", "end")
    assert [transition.is_last for transition in transitions] == [False] * (len(transitions) - 1) + [True]
    for before, after in itertools.pairwise(transitions):
        assert before.next_observation is after.observation
    assert row["transitions"] == len(transitions) == -(-row["steps"] // 2)
    assert row["return"] == sum(transition.reward for transition in transitions)
    assert list(row) == [*(column.name for column in COLUMNS), "reward_goal_distance", "transitions"]
    assert row["episode"] == 7


def test_callback_cannot_replace_a_column():
    class Score(Callback):
        def on_episode_end(self, row):
            return {"score": 2.0, "return": 1.0}

    with pytest.raises(InputError, match="on_episode_end returns the column 'return', which"):
        rollout(make_environment("Bead", {}), lambda observation: np.zeros(2), Score(), seed=3)


class Model:
    def predict(self, observation):
        return 0, None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "a seed must be a whole number of at least 0, not -1"),
        ({"seed": 1.5}, "a seed must be a whole number of at least 0, not 1.5"),
        ({"act": 3}, "3 is no policy"),
        ({"act": lambda observation: 7}, "returned 7, and the actions of this environment are 0 to 1"),
        ({"act": lambda observation: "left"}, "returned 'left', and the actions"),
    ],
)
def test_rollout_accepts_models_and_refuses_invalid_arguments(change, message):
    arguments = {"env": gymnasium.make("CartPole-v1"), "act": Model(), "seed": np.int64(3)}
    assert rollout(**arguments) == rollout(arguments["env"], lambda observation: 0, seed=3)
    with pytest.raises(InputError, match=message):
        rollout(**arguments | change)


def test_reward_that_is_not_a_number_is_refused():
    env = gymnasium.wrappers.TransformReward(gymnasium.make("CartPole-v1"), lambda reward: float("nan"))
    with pytest.raises(InputError, match="the environment returned nan as reward"):
        rollout(env, lambda observation: 0, seed=0)


def test_seed_repeats_an_episode_and_held_out_differs():
    env = make_environment("Bead", {})
    rows = [
        rollout(env, lambda observation: np.zeros(2), seed=seed, held_out=held_out)["return"]
        for seed, held_out in ((3, False), (3, False), (4, False), (3, True))
    ]
    assert rows[0] == rows[1]
    assert len(set(rows)) == 3


def test_policy_that_is_a_callback_is_called_once():
    env, calls = make_environment("Bead", {}), []

    class Policy(Callback):
        def on_episode_start(self):
            calls.append("start")

        def __call__(self, observation):
            return np.zeros(2)

    policy = Policy()
    rollout(env, policy, seed=0)
    rollout(env, policy, policy, seed=0)
    assert calls == ["start", "start"]


def test_failed_simulation_has_a_row():
    class Failing(gymnasium.Wrapper):
        def step(self, action):
            observation, reward, *_, info = super().step(action)
            return observation, reward, False, True, info | {"simulation_failure": "it diverged"}

    env = Failing(make_environment("Bead", {}))
    row = rollout(env, lambda observation: np.zeros(2), seed=0)
    assert row["termination"] == "simulation_failure"
    assert (row["steps"], row["success"], row["collisions"]) == (1, 0, 0)
    assert (row["max_commanded_violation"], row["peak_force"]) == (env.unwrapped.x[0] - 1.0, 1.0)


def test_row_has_violations_of_the_start_when_no_step_completes():
    class Failing(gymnasium.Wrapper):
        def step(self, action):
            observation, _, _, _, info = super().step(action)
            self.unwrapped.trace.clear()
            info |= {"simulation_failure": "it diverged", "constraint_violation": 0.25, "measured_violation": 0.5}
            return observation, 0.0, False, True, info

    row = rollout(Failing(make_environment("Bead", {})), lambda observation: np.zeros(2), seed=0)
    assert (row["steps"], row["max_commanded_violation"], row["max_measured_violation"]) == (0, 0.25, 0.5)


def actions_of(policy: BaselinePolicy, episodes: int) -> np.ndarray:
    """Return the first five actions of several episodes, (episodes, 5, A)."""
    actions = []
    for _ in range(episodes):
        policy.on_episode_start()
        actions.append([policy(np.zeros(3)) for _ in range(5)])
    return np.array(actions)


def test_baseline_policies_match_their_names():
    env = make_environment("Bead", {})
    zero, uniform_random, constant = (
        actions_of(BaselinePolicy(BASELINES[name], env, 3), 4) for name in ("zero", "uniform_random", "constant")
    )
    assert not zero.any()
    assert len(np.unique(uniform_random.reshape(-1, 2), axis=0)) == 20
    assert (constant == constant[:, :1]).all()
    assert len(np.unique(constant[:, 0], axis=0)) == 4
    for name, actions in (("uniform_random", uniform_random), ("constant", constant)):
        assert np.abs(actions).max() <= 1.0
        np.testing.assert_array_equal(actions_of(BaselinePolicy(BASELINES[name], env, 3), 4), actions)
        assert not np.array_equal(actions_of(BaselinePolicy(BASELINES[name], env, 4), 4), actions)
