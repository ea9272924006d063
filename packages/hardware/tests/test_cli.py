"""Commands of robots: refused arguments, and what reaches the functions behind them."""

import pytest

from guiderail.diagrams.stations.registry import STATIONS
from oracles.commands import call

STATION = """
from guiderail.diagrams.stations.registry import register_station


@register_station("desk", workcell_kind="insertion", is_simulated=False)
def desk(workcell):
    raise NotImplementedError
"""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["train-on-robot", "BncConnector"], "name one with --out RUN"),
        (["train-on-robot", "BncConnector", "--out", "new", "--set", "num_envs=2"], "leave num_envs out"),
        (["deploy", "new", "--json"], "give --episodes too"),
        (["deploy", "new", "--policy", "zero"], "give --episodes too"),
        (["deploy", "new", "--episodes", "2", "--force-limit", "5"], "leave --force-limit out"),
    ],
)
def test_command_prints_one_sentence_when_input_is_wrong(arguments, message, capsys):
    code, out, err = call(capsys, *arguments)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err


@pytest.mark.parametrize("policy", ["none", "uniform_random,scripted", "unifrm_random"])
def test_deploy_refuses_unknown_policy_on_hardware(policy, capsys, bead_run):
    code, out, err = call(capsys, "deploy", bead_run, "--sim", "--episodes", 1, "--policy", policy)
    assert (code, out) == (2, "")
    assert f"Bead has no policy {policy!r}" in err
    assert err.count("\n") == 1
    assert not (bead_run / "hardware").exists()


@pytest.mark.parametrize(
    ("options", "robot"),
    [([], "iiwa14"), (["--robot", "panda"], "panda"), (["--env", "robot=panda"], "panda")],
)
def test_train_passes_robot_and_imports_to_hardware(options, robot, capsys, tmp_path, monkeypatch):
    passed = {}

    def train_on_robot(task, out, connection, **keywords):
        passed.update(keywords, connection=connection)
        return {"run": str(out)}

    monkeypatch.setattr("guiderail_hardware.robot.robot_training.train_on_robot", train_on_robot)
    monkeypatch.setattr(STATIONS, "_entries", {**STATIONS._entries})  # restored after the test
    file = tmp_path / "desk.py"
    file.write_text(STATION)
    hardware = ["--station", "desk", "--import", file, "--out", "new", "--robot-url", "memq://"]
    assert call(capsys, "train-on-robot", "BncConnector", *hardware, *options)[0] == 0
    assert (passed["connection"].robot, passed["connection"].robot_url) == (robot, "memq://")
    assert passed["given"]["imports"] == (str(file),)


def test_deploy_imports_the_station_before_its_use(capsys, tmp_path, monkeypatch, bead_run):
    passed = {}

    def evaluate_on_robot(run, connection, episodes, **keywords):
        passed.update(keywords)
        return {"episodes": episodes}

    monkeypatch.setattr("guiderail_hardware.robot.robot_evaluation.evaluate_on_robot", evaluate_on_robot)
    monkeypatch.setattr(STATIONS, "_entries", {**STATIONS._entries})  # restored after the test
    file = tmp_path / "other_desk.py"
    file.write_text(STATION)
    assert (
        call(
            capsys, "deploy", bead_run, "--station", "desk", "--import", file, "--robot-url", "memq://", "--episodes", 2
        )[0]
        == 0
    )
    assert passed["station"] == "desk"
