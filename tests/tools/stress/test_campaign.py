import gymnasium
import numpy as np
import pytest

from guiderail.models.errors import InputError
from guiderail.tools.learning.run_folder import read_table
from guiderail.tools.stress import bnc_connector as stress_bnc
from guiderail.tools.stress import narrow_passage as stress_passage
from guiderail.tools.stress.campaign import ACTIONS, Case, Witness, campaign, complaints, episode, summary


class Counter(Witness):
    def __init__(self, env):
        self.decisions = 0

    def look(self):
        self.decisions += 1

    def report(self):
        return {"decisions": self.decisions}


@pytest.fixture
def cases():
    def make():
        return gymnasium.make("guiderail/Bead-v0", disable_env_checker=True).unwrapped

    return [Case("bead", make, constrained=True, witness=Counter)]


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
    assert {"white": changes == 49, "held": changes == 4, "corners": 0 < changes < 20, "stuck": changes == 0}[name]


def test_a_campaign_goes_on_where_it_was_stopped(cases, tmp_path):
    whole = campaign(cases, at_least(6), seed=3, out=tmp_path / "whole.csv")
    table = tmp_path / "parts.csv"
    campaign(cases, at_least(2), seed=3, out=table)
    assert len(read_table(table)) == 2
    campaign(cases, at_least(6), seed=3, out=table)
    assert table.read_text() == (tmp_path / "whole.csv").read_text()
    assert [row["seed"] for row in whole] == [3, 4, 5, 6, 7, 8]
    assert {row["actions"] for row in whole} == set(ACTIONS)
    with pytest.raises(InputError, match="another campaign"):
        campaign(cases, at_least(6), seed=4, out=table)


def test_a_witness_looks_at_every_decision(cases):
    row = campaign(cases, at_least(1))[0]
    env = cases[0].make()
    assert row["decisions"] == -(-row["steps"] // env.hold)


def test_numbers_that_are_none_are_counted(cases):
    env = cases[0].make()
    sound = episode(env, lambda observation: np.zeros(env.action_space.shape), seed=0)
    assert sound["not_finite"] == 0
    step = env.step

    def broken(action):
        observation, *rest = step(action)
        return np.full_like(observation, np.nan), *rest

    env.step = broken
    assert episode(env, lambda observation: np.zeros(env.action_space.shape), seed=0)["not_finite"] > 0


SOUND = {
    "constrained": 1,
    "termination": "success",
    "steps": 3,
    "not_finite": 0,
    "fallbacks": 0,
    "worst_violation": -0.1,
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
        ({"fallbacks": 1}, ["a prediction failed"]),
        ({"worst_violation": 1e-6}, ["a command violated the constraints"]),
        ({"worst_violation": 1e-6, "constrained": 0}, []),
        ({"depth": 0.3}, ["depth beyond 0.2"]),
    ],
)
def test_what_must_not_be_is_complained_about(wrong, words):
    assert complaints(summary([SOUND, SOUND | wrong]), {"depth": 0.2}) == words


def test_the_connector_withstands_white_actions():
    (case,) = (case for case in stress_bnc.cases() if case.name == "skgrl, disc, x, y")
    (row,) = campaign([case], at_least(1))
    assert complaints(summary([row]), stress_bnc.LIMITS) == []
    # They did touch: the surfaces gave way a little.
    assert max(row["lug_impact_mm"], row["barrel_impact_mm"]) > 0.05
    assert row["peak_force"] > 5.0


def test_the_narrow_passage_withstands_actions_that_turn_and_actions_that_do_not(capsys):
    assert stress_passage.main(["--episodes", "8", "--seed", "5"]) == 0
    assert '"control_steps"' in capsys.readouterr().out


def test_nonsense_is_refused():
    with pytest.raises(SystemExit):
        stress_passage.main(["--episodes", "0"])
