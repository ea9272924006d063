import gymnasium
import numpy as np
import pandas as pd
import pytest

from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.metrics import COLUMNS, STATISTICS, episodes_to_convergence, first_in_a_row, summary
from guiderail.tools.evaluation.rollout import Paths, rollout


def episodes(successes="", **columns):
    rows = pd.DataFrame({"success": [int(s) for s in successes]})
    return rows.assign(**columns)


@pytest.mark.parametrize(
    ("successes", "episode"),
    [("1" * 10, 0), ("0" + "1" * 10, 1), ("1" * 9, None), ("1" * 9 + "0" + "1" * 12, 10), ("", None)],
)
def test_converged_after_is_how_many_came_before_ten_in_a_row(successes, episode):
    assert episodes_to_convergence(episodes(successes)) == episode


def test_first_in_a_row_is_before_the_first_of_them():
    assert first_in_a_row([0, 1, 1, 0, 1, 1, 1], 3) == 4
    assert first_in_a_row([0, 1, 1], 3) is None


def test_a_collision_and_an_episode_that_ends_in_one_are_two_numbers():
    rows = episodes("00", collisions=[3, 1], termination=["time_limit", "collision"])
    found = summary(rows, ("collisions", "ended_in_collision"))
    assert found == {"collisions": 4, "ended_in_collision": 1}


def test_what_is_no_number_does_not_hide_behind_what_is():
    rows = episodes("11", max_commanded_violation=[-1.0, np.nan], peak_force=[np.nan, 2.0])
    found = summary(rows, ("max_commanded_violation", "violating_episodes", "peak_force"))
    assert np.isnan(found["max_commanded_violation"])
    assert np.isnan(found["peak_force"])
    assert found["violating_episodes"] == 1


@pytest.mark.parametrize(("successes", "number"), [(0, 10), (7, 10), (10, 10), (98, 100)])
def test_the_interval_is_wilsons(successes, number):
    found = summary(episodes("1" * successes + "0" * (number - successes)), ("success_low", "success_high"))
    p, z = successes / number, 1.959963984540054
    middle = (p + z**2 / (2 * number)) / (1 + z**2 / number)
    half = z / (1 + z**2 / number) * np.sqrt(p * (1 - p) / number + z**2 / (4 * number**2))
    np.testing.assert_allclose(list(found.values()), [middle - half, middle + half], atol=1e-12)


def test_nothing_is_said_of_no_episodes():
    assert set(summary(episodes(), STATISTICS).values()) == {None}


def test_every_number_has_a_name_of_its_own_and_words():
    names = [column.name for column in COLUMNS]
    assert len(set(names)) == len(names)
    assert all(metric.words for metric in (*COLUMNS, *STATISTICS.values()))


def test_the_ledger_says_what_the_trace_says():
    """Residual learning without walls in mind: it collides, and the numbers of both sources agree."""
    env = make_environment("NarrowPassage", {"guidance": "residual"})
    random = np.random.default_rng(0)
    row = rollout(env, lambda observation: random.uniform(-1, 1, 2), Paths(env), seed=0)
    trace = env.unwrapped.trace
    assert row["steps"] == len(trace) == len(row["commanded"])
    assert row["peak_force"] == trace.force.max() > 0
    assert row["mean_force"] == pytest.approx(trace.force.mean(), rel=1e-12)
    assert row["mean_squared_force"] == pytest.approx(np.mean(trace.force**2), rel=1e-12)
    assert row["return"] == pytest.approx(trace.reward.sum(), rel=1e-12)
    assert row["collision_steps"] == (trace.force > 0).sum()
    assert row["collisions"] == (np.diff(trace.force > 0, prepend=False) & (trace.force > 0)).sum()
    jerk = np.linalg.norm(np.diff(trace.commanded, 3, axis=0), axis=1).mean() / trace.period**3
    assert row["jerk_commanded_linear"] == pytest.approx(jerk, rel=1e-12)


@pytest.mark.parametrize("gone", ["ledger", "nothing"])
def test_without_a_ledger_what_the_trace_saw_is_counted(gone):
    """Where a simulation failed or a person ended the episode, what had happened is no zero."""

    class WithoutIt(gymnasium.Wrapper):
        def step(self, action):
            *what, info = super().step(action)
            return *what, {key: value for key, value in info.items() if key != gone}

    env = WithoutIt(make_environment("NarrowPassage", {"guidance": "residual"}))
    random = np.random.default_rng(0)
    row = rollout(env, lambda observation: random.uniform(-1, 1, 2), seed=0)
    touches = env.unwrapped.trace.force > 0
    assert row["collision_steps"] == touches.sum() > 0
    assert row["collisions"] == (np.diff(touches, prepend=False) & touches).sum()
    assert row["saturated_steps"] == env.unwrapped.trace.signals["saturation"].any(axis=1).sum()


def test_what_was_demonstrated_is_no_success_of_the_learner():
    rows = episodes("1" * 12 + "00" + "1" * 10, demonstrated=[1] * 12 + [0] * 12)
    assert episodes_to_convergence(rows) == 14
    assert episodes_to_convergence(episodes("1" * 12, demonstrated=[1] * 12)) is None
    found = summary(rows, ("success_rate", "success_low", "success_rate_last_10"))
    assert found["success_rate"] == pytest.approx(10 / 12)
    assert found["success_low"] == pytest.approx(0.5520, abs=1e-3)
    assert summary(episodes("1", demonstrated=[1]), ("success_rate", "success_low")) == dict.fromkeys(
        ("success_rate", "success_low")
    )
