"""Passport of a policy over engines, steps and changes."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail_studies import passport as passport_module
from guiderail_studies.converge import conditions
from guiderail_studies.passport import installed_engines, passport, passport_conditions, predict_left_out

HARD = {"guidance": "kgrl", "difficulty": "hard", "action_repeat": 5, "station": "gantry"}


def row(engine, rate, low, high):
    return {"engine": engine, "success_rate": rate, "success_low": low, "success_high": high}


def test_left_out_engine_is_predicted_by_the_mean_of_all_other_conditions():
    rows = [row("drake", 1.0, 0.8, 1.0), row("drake", 0.6, 0.4, 0.8), row("mujoco", 0.7, 0.5, 0.9)]
    rows.append(row("mujoco", 0.1, 0.0, 0.3))  # a change, which is not the measured condition
    drake, mujoco = predict_left_out(rows)
    assert (drake["left_out"], drake["measured"]) == ("Drake", 1.0)
    assert drake["predicted"] == pytest.approx(0.4)
    assert (drake["low"], drake["high"]) == (0.0, 0.9)
    assert mujoco["predicted"] == pytest.approx(0.8)
    assert mujoco["error"] == pytest.approx(0.1)
    assert (mujoco["low"], mujoco["high"]) == (0.4, 1.0)


def test_single_engine_has_no_prediction():
    assert predict_left_out([row("drake", 1.0, 0.8, 1.0)]) == []


def test_conditions_are_steps_and_changes_of_each_engine():
    pytest.importorskip("mujoco")
    found = passport_conditions("BncConnector", HARD, "drake,mujoco", lambda sentence: None)
    names = [condition.name for condition in found]
    assert names[:5] == ["Drake, 5 ms", "Drake, 2.5 ms", "Drake, 1.25 ms", "MuJoCo, 1 ms", "MuJoCo, 0.5 ms"]
    assert names[8:] == [f"MuJoCo, 1 ms, {change}" for change in ("friction × 0.5", "friction × 2", "clearance × 0.5")]
    assert found[1].environment == conditions("BncConnector", HARD, (2.5,), "drake")[0].environment
    assert found[4].environment == {**HARD, "station": "mujoco", "engine_step": 0.0005}
    assert found[9].environment["disturbances.friction_factor"] == (2.0, 2.0)
    assert found[7].environment["bore_clearance"] == pytest.approx(0.05e-3)


@pytest.mark.parametrize("engines", ["drake,bullet", "", "drake,drake"])
def test_conditions_raise_for_wrong_engines(engines):
    with pytest.raises(InputError, match="--engines are drake, mujoco, pybullet, sapien"):
        passport_conditions("BncConnector", HARD, engines, lambda sentence: None)


def test_engine_that_is_not_installed_is_left_out_or_named(monkeypatch):
    monkeypatch.setattr(passport_module, "find_spec", lambda name: None)
    assert installed_engines() == "drake"
    monkeypatch.setattr("guiderail.models.common.errors.find_spec", lambda name: None)
    for call in (
        lambda: passport_conditions("BncConnector", HARD, "pybullet", lambda sentence: None),
        lambda: conditions("BncConnector", HARD, (5.0,), "pybullet"),
    ):
        with pytest.raises(InputError, match=r'pip install "guiderail\[pybullet\]"'):
            call()


def test_task_without_contact_is_refused():
    with pytest.raises(InputError, match="no contact that other engines simulate"):
        passport_conditions("NarrowPassage", {}, "drake", lambda sentence: None)


def test_passport_evaluates_each_condition_once(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(passport_module, "DIVISIONS", {"drake": (1,)})
    monkeypatch.setattr(passport_module, "CHANGES", {})
    # Episodes end at the first contact.
    environment = {"station": "gantry", "bounded_force": False, "force_limit": 5.0}
    options = {"engines": "drake", "episodes": 1, "out": tmp_path, "environment": environment, "processes": 1}
    first = passport("pretrained:connector", **options)
    (row,) = first["rows"]
    assert row["condition"] == first["weakest"] == "Drake, 5 ms"
    assert row["success_low"] <= row["success_rate"] <= row["success_high"]
    assert row["peak_force"] > 0.0
    assert row["peak_contact_force"] > 0.0
    assert (tmp_path / "table.csv").is_file()
    assert (tmp_path / "table.md").is_file()
    capsys.readouterr()
    assert passport("pretrained:connector", **options)["rows"] == first["rows"]
    assert "success" not in capsys.readouterr().err  # nothing was simulated again
