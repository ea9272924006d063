"""Episodes, evaluation and training on a simulated robot in the same process."""

from contextlib import contextmanager
from dataclasses import replace
from signal import SIGTERM, raise_signal
from types import SimpleNamespace

import gymnasium
import numpy as np
import pandas as pd
import pytest
from hardware_doubles import failed_checks, max_joint_speed, unplugged
from injections.stepped_robot import SteppedRobotClock
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.assemble import build_task_diagram
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.env import DiagramEnv
from guiderail.diagrams.envs.make import make_guidance, make_station
from guiderail.diagrams.stations.station import max_wrench
from guiderail.diagrams.tasks.insertion import HOLD_DISTANCE, MAX_HOLD_MOTION, HoldTest
from guiderail.diagrams.tasks.task import World
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.learning.learner import LEARNERS
from guiderail.tools.learning.off_policy import OffPolicyLearner
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail_hardware.drivers.lcm import IiwaDriver
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.robot import preflight
from guiderail_hardware.robot.connection import RobotConnection
from guiderail_hardware.robot.operator import OperatorKeys
from guiderail_hardware.robot.pipelined_learner import PipelinedLearner
from guiderail_hardware.robot.preflight import SPEED
from guiderail_hardware.robot.robot_env import RobotEnv
from guiderail_hardware.robot.robot_evaluation import evaluate_on_robot
from guiderail_hardware.robot.robot_training import _train, train_on_robot
from guiderail_hardware.robot.session import robot_session
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.systems.torque_safety_limiter import ArmState

OPTIONS = {"station": "hardware", "guidance": "kgrl", "fixture_offset": "none", "reward": "shaped", "action_repeat": 5}


def make_robot_env(patch, start, has_monitor=False, **options):
    """Return an environment whose robot is at a pose.

    Its additional attributes are `clock` and `keys`, `questions` (the reasons of all confirmations that it requested)
    and `begin` (the start pose of the episodes).
    """
    lcm, config = DrakeLcm("memq://"), EnvConfig.resolve("BncConnector", OPTIONS | options)
    with patch.context() as bus:
        bus.setattr("guiderail_hardware.drivers.lcm.open_bus", lambda url: lcm)
        station = make_station(config)
    task = replace(build_task_diagram(config, station, make_guidance(config, station)), num_steps=10)
    clock, keys, questions = SteppedRobotClock(config.declared.workcell(), lcm, start, has_monitor), OperatorKeys(), []
    begin = config.declared.start_pose(np.random.default_rng(0))
    env = RobotEnv(
        task,
        station,
        clock,
        action_repeat=5,
        keys=keys,
        confirm_resume=questions.append,
        free_workpiece=questions.append,
        log=lambda text: None,
    )
    env.clock, env.keys, env.questions, env.begin = clock, keys, questions, begin
    return env


@pytest.fixture(scope="module")
def shared():
    with pytest.MonkeyPatch.context() as patch:
        return make_robot_env(patch, START + [0.002, 0.0, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture
def env(shared):
    shared._retry_until_ok(lambda: None)  # an earlier test may have stopped the arm
    shared.questions.clear()
    shared.keys.clear_stop()
    return shared


def act_zero(observation):
    return np.zeros(2)


def test_reset_moves_to_the_start_and_an_episode_ends(env):
    for index in range(2):
        row = rollout(env, act_zero, index=index)
        assert (row["termination"], row["steps"], env.questions) == ("time_limit", 10, [])
        np.testing.assert_allclose(env.trace.measured[0][:3], env.begin[:3], atol=2e-3)
        assert (env.trace.signals["command_timed_out"] == 0.0).all()
        env.idle()
    with pytest.raises(InputError, match="takes no options"):
        env.reset(options={"offset": (0.0, 0.0)})


def test_reset_randomizes_parts_with_its_seed_and_options(env, monkeypatch):
    monkeypatch.setattr(env, "_randomize_parts", lambda rng, options: {"offset": (float(rng.random()), options)})
    _, info = env.reset(seed=3, options={"held_out": True})
    assert info["offset"] == (float(np.random.default_rng(3).random()), {"held_out": True})


def test_evaluate_writes_a_row_per_episode(env, monkeypatch, tmp_path):
    @contextmanager
    def fake_session(config, connection, *, assume_yes, log):
        assert (config.environment["station"], config.environment["guidance"]) == ("hardware", "kgrl")
        yield env, dict

    monkeypatch.setattr("guiderail_hardware.robot.robot_evaluation.robot_session", fake_session)
    trained_on = {"station": "arm", "robot": "panda", "guidance": "kgrl"}
    RunFolder(tmp_path).write_config(configure("BncConnector", trained_on, seed=0, episodes=1))
    env.keys.is_pause_requested = True
    result = evaluate_on_robot(tmp_path, RobotConnection(), 2, policy="zero")
    assert (result["episodes"], result["success_rate"]) == (2, 0.0)
    # The pause is confirmed once, after the first episode.
    assert (env.questions, env.keys.is_pause_requested) == (["stop requested by the user"], False)
    rows = pd.read_csv(tmp_path / "hardware" / "episodes-zero.csv")
    assert rows["termination"].tolist() == ["time_limit"] * 2
    with pytest.raises(InputError, match="already exists"):
        evaluate_on_robot(tmp_path, RobotConnection(), 2, policy="zero")
    with pytest.raises(InputError, match="at least 1"):
        evaluate_on_robot(tmp_path, RobotConnection(), 0)
    # An evaluation that has no row yet does not overwrite the file of a simultaneous evaluation.
    out = tmp_path / "out"
    with RunFolder(out).locked(), pytest.raises(InputError, match="another process"):
        evaluate_on_robot(tmp_path, RobotConnection(), 2, policy="zero", out=out)
    assert not list(out.glob("*.csv"))


def test_training_saves_its_state_when_it_ends_early(env, monkeypatch, tmp_path, forkserver):
    small = {
        "net_arch": (8, 8),
        "learning_starts": 1,
        "batch_size": 1,
        "exploration.constant_episodes": 0,
        "train_freq": 1,
    }
    arguments = {"algorithm": "sac", "episodes": 4, "settings": small}
    config = configure("BncConnector", {"station": "arm", "guidance": "kgrl"}, **arguments)
    folder, idle, files = RunFolder(tmp_path), env.idle, []  # the files at each call of `idle`

    def refuse():
        files.append([file.name for file in tmp_path.rglob("*") if file.is_file()])
        idle()
        if len(files) == 6:  # the first call after the second episode
            raise InputError("not confirmed: nothing moves")

    receive = PipelinedLearner.receive_learned
    # Training on the first episode lasts until the exception.
    monkeypatch.setattr(
        PipelinedLearner,
        "receive_learned",
        lambda learner: (not learner.submitted or len(files) > 6) and receive(learner),
    )
    monkeypatch.setattr(env, "idle", refuse)
    with pytest.raises(InputError, match="not confirmed"):
        _train(folder, config, env, waits=True, report=lambda row: None)
    assert "policy.json" not in files[-1]
    assert folder.episodes()["termination"].tolist() == ["time_limit"] * 2
    assert len(read_step_log(folder.steps)) == 20
    assert np.isfinite(Policy.load(tmp_path)(np.zeros(env.observation_space.shape, np.float32))).all()
    assert env._station.get_fault_output_port().Eval(env._context)[0] == Fault.USER_STOP  # `rest` was called
    assert env.questions == []

    monkeypatch.undo()
    first = folder.episodes()
    rows = _train(folder, config, env, waits=True, resume=True, report=lambda row: None)
    table = folder.episodes()
    pd.testing.assert_frame_equal(table[:2], first)
    assert table["episode"].tolist() == [0, 1, 2, 3]
    assert [row["episodes_known"] for row in rows] == [0, 0, 1, 2]
    assert len(read_step_log(folder.steps)) == 40


def test_learner_of_another_package_is_checked_before_an_episode(env, monkeypatch, tmp_path, forkserver):
    monkeypatch.setattr(LEARNERS, "is_packaged", lambda name: False)
    monkeypatch.setattr(OffPolicyLearner, "policy", lambda learner, description: 1 / 0)
    monkeypatch.setattr(env, "step", lambda action: pytest.fail("the arm moved"))
    settings = {"net_arch": (8, 8), "batch_size": 1}
    environment = {"station": "arm", "guidance": "kgrl"}
    config = configure("BncConnector", environment, algorithm="sac", episodes=1, settings=settings)
    with pytest.raises(InputError, match=r"Learner\.policy.*ZeroDivisionError"):
        _train(RunFolder(tmp_path), config, env, waits=True, report=lambda row: None)


def test_operator_stop_truncates_and_reset_resumes(env, monkeypatch):
    """A second stop, during the settling time of the reset, is confirmed as well."""
    env.reset()
    env.step(np.zeros(2))
    env.keys.request_stop()
    _, _, _, truncated, info = env.step(np.zeros(2))
    assert (truncated, info["termination"], info["stopped"]) == (True, "stopped", "stop requested by the user")
    assert max_joint_speed(env.clock) < 0.01
    assert env.questions == []
    messages = []

    def confirm(reason):
        env.questions.append(reason)
        if len(env.questions) == 1:
            env.clock.happens = {env.clock.step + 20: env.keys.request_stop}

    monkeypatch.setattr(env, "_confirm_resume", confirm)
    monkeypatch.setattr(env, "_log", messages.append)
    env.reset()
    assert env.questions == ["stop requested by the user"] * 2
    assert messages == ["resuming from here"]


def test_arm_rests_when_one_status_before_control_is_wrong(monkeypatch):
    start = preflight.start_simulator

    def start_simulator(station, *arguments):
        with monkeypatch.context() as patch:
            station.driver.receive()
            status = station.driver.read()
            wrong = replace(status, positions=status.positions + [0.15, 0, 0, 0, 0, 0, 0])
            patch.setattr(station.driver, "read", lambda: wrong)
            return start(station, *arguments)

    monkeypatch.setattr(preflight, "start_simulator", start_simulator)
    env = make_robot_env(monkeypatch, START)
    assert np.linalg.norm((env.pose - START)[:3]) > 0.05
    env._take_control()
    np.testing.assert_allclose(env.pose, START, atol=1e-3)


@pytest.mark.parametrize(
    ("method", "replacement", "fault"),
    [
        ("read", unplugged, Fault.MALFORMED),
        ("read", lambda: None, Fault.NO_STATUS),
        ("write", unplugged, Fault.COMMAND_FAILED),
    ],
)
def test_episode_is_truncated_when_the_driver_fails(env, monkeypatch, method, replacement, fault):
    if method == "write":  # the monitor damps an arm that receives no commands
        env = make_robot_env(monkeypatch, START, has_monitor=True)
    driver, messages = env._task_station.driver, []
    env.reset()
    monkeypatch.setattr(env, "_log", messages.append)
    with monkeypatch.context() as patch:
        env.clock.happens = {env.clock.step + 10: lambda: patch.setattr(driver, method, replacement)}
        *_, truncated, info = env.step(np.zeros(2))
        assert (truncated, info["termination"], env.fault) == (True, "stopped", fault)
        env.rest()
        env._switch_to_new_transfer()  # does not wait for the driver and raises no error
    assert any("could not be sent: write raised OSError" in message for message in messages) == (method == "write")
    env.reset()  # requests a confirmation and resumes
    assert len(env.questions) == 1
    assert ("raised OSError: cable unplugged" in env.questions[0]) == (replacement is unplugged)


def test_arm_does_not_resume_when_recover_raises(env, monkeypatch):
    env.reset()
    env.keys.request_stop()
    env.step(np.zeros(2))
    with monkeypatch.context() as patch:
        patch.setattr(env._station.driver, "recover", unplugged)
        with pytest.raises(InputError, match="the driver iiwa failed: recover raised OSError: cable unplugged"):
            env.reset()


def test_force_limit_remains_between_episodes(monkeypatch):
    env = make_robot_env(monkeypatch, START, force_limit_range=(8.0, 25.0))
    np.testing.assert_array_equal(env._station.read_max_wrench(env._context), max_wrench(8.0))
    env.preflight.repeat()
    np.testing.assert_array_equal(env._station.read_max_wrench(env._context), max_wrench(8.0))
    env.reset()
    World(None, None, env.diagram.diagram, env._root_context).set("max_wrench", max_wrench(11.0))
    for _ in range(2):
        env.idle()
        assert env._station is env._transfer_station
        np.testing.assert_array_equal(env._station.read_max_wrench(env._context), max_wrench(11.0))
        env._switch_to_new_transfer()


def test_row_of_a_stopped_episode_includes_its_last_action(monkeypatch):
    env = make_robot_env(monkeypatch, START, guidance="residual", bound=0.0005)
    observations = []

    def act(observation):
        observations.append(observation)
        if len(observations) == 2:
            # Within the fourth of the action's five control steps, which last four status periods each.
            env.clock.happens = {env.clock.step + 16: env.keys.request_stop}
        return np.full(2, len(observations) - 1.0)

    infos = []
    step = env.step
    monkeypatch.setattr(env, "step", lambda action: infos.append(result := step(action)) or result)
    row = rollout(env, act)
    assert (row["termination"], row["steps"]) == ("stopped", 8)
    for column, key, signal in (
        ("max_commanded_violation", "constraint_violation", "commanded_violation"),
        ("max_measured_violation", "measured_violation", "measured_violation"),
    ):
        violations = env.trace.signals[signal]
        assert row[column] == violations.max() > violations[:5].max()
        assert infos[-1][-1][key] == violations[5:].max()
    assert infos[-1][-1]["impedance_force"] == env.trace.force[5:].max()


@pytest.fixture
def session(monkeypatch):
    """Return clock of an arm at rest, list of requested confirmations, and function that starts a `robot_session`."""
    lcm, declaration = DrakeLcm("memq://"), EnvConfig.resolve("BncConnector", OPTIONS).declared
    clock, questions = SteppedRobotClock(declaration.workcell(), lcm, START), []

    @contextmanager
    def no_process(connection, *arguments):
        yield

    monkeypatch.setattr("guiderail_hardware.drivers.lcm.open_bus", lambda url: lcm)
    monkeypatch.setattr(RobotConnection, "simulated_driver", no_process)
    monkeypatch.setattr(RobotConnection, "clocks", lambda connection, station: (clock, None))
    monkeypatch.setattr("guiderail_hardware.robot.session.set_realtime_priority", lambda: True)
    monkeypatch.setattr("guiderail_hardware.robot.preflight.confirm", questions.append)
    config = configure("BncConnector", OPTIONS, seed=0, episodes=1)

    def begin(*, sim=False, assume_yes=False):
        return robot_session(config, RobotConnection(sim=sim), assume_yes=assume_yes, log=lambda text: None)

    return clock, questions, begin


@pytest.mark.parametrize("name", ["start", "monitor", "commands"])
def test_session_raises_when_a_check_fails_after_the_question(session, monkeypatch, name):
    clock, _, begin = session
    driver = clock.monitor._driver

    def change(question):
        if name == "start":
            pose = START + [0.16, 0.0, 0.05, 0.0, 0.0, 0.0]
            clock.robot.set_pose(clock.simulator.get_mutable_context(), pose)
        elif name == "monitor":
            monkeypatch.setattr(driver, "write_heartbeat", lambda heartbeat: None)
        else:
            driver.write(np.zeros(7), 1.0)

    monkeypatch.setattr("guiderail_hardware.robot.preflight.confirm", change)
    with pytest.raises(InputError, match=f"stays where it is: {name}"), begin():
        pass


def test_clock_begins_again_before_control_is_taken(session, monkeypatch):
    """The time for the question and for building the learner does not count as a gap between statuses."""
    clock, questions, begin = session
    commands = []
    clock.monitor._driver.lcm.Subscribe(IiwaDriver.command_channel, commands.append)
    with begin() as (env, _):
        assert (len(questions), commands) == (1, [])
        begin_steps, step = [], clock.step
        monkeypatch.setattr(clock, "begin", lambda: begin_steps.append(clock.step))
        env._take_control()
        assert begin_steps == [step]


@pytest.mark.parametrize("sim", [False, True])
def test_resuming_and_releasing_a_real_part_are_confirmed(session, monkeypatch, sim):
    _, _, begin = session
    questions, offsets = [], []
    monkeypatch.setattr(
        "guiderail_hardware.robot.session.confirm", lambda question, has_yes: questions.append(question)
    )
    monkeypatch.setattr(
        "guiderail_hardware.robot.session.publish_part_offsets", lambda driver, parts: offsets.append(parts)
    )
    with begin(sim=sim, assume_yes=True) as (env, _):
        env._confirm_resume("stopped")
        env._free_workpiece("stuck")
    assert [question.split()[0] for question in questions] == ["Resume"] + ["Release"] * (not sim)
    assert offsets == [[[1.0, 0.0], [0.0, 0.0]]] * sim


def test_arm_does_not_resume_after_a_termination_signal(session):
    _, _, begin = session
    with begin(sim=True, assume_yes=True) as (env, _):
        raise_signal(SIGTERM)
        with pytest.raises(InputError, match="stopped by a signal"):
            env._confirm_resume("stopped")


def test_commands_check_fails_when_another_program_commands(monkeypatch):
    env = make_robot_env(monkeypatch, START, has_monitor=True)
    assert failed_checks(env.preflight.run()) == []
    IiwaDriver(env._transfer_station.driver.lcm).write(np.zeros(7), 1.0)
    env._advance_statuses(1)
    assert failed_checks(env.preflight.run()) == ["commands"]


def test_arm_moved_by_hand_returns_slowly_a_minute_later(monkeypatch):
    """Neither the status before the question nor the gap of 60 s without statuses is a fault.

    The speed is the speed of an approach, not the largest speed of a command.
    """
    env = make_robot_env(monkeypatch, START)
    env.clock.clock = 100.0

    def move_and_confirm_after_a_minute(reason):
        env.questions.append(reason)
        env.clock.clock += 60.0
        context = env.clock.simulator.get_mutable_context()
        env.clock.robot.set_pose(context, env.pose + [0.0, 0.0, 0.01, 0.0, 0.0, 0.0])

    env._confirm_resume = move_and_confirm_after_a_minute
    env.reset()
    env.step(np.zeros(2))
    env.keys.request_stop()
    env.step(np.zeros(2))
    positions, advance = [], env._advance

    def advance_and_record():
        advance()
        positions.append(env.pose[:3])

    monkeypatch.setattr(env, "_advance", advance_and_record)
    env.reset()
    assert env.questions == ["stop requested by the user"]
    assert env._station.get_arm_state_output_port().Eval(env._context)[0] == ArmState.RUNNING
    speeds = np.linalg.norm(np.diff(positions, axis=0), axis=1) / env.diagram.control_period
    assert speeds.max() < 2.0 * SPEED
    assert np.linalg.norm((env.pose - env.begin)[:3]) < 3e-3


def test_rest_works_after_an_exception_within_a_step(env):
    def interrupt(context):
        raise KeyboardInterrupt

    env.reset()
    env.step(np.ones(2))
    env.simulator.set_monitor(interrupt)
    with pytest.raises(KeyboardInterrupt):
        env.step(np.ones(2))
    env.rest()
    assert env._station.get_fault_output_port().Eval(env._context)[0] == Fault.USER_STOP
    assert max_joint_speed(env.clock) < 0.01


def test_fault_truncates_and_the_next_reset_resumes(env):
    env.reset()
    env.step(np.zeros(2))
    step = env.clock.step
    env.clock.happens = {
        step + 3: lambda: setattr(env.clock, "is_silent", True),
        step + 30: lambda: setattr(env.clock, "is_silent", False),
    }
    _, _, terminated, truncated, info = env.step(np.zeros(2))
    assert (terminated, truncated, info["termination"], info["is_success"]) == (False, True, "stopped", False)
    assert env.fault == Fault.STALE
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2))
    env.reset()
    assert len(env.questions) == 1
    *_, info = [env.step(np.zeros(2)) for _ in range(2)][-1]
    assert info["termination"] == "time_limit"


def test_reset_repeats_the_path_then_requests_a_release(env, monkeypatch):
    """The arm is off the start after its path, and after the repetition of its path."""
    env.reset()
    env.step(np.zeros(2))
    env._extend_return_path()
    path, commanded, command = env._return_path.copy(), [], env._command

    def record(pose):
        commanded.append(pose)
        command(pose)

    monkeypatch.setattr(env, "_command", record)
    at_start = iter([False, False])
    monkeypatch.setattr(env, "_is_at_start", lambda: next(at_start, True))
    env.reset()
    backwards = [tuple(pose) for pose in path[::-1]]
    commanded = [tuple(pose) for pose in commanded]
    repetition = backwards[::-1] + backwards
    begins = range(commanded.index(backwards[-1]) + 1, len(commanded))  # the path's end may be commanded twice in a row
    assert sum(commanded[step : step + len(repetition)] == repetition for step in begins) == 1
    assert len(env.questions) == 1
    assert env.questions[0].startswith("the arm did not reach the start")


def test_reset_raises_if_off_the_start_after_the_release(env, monkeypatch):
    env.reset()
    env.step(np.zeros(2))
    env._extend_return_path()
    with monkeypatch.context() as patch:
        patch.setattr(env, "_is_at_start", lambda: False)
        with pytest.raises(InputError, match="did not reach the start"):
            env.reset()
    assert len(env.questions) == 1


@pytest.mark.parametrize("snaps_in", [False, True])
def test_release_is_requested_after_a_success_with_a_snap(env, monkeypatch, snaps_in):
    monkeypatch.setattr(env, "_snaps_in", snaps_in)
    monkeypatch.setattr(env, "_holds", lambda: True)
    env.reset()
    with monkeypatch.context() as patch:
        step = DiagramEnv.step

        def succeed(env, action):
            observation, reward, _, truncated, info = step(env, action)
            return observation, reward, True, truncated, info | {"is_success": True}

        patch.setattr(DiagramEnv, "step", succeed)
        env.step(np.zeros(2))
    env.reset()
    assert env.questions == ["the workpiece has snapped in"] * snaps_in
    env.reset()
    assert len(env.questions) == snaps_in


def test_reset_completes_after_a_stop(env):
    env.clock.happens = {env.clock.step + 20: env.keys.request_stop}
    env.reset()
    assert env.questions == ["stop requested by the user"]
    assert np.linalg.norm((env.pose - env.begin)[:3]) < 3e-3


@pytest.fixture(scope="module")
def inserted():
    """Return an environment whose plug is in the jack."""
    with pytest.MonkeyPatch.context() as patch:
        return make_robot_env(patch, np.zeros(6))


def test_push_distinguishes_inserted_and_loose_workpieces(env, inserted, monkeypatch):
    monkeypatch.setattr("guiderail_hardware.robot.robot_env.HOLD_STEPS", 15)  # a faster push
    pull, side = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)
    for robot_env, direction, max_motion, holds in (
        (env, pull, 1.0, False),  # for want of a force
        (inserted, pull, MAX_HOLD_MOTION, True),
        (inserted, side, MAX_HOLD_MOTION, True),
        (inserted, side, -1.0, False),  # because of the motion
    ):
        test = HoldTest(tuple(HOLD_DISTANCE * np.array(direction)), max_motion)
        monkeypatch.setattr(robot_env, "_hold_tests", lambda pose, test=test: [test])
        robot_env._retry_until_ok(robot_env._take_control)
        before = robot_env.pose
        assert robot_env._holds() == holds
        np.testing.assert_allclose(robot_env.pose[:3], before[:3], atol=1.5e-3)  # back at the pose before the push


def test_success_requires_resistance_to_every_push(env, monkeypatch):
    results = iter([True, False])
    monkeypatch.setattr(env, "_hold_tests", lambda pose: [HoldTest((0.0, 0.0, 1e-3), 1e-3)] * 2)
    monkeypatch.setattr(env, "_resists", lambda test, before: next(results))
    assert not env._holds()


@pytest.mark.parametrize("task", ["GridClamp", "BncConnector"])
def test_train_raises_when_the_reward_is_privileged(task, tmp_path):
    environment = {"station": "hardware", "reward": "aligned"}
    with pytest.raises(InputError, match="needs simulation state"):
        train_on_robot(task, tmp_path / "run", RobotConnection(sim=True), environment=environment, given={})


@pytest.mark.parametrize(
    ("sim", "message"), [(True, "a simulated driver: give --sim"), (False, "a robot: leave --sim")]
)
def test_resume_raises_when_real_and_simulated_robot_differ(sim, message, tmp_path):
    """The address of a simulated driver differs between processes."""
    begun, continued = (
        configure("BncConnector", OPTIONS | {"robot_url": f"udpm://239.255.76.67:{port}"}, seed=0, episodes=1)
        for port in (20001, 20002)
    )
    assert begun.identity == continued.identity
    RunFolder(tmp_path).write_config(replace(begun, simulated_driver=sim))
    connection = RobotConnection(sim=not sim)
    with pytest.raises(InputError, match=f"was trained with {message}"):
        train_on_robot(None, tmp_path, connection, environment={"station": "hardware"}, given={}, resume=True)


@pytest.mark.parametrize("setting", ["demonstration_episodes", "stop_after_successes"])
def test_train_raises_when_a_setting_needs_a_simulation(setting, tmp_path):
    with pytest.raises(InputError, match=f"leave the setting {setting} out"):
        train_on_robot(
            "BncConnector",
            tmp_path / "run",
            RobotConnection(sim=True),
            environment={"station": "hardware", "guidance": "kgrl"},
            given={"settings": {setting: 1}},
        )
    assert not (tmp_path / "run").exists()


def test_train_raises_when_the_folder_lacks_space(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=9))
    environment = {"station": "hardware", "guidance": "kgrl"}
    with pytest.raises(InputError, match="has room for 9 bytes"):
        train_on_robot("BncConnector", tmp_path / "run", RobotConnection(sim=True), environment=environment, given={})
    assert not (tmp_path / "run").exists()
