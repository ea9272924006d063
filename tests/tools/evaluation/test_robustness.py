import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.policy import Policy
from guiderail.tools.environments import check_environment
from guiderail.tools.evaluation import robustness as axes
from guiderail.tools.evaluation import robustness as module
from guiderail.tools.evaluation.baselines import BaselinePolicy, uniform_random
from guiderail.tools.evaluation.evaluate import HELD_OUT_SEED, kept_file
from guiderail.tools.evaluation.robustness import AXES, Axis, _Who, breaks, chosen_axes, draw, points, robustness
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import run_training

WALL = Axis("wall", "wall [m]", (-0.5, 1.0), 1.0, lambda environment, value: {"wall": value})


@pytest.fixture
def run(bead_run, monkeypatch):
    monkeypatch.setattr(axes, "AXES", (WALL,))
    return bead_run


def test_each_place_is_judged_once_and_what_was_done_is_used_again(run, capsys):
    told = []
    how = {"episodes": 3, "baselines": {"uniform_random": partial(BaselinePolicy, uniform_random)}, "tell": told.append}
    first = robustness([run], **how)
    assert {row["who"] for row in first["rows"]} == {"policy", "demonstration", "uniform_random"}
    assert [row["value"] for row in first["rows"] if row["who"] == "policy"] == [-0.5, 1.0]
    assert all(row["success_low"] <= row["success_rate"] <= row["success_high"] for row in first["rows"])
    assert "4/6 wall 1 policy 3/3" in capsys.readouterr().err
    assert robustness([run], **how)["rows"] == first["rows"]
    assert "policy 3/3" not in capsys.readouterr().err
    assert len(pd.read_csv(first["table"])) == 6
    assert first["picture"].stat().st_size > 10_000
    assert robustness([run], **{**how, "episodes": 2})["rows"] != first["rows"]


def test_another_question_leaves_the_answer_to_the_first(run, monkeypatch):
    asked = [{}, {"axes": "wall"}, {"environment": {"action_repeat": 2}}]
    asked += [{"episodes": 2}, {"seed": 7}, {"baselines": {"uniform_random": partial(BaselinePolicy, uniform_random)}}]
    monkeypatch.setattr(module, "EPISODES", 1)
    tables = [robustness([run], **{"episodes": 1, **one})["table"] for one in asked]
    words = ["", "-wall", "-hold=2", "-episodes=2", "-seed=7", "-white"]
    assert [table.stem for table in tables] == [f"robustness{one}" for one in words]
    for table in tables:
        assert all(table.with_suffix(kind).is_file() for kind in (".csv", ".md", ".png"))


def test_who_is_called_as_a_formula_would_be_has_a_picture(run, tmp_path):
    rows = [row | {"who": "a$_{$"} for row in robustness([run], episodes=1)["rows"]]
    assert draw(tmp_path / "picture.png", rows).is_file()


def test_a_place_where_the_policy_fails_is_named(run):
    found = robustness([run], episodes=2)
    assert -0.5 in breaks(found["rows"], "policy")["wall"]


def test_another_policy_in_the_folder_is_judged_anew(run, capsys):
    robustness([run], episodes=2)
    policy = Policy.load(run)
    policy._layers[0][0][0, 0] += 0.1
    policy.save(run)
    capsys.readouterr()
    robustness([run], episodes=2)
    said = capsys.readouterr().err
    assert "policy 2/2" in said
    assert "demonstration 2/2" not in said


def test_several_runs_are_in_one_table_and_a_further_one_costs_only_its_own_episodes(
    run, bead_config, tmp_path, capsys
):
    other = replace(bead_config, environment={**bead_config.environment, "guidance": "kmp"})
    run_training(RunFolder(tmp_path / "other"), other)
    told, out = [], tmp_path / "both"
    robustness([run], episodes=2, out=out)
    capsys.readouterr()
    with pytest.raises(InputError, match="--out"):
        robustness([run, tmp_path / "other"], episodes=2)
    found = robustness([run, tmp_path / "other"], episodes=2, out=out, tell=told.append)
    said = capsys.readouterr().err
    assert found["policies"] == ["sKGRL", "demonstration alone"]
    assert told == ["the runs differ in guidance"]
    assert "demonstration 2/2" not in said
    assert "demonstration alone 2/2" in said
    assert [row["who"] for row in found["rows"]] == ["sKGRL", "demonstration alone", "demonstration"] * 2
    assert robustness([run, tmp_path / "other"], episodes=2, out=out)["rows"] == found["rows"]
    assert capsys.readouterr().err == ""


def test_runs_of_different_tasks_or_the_same_folder_twice_are_refused(run, tmp_path):
    with pytest.raises(InputError, match="different ones"):
        robustness([run, run], out=tmp_path)
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(config.replace("task: Bead", "task: NarrowPassage"))
    with pytest.raises(InputError, match="of one task, not of Bead and NarrowPassage"):
        robustness([run, copy], out=tmp_path)


@pytest.mark.parametrize("wrong", [{"episodes": 0}, {"axes": "frictoin"}])
def test_what_makes_no_sense_is_refused(run, wrong):
    with pytest.raises(InputError):
        robustness([run], **wrong)


@pytest.mark.parametrize("task", ["BncConnector", "GridClamp"])
def test_every_axis_can_be_made_or_says_why_not(task):
    arguments = check_environment(task, {})
    found, left_out = points(task, arguments, AXES)
    assert len(found) + len(left_out) == sum(len(axis.values) for axis in AXES)
    for axis in AXES:
        at = {point.value: point.environment for point in found if point.axis is axis}
        if axis.trained in at:
            assert at[axis.trained] == arguments
        assert all(at[value] != arguments for value in at if value != axis.trained)
    names = {sentence.split()[0] for sentence in left_out}
    assert names <= {"payload", "clearance", "offsets"}
    assert all(": " in sentence for sentence in left_out)


def test_a_policy_that_learned_with_a_whole_range_is_judged_at_each_value_of_it():
    arguments = check_environment("BncConnector", {"friction_factor": (0.5, 2.0), "stiffness_factor": 1.7})
    found, _ = points("BncConnector", arguments, chosen_axes("friction,stiffness,lost"))
    at = {(point.axis.name, point.value): point for point in found}
    assert at["friction", 1.0].environment["friction_factor"] == (1.0, 1.0)
    assert at["stiffness", 1.0].environment["stiffness_factor"] == 1.0
    assert at["lost", 0.0].environment == arguments
    assert {point.axis.name: point.trained for point in found} == {"friction": None, "stiffness": None, "lost": 0.0}


@pytest.mark.parametrize(("fixture_offset", "anew"), [("per_run", True), ("per_episode", False)])
def test_offsets_that_a_run_hides_are_drawn_anew_in_every_episode_of_their_axis_alone(fixture_offset, anew):
    """What is drawn in every episode anyway is asked for as before, and found where it was kept."""
    found, _ = points("BncConnector", {"fixture_offset": fixture_offset}, AXES)
    for point in found:
        assert point.options == ({"new_run": True} if anew and point.axis.name == "offsets" else {})


def test_everybody_meets_a_new_offset_in_every_episode_and_what_was_kept_of_one_offset_is_not_taken(
    bead_config, tmp_path, monkeypatch
):
    """Of a learned policy, here one that stands still, and of who acts beside it."""
    environment = check_environment(
        "BncConnector", {"fixture_offset": "per_run", "guidance": "kgrl", "action_repeat": 25}
    )
    config = replace(bead_config, task="BncConnector", environment=environment)
    met = {"policy": [], "uniform_random": []}

    def watching(name):
        def acts(env):
            def act(_):
                met[name].append(tuple(env.unwrapped.drawn["jack_offset"]))
                return np.zeros(env.action_space.shape)

            return act

        return acts

    def one(*_):
        return [_Who("policy", watching("policy"), config, environment)]

    (offsets,) = chosen_axes("offsets")
    monkeypatch.setattr("guiderail.tools.evaluation.robustness._policies", one)
    monkeypatch.setattr(axes, "AXES", (replace(offsets, values=(2.0,)),))
    robustness([tmp_path], episodes=2, baselines={"uniform_random": watching("uniform_random")}, out=tmp_path)
    # In the run's own place, the first, it is only asked whether it suits the environment.
    places = {name: set(seen) - {seen[0]} for name, seen in met.items()}
    assert len(places["policy"]) == 2
    assert places["policy"] == places["uniform_random"]
    assert all(2.0 * MM <= np.hypot(*place) <= 3.0 * MM for place in places["policy"])
    (point,), _ = points("BncConnector", environment, axes.AXES)
    before = kept_file(tmp_path / "episodes", "policy", config, point.environment, episodes=2, seed=HELD_OUT_SEED)
    kept = list((tmp_path / "episodes").glob("policy-*.csv"))
    assert len(kept) == 1
    assert before not in kept


def test_offsets_go_up_to_twice_the_trained_ones():
    (offsets,) = chosen_axes("offsets")
    found, _ = points("BncConnector", {"fixture_offset": "per_episode"}, [offsets])
    assert found[-1].environment["offset_range"] == (0.0, 2.0 * 1.5e-3)
