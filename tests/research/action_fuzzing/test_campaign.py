from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw

from guiderail.diagrams.envs.trace import EpisodeTrace
from guiderail.models.common.errors import InputError
from guiderail.models.common.poses import transform_to_pose
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import Callback, rollout
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.tables import read_table
from research.action_fuzzing import STRESSED, bnc_connector, narrow_passage
from research.action_fuzzing import campaign as campaign_module
from research.action_fuzzing.campaign import ACTIONS, Campaign, Case, Finite, complaints, outcome, run_campaign, stress
from research.action_fuzzing.pouring import EarlyTilt
from research.action_fuzzing.recompute import RecomputedViolation


class Counter(Callback):
    def __init__(self, env):
        self.decisions = 0

    def on_episode_start(self):
        self.decisions = 0

    def on_step(self, decision):
        self.decisions += 1

    def on_episode_end(self, row):
        return {"decisions": self.decisions}


BEAD = Campaign("Bead", [Case("bead", {}, constrained=True)], {}, witness=Counter)


def at_least(count):
    return lambda rows: len(rows) >= count


@pytest.mark.parametrize("name", ACTIONS)
def test_actions_are_within_limits_and_follow_from_the_seed(name):
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


def test_a_campaign_goes_on_where_it_was_stopped(tmp_path):
    whole = run_campaign(BEAD, at_least(6), seed=3, out=tmp_path / "whole.csv")
    table = tmp_path / "parts.csv"
    run_campaign(BEAD, at_least(2), seed=3, out=table)
    assert len(read_table(table)) == 2
    run_campaign(BEAD, at_least(6), seed=3, out=table)
    assert table.read_text() == (tmp_path / "whole.csv").read_text()
    assert [row["seed"] for row in whole] == [3, 4, 5, 6, 7, 8]
    assert {row["actions"] for row in whole} == set(ACTIONS)
    with pytest.raises(InputError, match="another campaign"):
        run_campaign(BEAD, at_least(6), seed=4, out=table)
    with pytest.raises(InputError, match="another campaign"):
        run_campaign(BEAD, at_least(8), seed=3, out=table, environment={"wall": -0.5})
    run_campaign(BEAD, at_least(7), seed=3, out=table, environment={"wall": 1.0})  # as it is anyway


def test_a_witness_sees_every_decision_and_a_case_takes_further_options():
    for action_repeat in (1, 2):
        row = run_campaign(BEAD, at_least(1), environment={"action_repeat": action_repeat})[0]
        assert row["decisions"] == -(-row["steps"] // action_repeat)


def _tilted_at(*steps, state=0):
    """An episode of twenty control steps, two decisions of pouring, in which the command leans over in some."""
    trace = EpisodeTrace(20, 6, 0.01, {"state": 1})
    for step in range(20):
        pose = transform_to_pose(RigidTransform(RollPitchYaw(0.3 * (step in steps), 0.0, 0.5), [0.1, 0.0, 0.2]))
        trace.append(pose, pose, 0.0, 0.0, {"state": np.array([state])})
    return SimpleNamespace(unwrapped=SimpleNamespace(trace=trace))


@pytest.mark.parametrize(
    ("env", "tilt"),
    [(_tilted_at(), 0.0), (_tilted_at(3), 0.3), (_tilted_at(9), 0.3), (_tilted_at(3, state=1), 0.0)],
)
def test_a_tilt_that_comes_too_early_is_seen_at_every_control_step(env, tilt):
    witness = EarlyTilt(env)
    witness.on_episode_start()
    assert witness.on_episode_end({})["early_tilt"] == pytest.approx(tilt, abs=1e-9)


def test_numbers_that_are_none_are_counted():
    class Broken(gymnasium.Wrapper):
        def step(self, action):
            observation, *rest = super().step(action)
            return np.full_like(observation, np.nan), *rest

    env = make_environment("Bead", {})
    for made, count in ((env, 0), (Broken(env), 3)):
        row = rollout(made, lambda observation: np.zeros(2), Finite(made), seed=0)
        assert row["not_finite"] == count * row["steps"]


MISLED = "what was said of a command is not what it was"
SOUND = {
    "case": "one",
    "actions": "uniform_random",
    "seed": 0,
    "constrained": 1,
    "waits": 0,
    "termination": "success",
    "steps": 3,
    "not_finite": 0,
    "fallback_steps": 0,
    "max_commanded_violation": -0.1,
    "recomputed_violation": -0.1,
    "collisions": 0,
    "peak_force": 5.0,
    "depth": 0.1,
}


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({}, []),
        ({"termination": "simulation_failure"}, ["the simulation failed"]),
        ({"not_finite": 2}, ["something was not finite"]),
        ({"fallback_steps": 1}, ["a prediction failed"]),
        ({"fallback_steps": 1, "waits": 1}, []),
        ({"max_commanded_violation": 1e-6, "recomputed_violation": 1e-6}, ["a command violated the constraints"]),
        ({"recomputed_violation": 1e-6}, ["a command violated the constraints", MISLED]),
        ({"max_commanded_violation": float("nan")}, ["a command violated the constraints", MISLED]),
        ({"recomputed_violation": -0.2}, [MISLED]),
        ({"max_commanded_violation": 1e-6, "constrained": 0}, []),
        ({"depth": 0.3}, ["depth beyond 0.2"]),
    ],
)
def test_what_must_not_be_is_complained_about(wrong, words):
    assert complaints(outcome([SOUND, SOUND | wrong]), {"depth": 0.2}) == words


def test_the_connector_withstands_white_actions():
    campaign = bnc_connector.campaign()
    (case,) = (case for case in campaign.cases if case.name == "skgrl, disc, x, y")
    one = Campaign(campaign.task, [case], campaign.limits, witness=campaign.witness)
    (row,) = run_campaign(one, at_least(1))
    assert complaints(outcome([row]), campaign.limits) == []
    # They did touch: the surfaces gave way a little.
    assert max(row["lug_impact_mm"], row["barrel_impact_mm"]) > 0.05
    assert row["peak_force"] > 5.0


def test_the_narrow_passage_withstands_actions_that_turn_and_actions_that_do_not():
    found = stress("NarrowPassage", episodes=8, seed=5)
    assert found["wrong"] == []
    assert found["all"]["episodes"] == 8
    assert set(found["cases"]) == {case.name for case in narrow_passage.campaign().cases}


@pytest.mark.parametrize("lie", [0.0, 1e-8])
def test_a_violation_is_recomputed_from_what_was_commanded(lie):
    """Commands that are beside what the environment says of them are seen."""
    (case,) = (case for case in narrow_passage.campaign().cases if case.name == "skgrl, hold 5")
    env = make_environment("NarrowPassage", case.environment)
    base, recorded = env.unwrapped, env.unwrapped.trace.append
    base.trace.append = lambda commanded, *rest: recorded(commanded + [lie, 0.0], *rest)
    row = rollout(env, lambda observation: np.ones(2), RecomputedViolation(env), seed=0)
    assert row["max_commanded_violation"] > -1e-9, "it never came to the zone's edge"
    assert row["recomputed_violation"] == pytest.approx(row["max_commanded_violation"] + lie, abs=1e-15)


def test_all_tasks_are_stressed_in_one_folder_and_go_on_there(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign_module, "STRESSED", {"NarrowPassage": "narrow_passage", "GridClamp": "grid_clamp"})
    found = stress("all", steps=20, seed=5, out=tmp_path)
    assert found["wrong"] == []
    assert found["max_commanded_violation"] <= 1e-9
    assert found["control_steps"] == sum(
        len(read_step_log(tmp_path / "steps" / task)) for task in ("NarrowPassage", "GridClamp")
    )
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
    assert stress("all", steps=20, seed=5, out=tmp_path) == found
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*.csv")}
    with pytest.raises(InputError, match="give --steps"):
        stress("all", episodes=3)


def test_pouring_withstands_somebody_with_shaking_hands():
    found = stress("Pouring", episodes=1)
    assert found["wrong"] == []
    assert 0.0 <= found["all"]["early_tilt"] <= 1e-9


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"steps": 0}, {"seed": -1}])
def test_nonsense_is_refused(wrong):
    with pytest.raises(InputError):
        stress("NarrowPassage", **wrong)


def test_a_task_without_a_campaign_is_told_those_that_have_one():
    with pytest.raises(InputError, match=", ".join(sorted(STRESSED))):
        stress("Bead")
