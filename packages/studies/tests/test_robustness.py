import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd
import pytest

import guiderail_studies.robustness as module
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.policy import Policy
from guiderail.tools.environments import check_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy, uniform_random, zero_policy
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.evaluation import episodes_file
from guiderail.tools.evaluation.subject import Subject
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.trainer import run_training
from guiderail_studies.robustness import AXES, Axis, draw, points, robustness, select_axes, values_below

WALL = Axis("wall", "wall [m]", (-0.5, 1.0), 1.0, lambda environment, value: {"wall": value})


@pytest.fixture
def run(bead_run, monkeypatch):
    """Return a run whose robustness is evaluated on one axis, without pictures, which take most of the time."""
    monkeypatch.setattr(module, "AXES", (WALL,))
    monkeypatch.setattr(module, "draw", lambda path, rows: path.touch() or path)
    return bead_run


def test_robustness_evaluates_each_point_once(run, capsys, monkeypatch):
    monkeypatch.setattr(module, "draw", draw)
    options = {"episodes": 3, "baselines": {"uniform_random": partial(BaselinePolicy, uniform_random)}}
    first = robustness([run], **options)
    assert {row["policy"] for row in first["rows"]} == {"policy", "demonstration", "uniform_random"}
    assert [row["value"] for row in first["rows"] if row["policy"] == "policy"] == [-0.5, 1.0]
    assert all(row["success_low"] <= row["success_rate"] <= row["success_high"] for row in first["rows"])
    assert "4/6 wall 1 policy 3/3" in capsys.readouterr().err
    assert robustness([run], **options)["rows"] == first["rows"]
    assert "policy 3/3" not in capsys.readouterr().err
    assert len(pd.read_csv(first["table"])) == 6
    assert first["picture"].stat().st_size > 10_000
    assert robustness([run], **{**options, "episodes": 2})["rows"] != first["rows"]


def test_table_is_named_after_the_arguments(run, monkeypatch):
    options = [{}, {"axes": "wall"}, {"environment": {"action_repeat": 2}}, {"episodes": 2}, {"seed": 7}]
    options.append({"baselines": {"uniform_random": partial(BaselinePolicy, uniform_random)}})
    monkeypatch.setattr(module, "EPISODES", 1)
    columns = {"success": [1], "steps": [5], "peak_force": [2.0], "max_commanded_violation": [0.0]}
    monkeypatch.setattr(module, "evaluate_once", lambda *_, **options: pd.DataFrame(columns))
    tables = [robustness([run], **{"episodes": 1, **each})["table"] for each in options]
    suffixes = ["", "-wall", "-action_repeat=2", "-episodes=2", "-seed=7", "-uniform_random"]
    assert [table.stem for table in tables] == [f"robustness{suffix}" for suffix in suffixes]
    for table in tables:
        assert all(table.with_suffix(ending).is_file() for ending in (".csv", ".md", ".png"))


def test_draw_accepts_a_name_with_dollar_signs(run, tmp_path):
    rows = [row | {"policy": "a$_{$"} for row in robustness([run], episodes=1)["rows"]]
    assert draw(tmp_path / "picture.png", rows).is_file()


def test_table_has_nan_when_an_episode_has_nan(run, monkeypatch):
    columns = {"success": [1, 1], "steps": [5, 5], "peak_force": [np.nan, 2.0], "max_commanded_violation": [-1, np.nan]}
    monkeypatch.setattr(module, "evaluate_once", lambda *_, **options: pd.DataFrame(columns))
    for row in robustness([run], episodes=2)["rows"]:
        assert np.isnan([row["peak_force"], row["max_commanded_violation"]]).all()


def test_values_below_names_values_at_which_the_policy_fails(run):
    result = robustness([run], episodes=2)
    assert -0.5 in values_below(result["rows"], "policy")["wall"]


def test_robustness_re_evaluates_a_changed_policy(run, capsys):
    robustness([run], episodes=2)
    policy = Policy.load(run)
    policy._layers[0][0][0, 0] += 0.1
    policy.save(run)
    capsys.readouterr()
    robustness([run], episodes=2)
    printed = capsys.readouterr().err
    assert "policy 2/2" in printed
    assert "demonstration 2/2" not in printed


def test_robustness_compares_several_runs(run, bead_config, tmp_path, capsys):
    config = replace(bead_config, environment={**bead_config.environment, "guidance": "kmp"})
    run_training(RunFolder(tmp_path / "other"), config)
    sentences, out = [], tmp_path / "both"
    robustness([run], episodes=2, out=out)
    capsys.readouterr()
    with pytest.raises(InputError, match="--out"):
        robustness([run, tmp_path / "other"], episodes=2)
    result = robustness([run, tmp_path / "other"], episodes=2, out=out, log=sentences.append)
    printed = capsys.readouterr().err
    assert result["policies"] == ["sKGRL", "demonstration alone"]
    assert sentences == ["the runs differ in guidance"]
    assert "demonstration 2/2" not in printed
    assert "demonstration alone 2/2" in printed
    assert [row["policy"] for row in result["rows"]] == ["sKGRL", "demonstration alone", "demonstration"] * 2
    assert robustness([run, tmp_path / "other"], episodes=2, out=out)["rows"] == result["rows"]
    assert capsys.readouterr().err == ""


def test_policies_by_name_have_separate_episodes_and_tables(run, tmp_path):
    options = {"task": "Bead", "episodes": 1, "out": tmp_path}
    first, second = (robustness([name], **options) for name in ("zero", "random_corner"))
    assert first["rows"][2]["max_commanded_violation"] != second["rows"][2]["max_commanded_violation"]
    assert first["table"] != second["table"]
    assert second["rows"] == robustness(["random_corner"], **options | {"out": tmp_path / "new"})["rows"]


def test_baseline_among_the_policies_is_evaluated_once(run, tmp_path, monkeypatch):
    options = {"task": "Bead", "episodes": 1, "out": tmp_path}
    monkeypatch.setattr(module, "is_demonstrated", lambda guidance: False)
    baselines = ["uniform_random", "constant", "zero"]
    rows = robustness(["random_corner", "constant"], baselines=baselines, **options)["rows"]
    assert [row["policy"] for row in rows] == ["random_corner", "constant", "uniform_random", "zero"] * 2
    for names, baseline in ((["zero", "constant"], "constant"), ([run], "policy")):
        with pytest.raises(InputError, match=f"two policies are called '{baseline}': rename a policy"):
            robustness(names, baselines={baseline: zero_policy}, **options)


def test_episodes_of_another_function_are_not_used_again(run):
    results = [
        robustness([run], episodes=1, baselines={"own": lambda env, value=value: lambda _: np.full(2, value)})
        for value in (0.0, 1.0)
    ]
    first, second = (result["rows"][-1]["max_commanded_violation"] for result in results)
    assert first != second


def test_robustness_refuses_other_tasks_and_the_same_folder(run, tmp_path):
    with pytest.raises(InputError, match="the same name"):
        robustness([run, run], out=tmp_path)
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(config.replace("task: Bead", "task: NarrowPassage"))
    with pytest.raises(InputError, match="have one task, not Bead and NarrowPassage"):
        robustness([run, copy], out=tmp_path)


@pytest.mark.parametrize("options", [{"episodes": 0}, {"axes": "frictoin"}])
def test_robustness_refuses_invalid_arguments(run, options):
    with pytest.raises(InputError):
        robustness([run], **options)


@pytest.mark.parametrize("task", ["BncConnector", "GridClamp"])
def test_points_cover_every_value_or_name_a_reason(task):
    arguments = check_environment(task, {})
    result, left_out = points(task, arguments, AXES)
    values_left_out = sum(sentence.partition(" left out: ")[0].count(" ") for sentence in left_out)
    assert len(result) + values_left_out == sum(len(axis.values) for axis in AXES)
    for axis in AXES:
        environments = {point.value: point.environment for point in result if point.axis is axis}
        if axis.default in environments:
            assert environments[axis.default] == arguments
        assert all(environments[value] != arguments for value in environments if value != axis.default)
    names = {sentence.split()[0] for sentence in left_out}
    assert names.isdisjoint({point.axis.name for point in result} - {"clearance"})
    assert names <= {"payload", "joint_friction", "clearance", "offsets"}
    assert all(": " in sentence for sentence in left_out)


def test_axis_without_a_disturbed_point_is_left_out(tmp_path):
    result, left_out = points("NarrowPassage", {}, select_axes("late,lost"))
    assert result == []
    assert left_out[0].startswith(
        "late 0, 1, 2, 5, 10 left out: NarrowPassage has no option 'disturbances.late_commands'"
    )
    with pytest.raises(InputError, match="the environment has none of these axes"):
        robustness(["zero"], task="NarrowPassage", axes="late", out=tmp_path / "late")
    assert not (tmp_path / "late").exists()


def test_points_replace_a_range_by_each_value():
    arguments = check_environment(
        "BncConnector", {"disturbances.friction_factor": (0.5, 2.0), "disturbances.stiffness_factor": 1.7}
    )
    result, _ = points("BncConnector", arguments, select_axes("friction,stiffness,lost"))
    environments = {(point.axis.name, point.value): point.environment for point in result}
    assert environments["friction", 1.0]["disturbances.friction_factor"] == (1.0, 1.0)
    assert environments["stiffness", 1.0]["disturbances.stiffness_factor"] == 1.0
    assert environments["lost", 0.0] == arguments
    assert {point.axis.name: point.trained for point in result} == {"friction": None, "stiffness": None, "lost": 0.0}


@pytest.mark.parametrize(("fixture_offset", "is_resampled"), [("per_run", True), ("per_episode", False)])
def test_only_the_offset_axis_resamples_hidden_offsets(fixture_offset, is_resampled):
    result, _ = points("BncConnector", {"fixture_offset": fixture_offset}, AXES)
    for point in result:
        assert point.options == ({"new_run": True} if is_resampled and point.axis.name == "offsets" else {})


def test_all_policies_are_evaluated_at_the_same_offsets(bead_config, tmp_path, monkeypatch):
    # Episodes end at the first contact.
    short = {"action_repeat": 25, "bounded_force": False, "force_limit": 5.0, "time_step": 0.01}
    environment = check_environment("BncConnector", {"fixture_offset": "per_run", "guidance": "kgrl", **short})
    config = replace(bead_config, task="BncConnector", environment=environment)
    sampled = {"policy": [], "uniform_random": []}

    def recording_policy(name):
        def make_policy(env):
            def act(_):
                sampled[name].append(tuple(env.unwrapped.sampled["jack_offset"]))
                return np.zeros(env.action_space.shape)

            return act

        return make_policy

    def find(*_, **options):
        return Subject("policy", config, recording_policy("policy"))

    (axis,) = select_axes("offsets")
    monkeypatch.setattr(module, "find_subject", find)
    monkeypatch.setattr(module, "is_demonstrated", lambda guidance: False)
    monkeypatch.setattr(module, "AXES", (replace(axis, values=(2.0,)),))
    baselines = {"uniform_random": recording_policy("uniform_random")}
    robustness([tmp_path], episodes=2, baselines=baselines, out=tmp_path, processes=1)
    # The first offset belongs to the compatibility check, which acts in the run's own environment.
    offsets = {name: set(values) - {values[0]} for name, values in sampled.items()}
    assert len(offsets["policy"]) == 2
    assert offsets["policy"] == offsets["uniform_random"]
    assert all(2.0 * MM <= np.hypot(*offset) <= 3.0 * MM for offset in offsets["policy"])
    (point,), _ = points("BncConnector", environment, module.AXES)
    of_fixed_offset = episodes_file(
        tmp_path / "episodes", "policy", config, point.environment, episodes=2, seed=HELD_OUT_SEED
    )
    (stored,) = (tmp_path / "episodes").glob("policy-*.csv")
    assert stored != of_fixed_offset


@pytest.mark.parametrize(("fixture_offset", "trained_offset"), [("per_episode", 1.5e-3), ("none", 0.3e-3)])
def test_offset_axis_ends_at_twice_the_trained_offset(fixture_offset, trained_offset):
    (offsets,) = select_axes("offsets")
    result, _ = points("BncConnector", {"fixture_offset": fixture_offset}, [offsets])
    assert result[-1].environment["offset_range"] == (0.0, 2.0 * trained_offset)
    assert result[-1].environment["fixture_offset"] == "per_episode"
