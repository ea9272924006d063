"""A policy on a robot, both sides of the bus in one process: neither waits for the wall's clock."""

import json
from contextlib import contextmanager
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
from drake import lcmt_iiwa_command
from injections.together import Together
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_skill
from guiderail.diagrams.hardware.station import HardwareStation
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault, StatusLimits
from guiderail.systems.policy_system import PolicyError
from guiderail.tools.cli.main import main
from guiderail.tools.hardware import executor as run_policy
from guiderail.tools.hardware import preflight as checks
from guiderail.tools.hardware.connection import RobotConnection
from guiderail.tools.hardware.executor import SkillExecutor
from guiderail.tools.hardware.sim_driver import START
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import configure

OPTIONS = {"station": "hardware", "guidance": "kmp", "fixture_offset": "none"}


@pytest.fixture
def operated(monkeypatch):
    """From where the robot starts, and a policy, to an operation and its robot."""

    def operated(
        start=START, policy=lambda observation: np.zeros(2), num_steps=20, is_stopped=lambda: False, deputy=True
    ):
        lcm = DrakeLcm("memq://")
        with monkeypatch.context() as patch:
            # The skill's station makes its own bus from a URL, and a bus in memory is known to its maker alone.
            patch.setattr("guiderail.diagrams.hardware.station.open_bus", lambda url: lcm)
            skill = make_skill("BncConnector", policy, **OPTIONS)
        task = EnvConfig.resolve("BncConnector", OPTIONS).make_task()
        monkeypatch.setattr(task, "num_steps", num_steps)
        pace = Together(task.workcell(), lcm, start, deputy)
        skill = type(skill)(skill.diagram, skill.control_period, num_steps, skill.randomize)
        return SkillExecutor(task, skill, pace, is_stopped), pace

    return operated


def test_approaches_executes_records_and_comes_to_rest(operated, tmp_path):
    operation, pace = operated(START + [0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert all(check.is_well for check in operation.checks())
    said = []
    outcome = operation.run(said.append)
    assert (outcome.words, outcome.steps, outcome.exit_code) == ("done", 20, 0)
    begin = operation._start
    np.testing.assert_allclose(operation.trace.measured[0][:3], begin[:3], atol=3e-3)
    assert (operation.trace.signals["arm_state"] == 2).all()
    context = pace.simulator.get_context()
    velocities = pace.robot.plant.GetVelocities(pace.robot.plant.GetMyContextFromRoot(context))
    assert np.abs(velocities).max() < 0.01
    path = operation.write(tmp_path, {"outcome": outcome.words})
    step_log = pd.read_parquet(path)
    assert len(step_log) == 20
    assert {"pose_0", "wrench_2", "fault", "torque_commanded_6", "position_measured_0"} <= set(step_log)
    assert json.loads(path.with_suffix(".json").read_text())["outcome"] == "done"


def test_a_run_that_fails_leaves_what_was_recorded_beside_what_was_there(monkeypatch, tmp_path):
    lcm, asked, imported = DrakeLcm("memq://"), [], []
    task = EnvConfig.resolve("BncConnector", {}).make_task()
    pace = Together(task.workcell(), lcm, task.start_pose(np.random.default_rng(0)))

    def policy(observation):
        asked.append(observation)
        return np.full(2, 0.0 if len(asked) <= 2 else np.nan)

    @contextmanager
    def standing_in(other, task, url, imports):
        imported.extend(imports)
        yield

    monkeypatch.setattr("guiderail.diagrams.hardware.station.open_bus", lambda url: lcm)
    monkeypatch.setattr(run_policy.Policy, "load", lambda folder: policy)
    monkeypatch.setattr(run_policy, "set_realtime_priority", lambda: True)
    monkeypatch.setattr(RobotConnection, "standing_in", standing_in)
    monkeypatch.setattr(RobotConnection, "paces", lambda other, station: (pace, None))
    monkeypatch.setattr("guiderail.tools.hardware.slow_motion.SETTLE", 0.1)
    monkeypatch.setattr(RobotConnection, "timing", lambda other, station, clock: {})
    options = {"guidance": "kmp", "fixture_offset": "none"}
    RunFolder(tmp_path).write_config(configure("BncConnector", options, imports=["json"], episodes=1))
    there = tmp_path / "hardware" / "episode-000004.json"  # of five recordings, somebody took four away
    there.parent.mkdir()
    there.write_text("{}")
    with pytest.raises(PolicyError):
        run_policy.run_policy(tmp_path, RobotConnection(), yes=True, say=lambda words: None)
    assert imported == ["json"]
    assert there.read_text() == "{}"
    found = json.loads((tmp_path / "hardware" / "episode-000005.json").read_text())
    step_log = pd.read_parquet(tmp_path / "hardware" / "episode-000005.parquet")
    assert found["outcome"].startswith("failed: PolicyError")
    assert found["steps"] == len(step_log) > 0


@pytest.mark.parametrize("sound", [0, 2])  # of its actions: it is asked once before anything moves
def test_a_policy_that_returns_no_action_leaves_the_arm_at_rest(operated, sound):
    asked = []

    def policy(observation):
        asked.append(observation)
        return np.full(2, 0.0 if len(asked) <= sound else np.nan)

    operation, pace = operated(policy=policy)
    commands = []
    operation._station.lcm.Subscribe(
        "IIWA_COMMAND", lambda message: commands.append(lcmt_iiwa_command.decode(message).joint_torque)
    )
    with pytest.raises(PolicyError):
        operation.run(print)
    assert commands[-1:] == ([(0.0,) * 7] if sound else [])
    velocities = pace.robot.plant.GetVelocities(pace.robot.plant.GetMyContextFromRoot(pace.simulator.get_context()))
    assert np.abs(velocities).max() < 0.01


def test_a_status_that_stops_ends_it(operated):
    operation, pace = operated()
    pace.happens[300] = lambda: setattr(pace, "is_silent", True)
    outcome = operation.run(print)
    assert (outcome.fault, outcome.exit_code) == (Fault.STALE, 1)


def test_a_person_stops_it(operated):
    pressed = []
    operation, pace = operated(is_stopped=lambda: bool(pressed))
    pace.happens[200] = lambda: pressed.append(1)
    outcome = operation.run(print)
    assert (outcome.fault, outcome.exit_code, outcome.steps) == (Fault.USER_STOP, 1, 0)


def test_too_much_force_ends_it(operated):
    """The least force is too much here: the impedance's own, on its way to the start."""
    operation, _ = operated()
    operation._task.collision = type(operation._task.collision)("contact_force", 0.01)
    outcome = operation.run(print)
    assert (outcome.fault, outcome.exit_code) == (Fault.FORCE_LIMIT, 1)
    assert "more than the task's" in outcome.words


def test_a_robot_far_from_the_start_is_not_moved(operated):
    operation, _ = operated(START + [0.0, 0.0, 0.16, 0.0, 0.0, 0.0])
    (wrong,) = [check for check in operation.checks() if not check.is_well]
    assert wrong.name == "start"


def test_no_task_without_a_start_and_no_simulated_station(monkeypatch):
    with pytest.raises(InputError, match="is a simulation"):
        run_policy.on_a_robot("BncConnector", {}, "gantry")
    environment = EnvConfig.resolve("BncConnector", {"station": "arm", "robot": "panda"}).options
    assert "end_effector" not in run_policy.on_a_robot("BncConnector", environment, "hardware")


def test_what_a_person_gave_wrong_ends_with_2(capsys, tmp_path):
    with pytest.raises(SystemExit) as end:
        main(["run", str(tmp_path), "--sim"])
    assert end.value.code == 2
    assert "not a run" in capsys.readouterr().err


def test_another_policy_acts_in_episodes_alone(capsys):
    with pytest.raises(SystemExit) as end:
        main(["run", "runs/none", "--policy", "scripted"])
    assert end.value.code == 2
    assert "give --episodes" in capsys.readouterr().err


def test_nobody_confirms_for_a_person(monkeypatch):
    with pytest.raises(InputError, match="--yes"):
        checks.confirm("So?")
    monkeypatch.setattr("sys.stdin", type("Terminal", (), {"isatty": lambda self: True})())
    monkeypatch.setattr("builtins.input", lambda words: "no")
    with pytest.raises(InputError, match="nothing moves"):
        checks.confirm("So?")
    monkeypatch.setattr("builtins.input", Mock(side_effect=EOFError))
    with pytest.raises(InputError, match="nothing moves"):
        checks.confirm("So?")
    monkeypatch.setattr("builtins.input", lambda words: "yes")
    checks.confirm("So?")


def test_a_check_that_fails_is_never_confirmed():
    said = []
    with pytest.raises(InputError, match="stays where it is: load"):
        checks.confirm_checks([checks.Check("load", "9 N", False)], said.append, again=list, is_confirmed=True)
    assert said == ["NOT  load        9 N"]


def test_what_is_confirmed_is_checked_again_before_the_arm_moves(operated, monkeypatch):
    operation, pace = operated()
    aside = START + [0.16, 0.0, 0.05, 0.0, 0.0, 0.0]
    monkeypatch.setattr(
        checks, "confirm", lambda question: pace.robot.set_pose(pace.simulator.get_mutable_context(), aside)
    )
    with pytest.raises(InputError, match="stays where it is: start"):
        checks.confirm_checks(operation.checks(), print, again=operation.checks_again, is_confirmed=False)


def test_the_force_that_is_read_out_is_the_largest_that_there_is(operated):
    operation, _ = operated()
    words = {check.name: check.words for check in operation.checks()}["force"]
    limits = operation._station.impedance.limits[:3]
    assert f"{max(limits):.0f} N commanded along an axis, {np.linalg.norm(limits):.0f} N askew" in words


def test_a_place_where_nothing_can_be_recorded_is_refused_before_anything_is_heard(monkeypatch, tmp_path):
    def subscribe(url):
        raise AssertionError("the bus was opened")

    monkeypatch.setattr("guiderail.diagrams.hardware.station.open_bus", subscribe)
    monkeypatch.setattr(run_policy.Policy, "load", lambda folder: lambda observation: np.zeros(2))
    RunFolder(tmp_path / "run").write_config(configure("BncConnector", {"guidance": "kmp"}, episodes=1))
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        run_policy.run_policy(tmp_path / "run", RobotConnection(), yes=True, out=tmp_path / "file" / "out")


def test_an_arm_whose_driver_does_not_stop_it_needs_a_deputy(operated):
    operation, _ = operated(deputy=False)
    (wrong,) = [check for check in operation.checks() if not check.is_well]
    assert wrong.name == "deputy"


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"lockstep": True}, "waits for nobody"),
        ({"rehearse": True, "robot": "panda"}, "only the"),
        ({"rate": 0.0}, "rate"),
    ],
)
def test_refuses_another_end_that_makes_no_sense(wrong, words):
    with pytest.raises(InputError, match=words):
        RobotConnection(**wrong)


def test_the_stations_of_an_operation_have_the_same_limits():
    slow = StatusLimits((1.0,) * 7, max_age=0.1)
    other = {"period": 0.002, "wrench_time_constant": 0.05, "lcm_url": "memq://x", "status_limits": slow}
    station = HardwareStation(
        EnvConfig.resolve("BncConnector", {}).make_task().workcell(), DrakeLcm("memq://"), robot="panda", **other
    )
    alike = station.alike(EnvConfig.resolve("BncConnector", {}).make_task().workcell())
    assert (alike.limits, alike.impedance, alike.driver) == (station.limits, station.impedance, station.driver)
    assert alike.lcm is station.lcm
    assert (alike.period, alike.lcm_url, alike.status_limits) == (0.002, "memq://x", slow)
    assert len({one.GetSubsystemByName("wrench")._decay for one in (station, alike)}) == 1
