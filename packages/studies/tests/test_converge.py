"""Convergence of success over plant steps and engines."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail_studies import contact_probe
from guiderail_studies import converge as converge_module
from guiderail_studies.converge import coarsest_step, conditions, converge, parse_steps

HARD = {"guidance": "kgrl", "difficulty": "hard", "action_repeat": 5}


def row(step, rate):
    return {"step_ms": step, "success_rate": rate}


@pytest.mark.parametrize(
    ("rates", "coarsest"),
    [
        ({10: 1.0, 5: 0.95, 2.5: 0.95}, 10.0),
        ({10: 0.8, 5: 0.95, 2.5: 0.95}, 5.0),
        ({10: 0.95, 5: 0.5, 2.5: 0.95}, 2.5),  # a coarse step that agrees by chance does not count
    ],
)
def test_coarsest_step_agrees_with_all_shorter_ones(rates, coarsest):
    rows = [row(None, 0.1), *(row(step, rate) for step, rate in rates.items())]
    assert coarsest_step(rows) == coarsest


def test_there_is_no_coarsest_step_without_steps():
    assert coarsest_step([row(None, 1.0)]) is None


def test_steps_are_sorted():
    assert parse_steps("2.5, 10,5") == (10.0, 5.0, 2.5)


@pytest.mark.parametrize("text", ["", "10,x", "0", "-1", "5,5", "nan", "inf"])
def test_parse_steps_raises_for_wrong_steps(text):
    with pytest.raises(InputError, match="different positive numbers"):
        parse_steps(text)


def test_conditions_change_the_step_alone():
    found = conditions("BncConnector", HARD, (10.0, 2.5), "drake")
    assert [condition.environment for condition in found] == [{**HARD, "time_step": step} for step in (0.01, 0.0025)]


def test_conditions_of_mujoco_leave_out_the_robot():
    pytest.importorskip("mujoco")
    found = conditions("BncConnector", {**HARD, "station": "arm", "robot": "iiwa14"}, (10.0,), "mujoco")
    assert [condition.environment for condition in found] == [{**HARD, "station": "mujoco"}]


def test_conditions_raise_for_an_unknown_engine_or_a_task_without_step():
    with pytest.raises(InputError, match="--engines are"):
        conditions("BncConnector", HARD, (10.0,), "drake,bullet")
    with pytest.raises(InputError, match="no time_step"):
        conditions("NarrowPassage", {}, (10.0,), "drake")


def test_conditions_raise_for_a_step_that_does_not_divide_the_control_period():
    with pytest.raises(InputError):
        conditions("BncConnector", HARD, (3.0,), "drake")


def test_converge_evaluates_each_step_once(tmp_path, capsys, monkeypatch):
    # Episodes end at the first contact.
    environment = {"station": "gantry", "bounded_force": False, "force_limit": 5.0}
    options = {"steps": (10.0, 5.0), "episodes": 1, "out": tmp_path, "environment": environment}
    monkeypatch.setattr(contact_probe, "capture_offset", lambda *_, **options: 0.0)  # takes most of the time
    first = converge("pretrained:connector", processes=1, **options)
    assert [row["step_ms"] for row in first["rows"]] == [10.0, 5.0]
    assert all(row["success_low"] <= row["success_rate"] <= row["success_high"] for row in first["rows"])
    errors = [abs(row["drag_20"] / 0.2 - 1.0) for row in first["rows"]]
    assert max(errors) < 0.15
    assert first["rows"][-1]["agree_with_finest"] == 1
    capsys.readouterr()
    monkeypatch.setattr(converge_module, "_measure_contact", lambda *_: {})  # is measured in each call
    again = converge("pretrained:connector", processes=1, **options)
    assert [row["successes"] for row in again["rows"]] == [row["successes"] for row in first["rows"]]
    assert "1/1" not in capsys.readouterr().err.replace("policy 1/1", "")


def test_policy_without_a_run_acts_in_the_task(tmp_path, monkeypatch):
    monkeypatch.setattr(converge_module, "_measure_contact", lambda *_: {})
    environment = {"difficulty": "hard", "guidance": "kgrl", "bounded_force": False, "force_limit": 5.0}
    options = {"steps": (5.0,), "episodes": 1, "out": tmp_path, "environment": environment, "processes": 1}
    assert converge("scripted", task="BncConnector", **options)["rows"][0]["episodes"] == 1
    with pytest.raises(InputError, match="give --out"):
        converge("scripted", task="BncConnector")


def test_converge_needs_a_folder_for_a_pretrained_policy():
    with pytest.raises(InputError, match="give --out"):
        converge("pretrained:connector")
