from functools import partial

import numpy as np
import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy, still, uniform_random
from guiderail.tools.evaluation.evaluate import COMPARED, cached, evaluate, evaluate_policy, evaluation_scope
from guiderail.tools.learning.run_folder import RunFolder


def test_every_episode_has_conditions_of_its_own_and_any_of_them_can_be_had_again():
    env = make_environment("Bead", {})
    four = evaluate_policy(env, lambda observation: np.zeros(2), episodes=4, seed=20)
    assert four["return"].nunique() == 4
    again = evaluate_policy(env, lambda observation: np.zeros(2), episodes=2, seed=22)
    assert again["return"].tolist() == four["return"][2:].tolist()


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"episodes": 1, "seed": -1}, {"episodes": 1, "seed": 2**31}])
def test_numbers_out_of_range_are_refused(wrong):
    with pytest.raises(InputError):
        evaluate_policy(make_environment("Bead", {}), lambda observation: np.zeros(2), **wrong)


def test_what_is_known_is_not_evaluated_again(tmp_path):
    asked = []

    def evaluated():
        asked.append(1)
        return pd.DataFrame({"success": [1, 0], "return": [0.1 + 0.2, -np.inf]})

    first, again = (cached(tmp_path / "rows.csv", evaluated) for _ in range(2))
    pd.testing.assert_frame_equal(first, again)
    assert len(asked) == 1


def test_the_demonstration_meets_the_same_episodes_as_the_policy(bead_run, capsys):
    result = evaluate(bead_run, episodes=3)
    said = capsys.readouterr().err
    assert "series 1 of 2: the policy 3/3" in said
    assert "series 2 of 2: demonstration alone 3/3" in said
    for name in COMPARED:
        assert result[f"demonstration_{name}"] is not None, name
    elsewhere = evaluate(bead_run, episodes=3, environment={"wall": -0.5})
    assert elsewhere["success_rate"] == elsewhere["demonstration_success_rate"] == 0.0
    assert elsewhere["mean_return"] != result["mean_return"]


def test_what_learned_nothing_meets_the_same_episodes_once(bead_run, capsys):
    policies = {
        "zero": still,
        "uniform_random": partial(BaselinePolicy, uniform_random),
        "other": lambda env: lambda observation: np.zeros(7),
    }
    first = evaluate(bead_run, episodes=3, baselines=policies)
    assert first["baselines"] == ["demonstration", "zero", "uniform_random"]
    for name in COMPARED:
        assert first[f"zero_{name}"] == first[f"demonstration_{name}"]
    assert first["white_mean_return"] != first["zero_mean_return"]
    assert "series 4 of 5: white noise 3/3" in capsys.readouterr().err
    again = evaluate(bead_run, episodes=3, baselines=policies)
    said = capsys.readouterr().err
    for who in ("series 2 of 5: demonstration alone", "series 4 of 5: white noise"):
        assert f"{who}: kept from before, and not run again" in said
        assert f"{who} 3/3" not in said
    assert again == first
    assert evaluate(bead_run, episodes=4, baselines=policies)["white_mean_return"] != first["white_mean_return"]


def test_a_policy_for_one_offset_and_one_for_any_are_two_claims(bead_run):
    one = evaluation_scope("BncConnector", {"fixture_offset": "per_run"}, resample_offsets=False)
    for_any = evaluation_scope("BncConnector", {"fixture_offset": "per_run"}, resample_offsets=True)
    assert "the one offset that is hidden in this run" in one
    assert for_any == evaluation_scope("GridClamp", {"fixture_offset": "per_episode"}, resample_offsets=False) != one
    assert evaluate(bead_run, episodes=1)["evaluation_scope"] == "a policy for starts that training never drew"
    with pytest.raises(InputError, match="hides nothing that could be drawn anew: leave --fresh out"):
        evaluate(bead_run, episodes=1, resample_offsets=True)


def test_what_a_run_hid_is_not_among_what_is_drawn_anew(bead_run, monkeypatch):
    monkeypatch.setattr("guiderail.tools.evaluation.evaluate.claim", lambda *given: "for any")
    own = RunFolder(bead_run).config().seed
    for seed, episodes in ((own, 1), (own - 2, 3)):
        with pytest.raises(InputError, match="hides what the run itself hid"):
            evaluate(bead_run, episodes=episodes, seed=seed, resample_offsets=True)


def test_what_is_hidden_in_a_run_is_drawn_anew_only_where_that_is_asked_for():
    env = make_environment("BncConnector", {"fixture_offset": "per_run"})
    env.reset(seed=3)
    for options, places in (({}, 1), ({"new_run": True}, 3)):
        drawn = [env.reset(seed=seed, options={"held_out": True} | options)[1]["jack_offset"] for seed in (7, 8, 9)]
        assert len({tuple(offset) for offset in drawn}) == places
