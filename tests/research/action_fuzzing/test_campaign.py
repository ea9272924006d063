"""Campaigns of action fuzzing."""

from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.errors import InputError
from guiderail.systems.support.drake_multibody import transform_to_pose
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.episode import Callback
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.tables import read_table
from research.action_fuzzing import tasks
from research.action_fuzzing.campaign import (
    ACTIONS,
    Campaign,
    Case,
    NonFiniteCounter,
    RecomputedViolation,
    find_failures,
    outcome,
    run_campaign,
)
from research.action_fuzzing.pouring import EarlyTilt
from research.action_fuzzing.tasks import CAMPAIGNS, fuzz


class TransitionCounter(Callback):
    """Callback that counts the transitions of an episode."""

    def __init__(self, env):
        self.transitions = 0

    def on_episode_start(self):
        self.transitions = 0

    def on_step(self, transition):
        self.transitions += 1

    def on_episode_end(self, row):
        return {"transitions": self.transitions}


BEAD = Campaign("Bead", [Case("bead", {}, constrained=True)], {}, make_callback=TransitionCounter)


def at_least(count):
    """Return a stopping rule that ends a campaign after `count` episodes."""
    return lambda rows: len(rows) >= count


@pytest.mark.parametrize("name", ACTIONS)
def test_actions_are_within_limits_and_deterministic(name):
    observation = np.zeros(3)
    first, second = (
        np.array([act(observation) for _ in range(50)])
        for act in (ACTIONS[name](np.random.default_rng(4), 2) for _ in range(2))
    )
    np.testing.assert_array_equal(first, second)
    assert np.abs(first).max() <= 1.0
    changes = np.any(np.diff(first, axis=0) != 0.0, axis=1).sum()
    assert {
        "uniform_random": changes == 49,
        "random_hold": changes == 4,
        "bang_bang": 0 < changes < 20,
        "random_corner": changes == 0,
    }[name]


def test_campaign_is_resumed_from_its_table(tmp_path):
    rows = run_campaign(BEAD, at_least(6), seed=3, out=tmp_path / "whole.csv")
    table = tmp_path / "parts.csv"
    run_campaign(BEAD, at_least(2), seed=3, out=table)
    assert len(read_table(table)) == 2
    run_campaign(BEAD, at_least(6), seed=3, out=table)
    assert table.read_text() == (tmp_path / "whole.csv").read_text()
    assert [row["seed"] for row in rows] == [3, 4, 5, 6, 7, 8]
    assert {row["actions"] for row in rows} == set(ACTIONS)
    with pytest.raises(InputError, match="another campaign"):
        run_campaign(BEAD, at_least(6), seed=4, out=table)
    with pytest.raises(InputError, match="another campaign"):
        run_campaign(BEAD, at_least(8), seed=3, out=table, environment={"wall": -0.5})
    run_campaign(BEAD, at_least(7), seed=3, out=table, environment={"wall": 1.0})  # 1.0 is the default


def test_campaign_closes_its_environments(monkeypatch):
    created, closed = [], []

    def make(*arguments):
        env = make_environment(*arguments)
        created.append(env)
        monkeypatch.setattr(env, "close", lambda: closed.append(env))
        return env

    def interrupt(rows):
        if rows:
            raise KeyboardInterrupt
        return False

    monkeypatch.setattr("research.action_fuzzing.campaign.make_environment", make)
    run_campaign(BEAD, at_least(1))
    with pytest.raises(KeyboardInterrupt):
        run_campaign(BEAD, interrupt)
    assert len(created) == 2
    assert closed == created


def test_callback_receives_every_transition():
    for action_repeat in (1, 2):
        row = run_campaign(BEAD, at_least(1), environment={"action_repeat": action_repeat})[0]
        assert row["transitions"] == -(-row["steps"] // action_repeat)


def tilted_env(*steps, state=0):
    """Return an environment with a trace of twenty commands, which are tilted by 0.3 rad at `steps`."""
    trace = EpisodeTrace(20, 6, 0.01, {"state": 1})
    for step in range(20):
        pose = transform_to_pose(RigidTransform(RollPitchYaw(0.3 * (step in steps), 0.0, 0.5), [0.1, 0.0, 0.2]))
        trace.append(pose, pose, 0.0, 0.0, {"state": np.array([state])})
    return SimpleNamespace(unwrapped=SimpleNamespace(trace=trace))


@pytest.mark.parametrize(
    ("env", "tilt"), [(tilted_env(), 0.0), (tilted_env(3), 0.3), (tilted_env(9), 0.3), (tilted_env(3, state=1), 0.0)]
)
def test_early_tilt_covers_every_control_step(env, tilt):
    callback = EarlyTilt(env)
    callback.on_episode_start()
    assert callback.on_episode_end({})["early_tilt"] == pytest.approx(tilt, abs=1e-9)


def test_nan_observations_are_counted():
    class NanObservation(gymnasium.Wrapper):
        def step(self, action):
            observation, *rest = super().step(action)
            return np.full_like(observation, np.nan), *rest

    env = make_environment("Bead", {})
    for wrapped, size in ((env, 0), (NanObservation(env), 3)):
        row = rollout(wrapped, lambda observation: np.zeros(2), NonFiniteCounter(wrapped), seed=0)
        assert row["not_finite"] == size * row["steps"]  # 3 values in an observation


DIFFERS = "reported and recomputed violations differ"
EPISODE = {
    "case": "a", "actions": "uniform_random", "seed": 0, "constrained": 1, "may_wait": 0, "termination": "success",
    "steps": 3, "not_finite": 0, "fallback_steps": 0, "max_commanded_violation": -0.1, "recomputed_violation": -0.1,
    "collisions": 0, "peak_force": 5.0, "depth": 0.1,
}  # fmt: skip


@pytest.mark.parametrize(
    ("changed", "failures"),
    [
        ({}, []),
        ({"termination": "simulation_failure"}, ["the simulation failed"]),
        ({"not_finite": 2}, ["a number was NaN or infinite"]),
        ({"fallback_steps": 1}, ["a prediction failed"]),
        ({"fallback_steps": 1, "may_wait": 1}, []),
        ({"max_commanded_violation": 1e-6, "recomputed_violation": 1e-6}, ["a command violated the constraints"]),
        ({"recomputed_violation": 1e-6}, ["a command violated the constraints", DIFFERS]),
        ({"max_commanded_violation": float("nan")}, ["a command violated the constraints", DIFFERS]),
        ({"recomputed_violation": -0.2}, [DIFFERS]),
        ({"max_commanded_violation": 1e-6, "constrained": 0}, []),
        ({"depth": 0.3}, ["depth beyond 0.2"]),
    ],
)
def test_find_failures_has_a_sentence_per_failed_check(changed, failures):
    assert find_failures(outcome([EPISODE, EPISODE | changed]), {"depth": 0.2}) == failures


def test_connector_passes_with_uniform_actions():
    campaign = CAMPAIGNS["BncConnector"]()
    (case,) = (case for case in campaign.cases if case.name == "skgrl, per_episode, x, y")
    campaign = Campaign(campaign.task, [case], campaign.limits, make_callback=campaign.make_callback)
    (row,) = run_campaign(campaign, at_least(1), environment={"time_step": 0.01})
    assert find_failures(outcome([row]), campaign.limits) == []
    # Depths and a force above zero show that the plug touched the jack.
    assert max(row["lug_impact_mm"], row["barrel_impact_mm"]) > 0.05
    assert row["peak_force"] > 5.0


def test_narrow_passage_passes_with_every_kind_of_action():
    result = fuzz("NarrowPassage", episodes=8, seed=5, environment={"control_period": 0.08})  # a quarter of the steps
    assert result["failures"] == []
    assert result["all"]["episodes"] == 8
    assert set(result["cases"]) == {case.name for case in CAMPAIGNS["NarrowPassage"]().cases}


@pytest.mark.parametrize("error", [0.0, 1e-8])
def test_violation_is_recomputed_from_the_commands(error):
    """An error added to the recorded commands changes only the recomputed violation."""
    (case,) = (case for case in CAMPAIGNS["NarrowPassage"]().cases if case.name == "skgrl, action repeat 5")
    env = make_environment("NarrowPassage", case.environment)
    trace, append = env.unwrapped.trace, env.unwrapped.trace.append
    trace.append = lambda commanded, *rest: append(commanded + [error, 0.0], *rest)
    row = rollout(env, lambda observation: np.ones(2), RecomputedViolation(env), seed=0)
    assert row["max_commanded_violation"] > -1e-9, "no command was at the edge of the zone"
    assert row["recomputed_violation"] == pytest.approx(row["max_commanded_violation"] + error, abs=1e-15)


def test_fuzzing_all_tasks_is_resumed_from_its_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(tasks, "CAMPAIGNS", {task: CAMPAIGNS[task] for task in ("NarrowPassage", "GridClamp")})
    result = fuzz("all", steps=20, seed=5, out=tmp_path)
    assert result["failures"] == []
    assert result["max_commanded_violation"] <= 1e-9
    assert result["control_steps"] == sum(
        len(read_step_log(tmp_path / "steps" / task)) for task in ("NarrowPassage", "GridClamp")
    )
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
    assert fuzz("all", steps=20, seed=5, out=tmp_path) == result
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
    with pytest.raises(InputError, match="give --steps"):
        fuzz("all", episodes=3)


def test_pouring_passes_with_shaking_inputs():
    result = fuzz("Pouring", episodes=1)
    assert result["failures"] == []
    assert 0.0 <= result["all"]["early_tilt"] <= 1e-9


@pytest.mark.parametrize("arguments", [{"episodes": 0}, {"steps": 0}, {"seed": -1}, {"episodes": 2, "steps": 9}])
def test_fuzz_refuses_invalid_arguments(arguments):
    with pytest.raises(InputError):
        fuzz("NarrowPassage", **arguments)


def test_fuzz_names_the_tasks_when_the_task_is_unknown():
    with pytest.raises(InputError, match=", ".join(sorted(CAMPAIGNS))):
        fuzz("Bead")
