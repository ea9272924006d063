"""Execution of a skill on a simulated robot in the same process, independent of the wall clock."""

import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from drake import lcmt_iiwa_command
from hardware_doubles import failed_checks, max_joint_speed
from injections.stepped_robot import SteppedRobotClock
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.stations.station import max_wrench
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.systems.policy_system import PolicyError
from guiderail.tools.cli.main import main
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.pretrained import find_run
from guiderail_hardware.models.joint_status import Fault, StatusLimits
from guiderail_hardware.robot import executor as executing
from guiderail_hardware.robot import preflight
from guiderail_hardware.robot.connection import DriverEndedError, RobotConnection
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation


def test_executor_approaches_executes_rests_and_records(make_executor, tmp_path):
    executor, clock = make_executor(START + [0.002, 0.0, 0.0, 0.0, 0.0, 0.0], has_monitor=True)
    checks = executor.preflight.run()
    assert failed_checks(checks) == []
    assert checks[0].description.startswith("iiwa14, 7 joints")
    messages = []
    outcome = executor.run(messages.append)
    assert (outcome.description, outcome.steps, outcome.exit_code) == ("executed to its end", 10, 0)
    np.testing.assert_allclose(executor.trace.measured[0][:3], executor._start[:3], atol=3e-3)
    assert (executor.trace.signals["arm_state"] == 2).all()
    assert max_joint_speed(clock) < 0.01
    metadata = {"outcome": outcome.description, "statuses": {"99 %": np.nan, "longest": np.inf}}
    path = executor.write(tmp_path, metadata)[0]
    step_log = pd.read_parquet(path)
    assert len(step_log) == 10
    assert {"pose_0", "wrench_2", "fault", "torque_commanded_6", "position_measured_0"} <= set(step_log)
    written = json.loads(path.with_suffix(".json").read_text(), parse_constant=pytest.fail)
    assert written == {"outcome": "executed to its end", "statuses": {"99 %": None, "longest": None}}


def test_deploy_writes_a_new_recording_when_the_policy_fails(monkeypatch, tmp_path):
    lcm, requests, imported_modules, messages = DrakeLcm("memq://"), [], [], []
    task = EnvConfig.resolve("BncConnector", {}).declared
    clock = SteppedRobotClock(task.workcell(), lcm, task.start_pose(np.random.default_rng(0)))

    def policy(observation):
        requests.append(observation)
        return np.full(2, 0.0 if len(requests) <= 2 else np.nan)

    @contextmanager
    def simulated_driver(connection, task, url, imports):
        imported_modules.extend(imports)
        yield

    monkeypatch.setattr("guiderail_hardware.drivers.lcm.open_bus", lambda url: lcm)
    monkeypatch.setattr(executing.Policy, "load", lambda folder: policy)
    monkeypatch.setattr(executing, "set_realtime_priority", lambda: True)
    monkeypatch.setattr(RobotConnection, "simulated_driver", simulated_driver)
    monkeypatch.setattr(RobotConnection, "clocks", lambda connection, station: (clock, None))
    monkeypatch.setattr(RobotConnection, "timing", lambda connection, station, clock: {})
    options = {"guidance": "kmp", "fixture_offset": "none"}
    RunFolder(tmp_path).write_config(configure("BncConnector", options, imports=["json"], episodes=1))
    existing = tmp_path / "hardware" / "episode-000004.json"  # the remaining file of five recordings
    existing.parent.mkdir()
    existing.write_text("{}")
    with pytest.raises(PolicyError):
        executing.deploy(tmp_path, RobotConnection(), assume_yes=True, force_limit=12.0, log=messages.append)
    (force,) = [message for message in messages if message.startswith("read  force")]
    assert float(force.partition(", ")[2].split(" N")[0]) <= 12.0
    with pytest.raises(InputError, match="force limit of 35 N: give a lower one"):
        executing.deploy(tmp_path, RobotConnection(), assume_yes=True, force_limit=36.0)
    assert imported_modules == ["json"]
    assert existing.read_text() == "{}"
    metadata = json.loads((tmp_path / "hardware" / "episode-000005.json").read_text())
    step_log = pd.read_parquet(tmp_path / "hardware" / "episode-000005.parquet")
    assert metadata["outcome"].startswith("failed: PolicyError")
    assert metadata["steps"] == len(step_log) > 0


def test_recording_is_in_a_temporary_folder_when_out_is_full(make_executor, monkeypatch, tmp_path):
    executor, _ = make_executor()
    executor.run(print)
    write, messages = executing.write_step_log, []

    def write_outside(path, rows):
        if path.is_relative_to(tmp_path / "full"):
            raise InputError("no room")
        write(path, rows)

    monkeypatch.setattr(executing, "write_step_log", write_outside)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    executor.save(tmp_path / "full", executing.Outcome(Fault.NONE, executing.COMPLETED, 10), {}, messages.append)
    (file,) = tmp_path.glob("guiderail-*/episode-000000.parquet")
    assert len(pd.read_parquet(file)) == 10
    assert file.with_suffix(".json").exists()
    assert messages[-1].startswith("the motion was executed, but ")
    assert messages[-1].endswith(f"cannot be written, so the record is in {file}")


def record_torques(executor):
    """Return a list to which the torques of every command are added."""
    torques = []
    executor._station.driver.lcm.Subscribe(
        "IIWA_COMMAND", lambda message: torques.append(lcmt_iiwa_command.decode(message).joint_torque)
    )
    return torques


@pytest.mark.parametrize("num_valid", [0, 2])  # number of valid actions; the first call is the warm-up
def test_arm_rests_when_the_policy_returns_nan(make_executor, num_valid):
    requests = []

    def policy(observation):
        requests.append(observation)
        return np.full(2, 0.0 if len(requests) <= num_valid else np.nan)

    executor, clock = make_executor(policy=policy, num_steps=20)
    torques = record_torques(executor)
    with pytest.raises(PolicyError):
        executor.run(print)
    assert torques[-1:] == ([(0.0,) * 7] if num_valid else [])
    assert max_joint_speed(clock) < 0.01


def test_arm_rests_when_a_step_of_the_approach_raises(make_executor):
    def interrupt(context):
        raise KeyboardInterrupt

    executor, clock = make_executor()
    clock.happens[95] = lambda: executor._simulator.set_monitor(interrupt)
    torques = record_torques(executor)
    with pytest.raises(KeyboardInterrupt):
        executor.run(print)
    assert len(executor.trace) == 0
    assert torques[-1] == (0.0,) * 7
    assert max_joint_speed(clock) < 0.01


def test_arm_rests_when_one_status_at_the_take_over_is_wrong(make_executor, monkeypatch):
    executor, clock = make_executor()
    positions, receive, error = [], clock.receive, np.array([0.15, 0, 0, 0, 0, 0, 0])  # error of the status [rad]

    def start_simulator(station, *arguments):
        with monkeypatch.context() as patch:
            status = station.driver.read()
            patch.setattr(station.driver, "read", lambda: replace(status, positions=status.positions + error))
            return preflight.start_simulator(station, *arguments)

    def record_and_receive():
        plant = clock.robot.plant
        positions.append(plant.GetPositions(plant.GetMyContextFromRoot(clock.simulator.get_context())))
        receive()

    monkeypatch.setattr(executing, "start_simulator", start_simulator)
    monkeypatch.setattr(clock, "receive", record_and_receive)
    assert executor.run(print).exit_code == 0
    assert np.abs(np.array(positions)[:, 0] - positions[0][0]).max() < 0.1 * error[0]


def test_approach_has_the_force_limit_of_the_skill(make_executor):
    executor, clock = make_executor(force_limit_range=(8.0, 25.0))
    executor.preflight.repeat()

    def read(simulator):
        return executor._station.read_max_wrench(simulator.get_context())

    bounds = [read(executor.preflight.simulator)]
    clock.happens = {
        clock.step + 50: lambda: bounds.append(read(executor._simulator)),
        clock.step + 100: lambda: setattr(clock, "is_silent", True),
    }
    assert executor.run(print).fault == Fault.STALE
    np.testing.assert_array_equal(bounds, [max_wrench(8.0)] * 2)


def test_execution_ends_when_statuses_stop(make_executor):
    executor, clock = make_executor()
    clock.happens[130] = lambda: setattr(clock, "is_silent", True)
    outcome = executor.run(print)
    assert (outcome.fault, outcome.exit_code) == (Fault.STALE, 1)


def test_executor_does_not_wait_when_the_simulation_has_ended(make_executor):
    def end():
        clock.is_silent = True
        clock.happens = dict.fromkeys(range(clock.step, clock.step + 1000), end)
        raise DriverEndedError("the simulated driver has ended")

    executor, clock = make_executor()
    clock.happens[95] = end
    with pytest.raises(DriverEndedError):
        executor.run(print)
    assert clock.step < 105


def test_checks_name_the_statuses_when_the_driver_is_silent(make_executor):
    executor, clock = make_executor()
    clock.is_silent = True
    with pytest.raises(InputError, match="statuses stopped arriving on LCM"):
        executor.preflight.repeat()


def test_execution_ends_when_the_operator_stops(make_executor):
    stops = []
    executor, clock = make_executor(is_stop_requested=lambda: bool(stops))
    clock.happens[95] = lambda: stops.append(True)
    outcome = executor.run(print)
    assert (outcome.fault, outcome.exit_code, outcome.steps) == (Fault.USER_STOP, 1, 0)


def test_outcome_counts_the_step_in_which_the_operator_stops(make_executor, tmp_path):
    """Recording, metadata and message have the same number of control steps."""
    messages, executor, num_steps = [], None, 1

    def is_stop_requested():
        # While a step is executed, the trace does not contain this step.
        is_skill = executor is not None and executor._simulator.get_system() is executor._diagram
        return is_skill and len(executor.trace) >= num_steps - 1

    executor, _ = make_executor(is_stop_requested=is_stop_requested)
    outcome = executor.run(messages.append)
    assert (outcome.fault, outcome.steps, len(executor.trace)) == (Fault.USER_STOP, num_steps, num_steps)
    executor.save(tmp_path, outcome, {}, messages.append)
    metadata = json.loads((tmp_path / "episode-000000.json").read_text())
    assert metadata["steps"] == len(pd.read_parquet(tmp_path / "episode-000000.parquet")) == num_steps
    assert metadata["peak_force"] == executor.trace.force.max()
    assert f"after {num_steps} control steps" in messages[-1]


def test_execution_ends_above_the_force_limit_of_the_task(make_executor):
    """The limit of 0.01 N is below the force of the impedance during the approach."""
    executor, _ = make_executor()
    executor._task = executor._task.model_copy(update={"force_limit": 0.01})
    outcome = executor.run(print)
    assert (outcome.fault, outcome.exit_code) == (Fault.FORCE_LIMIT, 1)
    assert "more than the task's" in outcome.description


def test_start_check_fails_when_the_arm_is_far_away(make_executor):
    executor, _ = make_executor(START + [0.0, 0.0, 0.16, 0.0, 0.0, 0.0], has_monitor=True)
    assert failed_checks(executor.preflight.run()) == ["start"]


def test_hardware_environment_drops_options_of_a_simulation():
    with pytest.raises(InputError, match="is a simulation"):
        executing.hardware_environment("BncConnector", {}, "gantry")
    environment = EnvConfig.resolve("BncConnector", {"station": "arm", "robot": "panda", "reward": "aligned"}).options
    on_hardware = executing.hardware_environment("BncConnector", environment, "hardware")
    assert "end_effector" not in on_hardware
    assert on_hardware["reward"] == "sparse"  # the reward was privileged
    # The tare remains.
    options = {"station": "arm", "sensing": "wrist", "sensing.wrench_bias": [1.0, 0.1], "sensing.tare": True}
    options |= {"disturbances.friction_factor": [0.5, 2.0], "disturbances.payload": 0.1, "reward": "shaped"}
    environment = executing.hardware_environment("BncConnector", options, "hardware")
    del environment["station"]
    assert environment == {"sensing": "wrist", "sensing.tare": True, "reward": "shaped"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([str(Path(__file__).parent), "--sim"], "not a run"),
        (
            ["pretrained:connector", "--robot=ur5e", "--driver=iiwa14", "--robot-url=memq://", "--yes"],
            "robot='ur5e' has 6",
        ),
        (["runs/none", "--policy", "scripted"], "--policy"),
    ],
)
def test_deploy_exits_with_2_when_arguments_are_wrong(arguments, message, capsys):
    with pytest.raises(SystemExit) as end:
        main(["deploy", *arguments])
    assert end.value.code == 2
    assert message in capsys.readouterr().err


def test_policy_without_a_run_acts_in_a_named_task(tmp_path):
    policy = Policy.load(find_run("pretrained:connector"))
    policy.description["environment"] = {"guidance": "kgrl"}
    policy.save(tmp_path)
    with pytest.raises(InputError, match="name the task"):
        executing.configuration(tmp_path, None)
    config = executing.configuration(tmp_path, "BncConnector")
    assert (config.task, config.environment["guidance"]) == ("BncConnector", "kgrl")


def test_confirm_checks_raises_when_a_check_fails():
    messages = []
    checks = SimpleNamespace(run=lambda: [preflight.Check("load", "9 N", False)], error="")
    with pytest.raises(InputError, match="stays where it is: load"):
        preflight.confirm_checks(checks, messages.append, assume_yes=True)
    assert messages == ["NOT   load        9 N"]


def test_force_check_shows_the_largest_commanded_force(make_executor):
    executor, _ = make_executor()
    (force,) = [check.description for check in executor.preflight.run() if check.name == "force"]
    limits = executor._station.impedance.limits[:3]
    assert f"{max(limits):.0f} N commanded along an axis, {np.linalg.norm(limits):.0f} N in all three" in force


def test_deploy_raises_before_the_bus_opens_when_out_is_full(monkeypatch, tmp_path):
    def open_bus(url):
        raise AssertionError("the bus was opened")

    monkeypatch.setattr("guiderail_hardware.drivers.lcm.open_bus", open_bus)
    monkeypatch.setattr(executing.Policy, "load", lambda folder: lambda observation: np.zeros(2))
    RunFolder(tmp_path / "run").write_config(configure("BncConnector", {"guidance": "kmp"}, episodes=1))
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=9))
    with pytest.raises(InputError, match=r"has room for 9 bytes, .* with room$"):
        executing.deploy(tmp_path / "run", RobotConnection(), assume_yes=True, out=tmp_path / "out")
    with pytest.raises(InputError, match="cannot be written"):
        executing.deploy(tmp_path / "run", RobotConnection(), assume_yes=True, out=tmp_path / "file" / "out")


def test_monitor_check_fails_without_a_heartbeat(make_executor):
    executor, _ = make_executor()
    assert failed_checks(executor.preflight.run()) == ["monitor"]


def test_clone_has_the_same_parameters_and_driver():
    limits = StatusLimits((1.0,) * 7, max_age=0.1)
    options = {"period": 0.002, "wrench_time_constant": 0.05, "robot_url": "memq://x", "status_limits": limits}
    station = HardwareStation(EnvConfig.resolve("BncConnector", {}).declared.workcell(), robot="panda", **options)
    clone = station.clone(EnvConfig.resolve("BncConnector", {}).declared.workcell())
    assert (clone.limits, clone.impedance, clone.driver) == (station.limits, station.impedance, station.driver)
    assert clone.driver is station.driver
    assert (clone.period, clone.driver.url, clone.status_limits) == (0.002, "memq://x", station.status_limits)
    longest = station.status_limits.max_round_trip  # from the impedance
    assert 0.0 < longest < np.inf
    assert station.status_limits == replace(limits, max_round_trip=longest)
    assert clone.GetSubsystemByName("wrench")._decay == station.GetSubsystemByName("wrench")._decay
