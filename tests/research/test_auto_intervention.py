"""Automatic interventions from one demonstration: progress in a sliding window, and the actions that take over."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import ReferenceTrajectory
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import rollout
from research.auto_intervention import AutoInterventionConfig, AutoInterventionLearner, SlidingWindow

OPTIONS = {"guidance": "residual", "action_repeat": 10}
SETTINGS = {"learning_starts": 10_000, "window": 25, "stall_actions": 2, "intervention_actions": 3}


def test_progress_does_not_go_back_and_does_not_leave_its_window():
    times = np.linspace(0.0, 1.0, 101)
    reference = ReferenceTrajectory(times, np.sin(2.0 * np.pi * times)[:, None], np.full((101, 1, 1), 0.01))
    window = SlidingWindow(reference, 10)
    assert window.advance(reference.means[7])
    assert window.step == 7
    assert not window.advance(reference.means[3])  # behind: the nearest step ahead is the current one
    assert not window.advance(reference.means[43])  # as high as step 7, and outside of the window
    assert window.advance(reference.means[12])
    assert window.step == 12


@pytest.fixture(scope="module")
def passage():
    return make_environment("NarrowPassage", OPTIONS)


def run(env, successes=0, **settings):
    """Run an episode after a number of greedy successes; return the learner, its actions and the row."""
    learner = AutoInterventionLearner(
        AutoInterventionConfig(**SETTINGS | settings), env, action_repeat=10, seed=0, max_transitions=100
    )
    actions, learner.greedy_successes = [], successes
    learner.store = lambda transition: actions.append(transition.action)
    learner.learn = lambda: None
    row = rollout(env, learner.act, learner, seed=1)
    return learner, np.array(actions), row


def test_demonstration_takes_over_while_the_robot_is_stuck(passage, monkeypatch):
    monkeypatch.setattr(SlidingWindow, "advance", lambda self, pose: False)
    _, actions, row = run(passage)
    is_zero = (actions == 0.0).all(axis=1)
    expected = np.arange(len(actions)) % 5 >= 2  # two own actions without progress, then three of the demonstration
    np.testing.assert_array_equal(is_zero, expected)
    assert row["auto_interventions"] == np.sum(np.arange(1, len(actions) + 1) % 5 == 2)


def test_robot_that_follows_the_demonstration_is_left_alone(passage):
    learner, _, row = run(passage, constant_episodes=0, base_motion_steps=10**6)
    assert row["auto_interventions"] == 0
    assert learner._progress.step > 300


def test_no_intervention_once_the_policy_succeeds(passage, monkeypatch):
    monkeypatch.setattr(SlidingWindow, "advance", lambda self, pose: False)
    assert run(passage, successes=2)[2]["auto_interventions"] > 0
    assert run(passage, successes=3)[2]["auto_interventions"] == 0


def test_interventions_are_refused_when_the_learner_acts_elsewhere(passage):
    with pytest.raises(InputError, match="pipelined"):
        run(passage, pipelined=True)
