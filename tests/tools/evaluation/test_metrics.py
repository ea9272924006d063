import gymnasium
import numpy as np
import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.metrics import (
    COLUMNS,
    STATISTICS,
    episodes_to_convergence,
    find_streak,
    outside_row,
    summary,
)
from guiderail.tools.evaluation.rollout import Paths, rollout

FAILS_AFTER = 215  # control steps


def episodes(successes="", **columns):
    rows = pd.DataFrame({"success": [int(s) for s in successes]})
    return rows.assign(**columns)


@pytest.mark.parametrize(
    ("successes", "episode"),
    [("1" * 10, 0), ("0" + "1" * 10, 1), ("1" * 9, None), ("1" * 9 + "0" + "1" * 12, 10), ("", None)],
)
def test_episodes_to_convergence_precede_ten_successes(successes, episode):
    assert episodes_to_convergence(episodes(successes)) == episode


def test_find_streak_returns_the_index_of_the_first_streak():
    assert find_streak([0, 1, 1, 0, 1, 1, 1], 3) == 4
    assert find_streak([0, 1, 1], 3) is None


def test_collisions_differ_from_episodes_ended_in_collision():
    rows = episodes("00", collisions=[3, 1], termination=["time_limit", "collision"])
    statistics = summary(rows, ("collisions", "ended_in_collision"))
    assert statistics == {"collisions": 4, "ended_in_collision": 1}


def test_maximum_is_nan_when_a_value_is_nan():
    rows = episodes("11", max_commanded_violation=[-1.0, np.nan], peak_force=[np.nan, 2.0])
    statistics = summary(rows, ("max_commanded_violation", "violating_episodes", "peak_force"))
    assert np.isnan(statistics["max_commanded_violation"])
    assert np.isnan(statistics["peak_force"])
    assert statistics["violating_episodes"] == 1
    infos = [{"constraint_violation": value, "contact_force": value} for value in (1.0, np.nan, 2.0)]
    row = outside_row(0, 0.0, infos, is_terminated=True)
    assert np.isnan([row["max_commanded_violation"], row["peak_force"]]).all()


@pytest.mark.parametrize(
    ("infos", "is_reported"), [([{}, {}], 0), ([{"success": False}, {}], 1), ([{}, {"is_success": True}], 1)]
)
def test_outside_row_states_whether_success_is_reported(infos, is_reported):
    assert outside_row(0, 0.0, infos, is_terminated=True)["reports_success"] == is_reported


@pytest.mark.parametrize(("successes", "number"), [(0, 10), (7, 10), (10, 10), (98, 100)])
def test_success_interval_is_the_wilson_interval(successes, number):
    statistics = summary(episodes("1" * successes + "0" * (number - successes)), ("success_low", "success_high"))
    p, z = successes / number, 1.959963984540054
    middle = (p + z**2 / (2 * number)) / (1 + z**2 / number)
    half = z / (1 + z**2 / number) * np.sqrt(p * (1 - p) / number + z**2 / (4 * number**2))
    np.testing.assert_allclose(list(statistics.values()), [middle - half, middle + half], atol=1e-12)


def test_summary_has_the_statistics_of_the_task():
    rows = episodes("1" * 7, reward_obstacle_cost=[-9.0, *6 * [-0.5]])
    assert summary(rows, ["avoids_obstacle_from"], task="NarrowPassage") == {"avoids_obstacle_from": 2}
    with pytest.raises(InputError, match="no statistic 'avoids_obstacle_from'"):
        summary(rows, ["avoids_obstacle_from"], task="GridClamp")


def test_summary_is_none_without_episodes():
    assert set(summary(episodes(), STATISTICS).values()) == {None}


def test_every_metric_has_a_unique_name_and_a_description():
    names = [column.name for column in COLUMNS]
    assert len(set(names)) == len(names)
    assert all(metric.description for metric in (*COLUMNS, *STATISTICS.values()))


def test_row_agrees_with_the_trace():
    """Residual RL does not avoid the walls, so that the episode has collisions."""
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


def test_row_counts_the_steps_before_a_failed_simulation():
    class Failing(gymnasium.Wrapper):
        def step(self, action):
            observation, reward, terminated, truncated, info = super().step(action)
            is_failing = len(self.unwrapped.trace) == FAILS_AFTER
            failure = {"simulation_failure": "it diverged"} if is_failing else {}
            return observation, reward, terminated, truncated or is_failing, info | failure

    env = Failing(make_environment("NarrowPassage", {"guidance": "residual"}))
    random = np.random.default_rng(0)
    row = rollout(env, lambda observation: random.uniform(-1, 1, 2), seed=0)
    is_in_contact = env.unwrapped.trace.force > 0
    assert row["termination"] == "simulation_failure"
    assert row["steps"] == FAILS_AFTER
    assert row["collision_steps"] == is_in_contact.sum() > 0
    assert row["collisions"] == (np.diff(is_in_contact, prepend=False) & is_in_contact).sum()
    assert row["saturated_steps"] == env.unwrapped.trace.signals["saturation"].any(axis=1).sum()


def test_success_of_a_demonstration_is_not_counted():
    rows = episodes("1" * 12 + "00" + "1" * 10, is_demonstration=[1] * 12 + [0] * 12)
    assert episodes_to_convergence(rows) == 14
    assert episodes_to_convergence(episodes("1" * 12, is_demonstration=[1] * 12)) is None
    statistics = summary(rows, ("success_rate", "success_low", "success_rate_last_10"))
    assert statistics["success_rate"] == pytest.approx(10 / 12)
    assert statistics["success_low"] == pytest.approx(0.5520, abs=1e-3)
    statistics = summary(episodes("1", is_demonstration=[1]), ("success_rate", "success_low"))
    assert statistics == {"success_rate": None, "success_low": None}
