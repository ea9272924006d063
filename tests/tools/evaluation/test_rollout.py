import itertools

import gymnasium
import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BASELINES, BaselinePolicy
from guiderail.tools.evaluation.metrics import COLUMNS
from guiderail.tools.evaluation.rollout import Callback, rollout


class Diary(Callback):
    def __init__(self):
        self.said = []

    def on_episode_start(self):
        self.said.append("begin")

    def on_step(self, decision):
        self.said.append(decision)

    def on_episode_end(self, row):
        self.said.append("end")
        return {"decisions": len(self.said) - 2}


def test_callbacks_are_called_from_start_to_end():
    env, diary = make_environment("Bead", {"action_repeat": 2}), Diary()
    row = rollout(env, lambda observation: np.array([0.5, -1.0]), diary, index=7, seed=3)
    first, *decisions, last = diary.said
    assert (first, last) == ("begin", "end")
    assert [decision.is_last for decision in decisions] == [False] * (len(decisions) - 1) + [True]
    for before, after in itertools.pairwise(decisions):
        assert before.next_observation is after.observation
    assert row["decisions"] == len(decisions) == -(-row["steps"] // 2)
    assert row["return"] == sum(decision.reward for decision in decisions)
    assert list(row) == [*(c.name for c in COLUMNS), "reward_goal_distance", "decisions"]
    assert row["episode"] == 7


def test_callback_cannot_replace_a_column():
    class Score(Callback):
        def on_episode_end(self, row):
            return {"score": 2.0, "return": 1.0}

    with pytest.raises(InputError, match="on_episode_end returns the column 'return', which"):
        rollout(make_environment("Bead", {}), lambda observation: np.zeros(2), Score(), seed=3)


class Predicting:
    def predict(self, observation):
        return 0, None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": -1}, "a seed is a whole number of at least 0, not -1"),
        ({"seed": 1.5}, "a seed must be a whole number, not 1.5"),
        (
            {"env": "CartPole-v1"},
            "an episode runs in an environment, as gymnasium.make returns it, not in 'CartPole-v1'",
        ),
        ({"act": 3}, "3 is no policy"),
        ({"act": lambda observation: 7}, "returned 7, and the actions of this environment are 0 to 1"),
        ({"act": lambda observation: "left"}, "returned 'left', and the actions"),
    ],
)
def test_rollout_takes_and_refuses_what_an_evaluation_does(change, message):
    given = {"env": gymnasium.make("CartPole-v1"), "act": Predicting(), "seed": np.int64(3)}
    own = rollout(**given)
    assert own == rollout(given["env"], lambda observation: 0, seed=3)
    with pytest.raises(InputError, match=message):
        rollout(**given | change)


def test_reward_that_is_not_a_number_is_refused():
    env = gymnasium.wrappers.TransformReward(gymnasium.make("CartPole-v1"), lambda reward: float("nan"))
    with pytest.raises(InputError, match="the environment returned NaN as reward"):
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
    env, messages = make_environment("Bead", {}), []

    class Policy(Callback):
        def on_episode_start(self):
            messages.append("begin")

        def __call__(self, observation):
            return np.zeros(2)

    policy = Policy()
    rollout(env, policy, seed=0)
    rollout(env, policy, policy, seed=0)
    assert messages == ["begin", "begin"]


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


def test_rollout_has_the_violations_of_the_start_when_it_fails_at_once():
    class Failing(gymnasium.Wrapper):
        def step(self, action):
            observation, _, _, _, info = super().step(action)
            self.unwrapped.trace.clear()
            info |= {"simulation_failure": "it diverged", "constraint_violation": 0.25, "measured_violation": 0.5}
            return observation, 0.0, False, True, info

    row = rollout(Failing(make_environment("Bead", {})), lambda observation: np.zeros(2), seed=0)
    assert (row["steps"], row["max_commanded_violation"], row["max_measured_violation"]) == (0, 0.25, 0.5)


def acted(policy: BaselinePolicy, episodes: int) -> np.ndarray:
    actions = []
    for _ in range(episodes):
        policy.on_episode_start()
        actions.append([policy(np.zeros(3)) for _ in range(5)])
    return np.array(actions)


def test_baseline_policies_match_their_names():
    env = make_environment("Bead", {})
    zero, uniform_random, constant = (
        acted(BaselinePolicy(BASELINES[name], env, 3), 4) for name in ("zero", "uniform_random", "constant")
    )
    assert not zero.any()
    assert len(np.unique(uniform_random.reshape(-1, 2), axis=0)) == 20
    assert (constant == constant[:, :1]).all()
    assert len(np.unique(constant[:, 0], axis=0)) == 4
    for name, actions in (("uniform_random", uniform_random), ("constant", constant)):
        assert np.abs(actions).max() <= 1.0
        np.testing.assert_array_equal(acted(BaselinePolicy(BASELINES[name], env, 3), 4), actions)
        assert not np.array_equal(acted(BaselinePolicy(BASELINES[name], env, 4), 4), actions)
