"""Automatic interventions from a single demonstration: progress in a sliding window, and the replaced actions."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import ReferenceTrajectory
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import rollout
from research.auto_intervention import AutoInterventionConfig, AutoInterventionLearner, SlidingWindow

OPTIONS = {"guidance": "residual", "action_repeat": 10}
SETTINGS = {"learning_starts": 10_000, "window": 25, "stall_actions": 2, "intervention_actions": 3}


def test_progress_only_increases_within_its_window():
    times = np.linspace(0.0, 1.0, 101)
    reference = ReferenceTrajectory(times, np.sin(2.0 * np.pi * times)[:, None], np.full((101, 1, 1), 0.01))
    window = SlidingWindow(reference, 10)
    assert window.advance(reference.means[7])
    assert window.step == 7
    assert not window.advance(reference.means[3])  # an earlier pose: the current step stays the nearest
    assert not window.advance(reference.means[43])  # value of step 7 again, but outside of the window
    assert window.advance(reference.means[12])
    assert window.step == 12


@pytest.fixture(scope="module")
def passage():
    return make_environment("NarrowPassage", OPTIONS)


def run(env, successes=0, **settings):
    """Run an episode after `successes` greedy successes; return learner, actions (N, A) and row of the episode."""
    learner = AutoInterventionLearner(
        AutoInterventionConfig(**SETTINGS | settings), env, action_repeat=10, seed=0, max_transitions=100
    )
    actions, learner.greedy_successes = [], successes
    learner.store = lambda transition: actions.append(transition.action)
    learner.learn = lambda: None
    row = rollout(env, learner.act, learner, seed=1)
    return learner, np.array(actions), row


def test_demonstration_replaces_actions_without_progress(passage, monkeypatch):
    monkeypatch.setattr(SlidingWindow, "advance", lambda self, pose: False)
    _, actions, row = run(passage)
    is_zero = (actions == 0.0).all(axis=1)
    expected = (
        np.arange(len(actions)) % 5 >= 2
    )  # two actions of the policy without progress, then three of the demonstration
    np.testing.assert_array_equal(is_zero, expected)
    assert row["auto_interventions"] == np.sum(np.arange(1, len(actions) + 1) % 5 == 2)


def test_no_intervention_when_the_demonstration_is_followed(passage):
    learner, _, row = run(passage, constant_episodes=0, base_motion_steps=10**6)
    assert row["auto_interventions"] == 0
    assert learner._progress.step > 300


def test_no_intervention_after_three_greedy_successes(passage, monkeypatch):
    monkeypatch.setattr(SlidingWindow, "advance", lambda self, pose: False)
    assert run(passage, successes=2)[2]["auto_interventions"] > 0
    assert run(passage, successes=3)[2]["auto_interventions"] == 0


def test_interventions_are_refused_with_parallel_actors(passage):
    with pytest.raises(InputError, match="num_envs"):
        run(passage, num_envs=1)
