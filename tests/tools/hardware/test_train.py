"""Episodes and training on a robot, with both sides of the bus in one process."""

from contextlib import contextmanager
from dataclasses import replace
from signal import SIGTERM, raise_signal
from types import SimpleNamespace

import gymnasium
import numpy as np
import pandas as pd
import pytest
from injections.stepped_robot import SteppedRobotClock
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.envs.assemble import build_task_diagram
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.env import DiagramEnv
from guiderail.diagrams.envs.make import make_guidance, make_station
from guiderail.diagrams.hardware.lcm import IiwaDriver
from guiderail.diagrams.stations.station import max_wrench
from guiderail.diagrams.tasks.insertion import HOLD_DISTANCE, MAX_HOLD_MOTION, HoldTest
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import Fault, JointStatus
from guiderail.models.policy import Policy
from guiderail.systems.torque_safety_limiter import ArmState
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.hardware import preflight
from guiderail.tools.hardware.connection import RobotConnection
from guiderail.tools.hardware.evaluate import evaluate_on_robot
from guiderail.tools.hardware.operator import OperatorKeys
from guiderail.tools.hardware.preflight import SPEED
from guiderail.tools.hardware.robot_env import RobotEnv
from guiderail.tools.hardware.session import robot_session
from guiderail.tools.hardware.sim_driver import START
from guiderail.tools.hardware.train import _train, train_on_robot
from guiderail.tools.learning.pipelined import PipelinedLearner
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import configure

OPTIONS = {"station": "hardware", "guidance": "kgrl", "fixture_offset": "none", "reward": "shaped", "action_repeat": 5}


def make(patch, start, **options):
    """Return an environment; `env.clock` has its robot, `env.asked` the reasons that were to be confirmed."""
    lcm, declared = DrakeLcm("memq://"), EnvConfig.resolve("BncConnector", OPTIONS | options).make_task()
    patch.setattr(declared, "num_steps", 10)
    with patch.context() as bus:
        bus.setattr("guiderail.diagrams.hardware.lcm.open_bus", lambda url: lcm)
        station = make_station(declared)
    task = build_task_diagram(declared, station, make_guidance(declared, station))
    clock, keys, requests = SteppedRobotClock(declared.workcell(), lcm, start), OperatorKeys(), []
    begin = declared.start_pose(np.random.default_rng(0))
    env = RobotEnv(
        task,
        station,
        clock,
        action_repeat=5,
        keys=keys,
        confirm_resume=requests.append,
        free_workpiece=requests.append,
        log=lambda text: None,
    )
    env.clock, env.keys, env.asked, env.begin = clock, keys, requests, begin
    return env


@pytest.fixture(scope="module")
def shared():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("guiderail.tools.hardware.preflight.SETTLING_TIME", 0.1)
        env = make(patch, START + [0.002, 0.0, 0.0, 0.0, 0.0, 0.0])
        yield env


@pytest.fixture
def env(shared):
    shared._retry_until_ok(lambda: None)  # the test before may have left the arm at rest
    shared.asked.clear()
    shared.keys.clear_stop()
    return shared


def still(observation):
    return np.zeros(2)


def test_reset_moves_to_the_start_and_an_episode_ends(env):
    assert all(check.passed in (True, None) for check in env.preflight.run())
    for index in range(2):
        row = rollout(env, still, index=index)
        assert (row["termination"], row["steps"], env.asked) == ("time_limit", 10, [])
        np.testing.assert_allclose(env.trace.measured[0][:3], env.begin[:3], atol=2e-3)
        assert (env.trace.signals["command_timed_out"] == 0.0).all()
        env.idle()
    with pytest.raises(InputError, match="takes no options"):
        env.reset(options={"offset": (0.0, 0.0)})


def test_reset_randomizes_parts_with_its_seed_and_options(env, monkeypatch):
    monkeypatch.setattr(env, "_randomize_parts", lambda rng, options: {"drawn": (float(rng.random()), options)})
    _, info = env.reset(seed=3, options={"held_out": True})
    assert info["drawn"] == (float(np.random.default_rng(3).random()), {"held_out": True})


def test_evaluate_writes_a_row_per_episode(env, monkeypatch, tmp_path):
    @contextmanager
    def fake_session(config, connection, *, assume_yes, log):
        assert (config.environment["station"], config.environment["guidance"]) == ("hardware", "kgrl")
        yield env, dict

    monkeypatch.setattr("guiderail.tools.hardware.evaluate.robot_session", fake_session)
    learned_on = {"station": "arm", "robot": "panda", "guidance": "kgrl"}
    RunFolder(tmp_path).write_config(configure("BncConnector", learned_on, seed=0, episodes=1))
    env.keys.is_pause_requested = True
    result = evaluate_on_robot(tmp_path, RobotConnection(), 2, policy="zero")
    assert (result["episodes"], result["success_rate"]) == (2, 0.0)
    assert (env.asked, env.keys.is_pause_requested) == (
        ["stop requested by the user"],
        False,
    )  # after the first, and once
    rows = pd.read_csv(tmp_path / "hardware" / "episodes-zero.csv")
    assert rows["termination"].tolist() == ["time_limit"] * 2
    with pytest.raises(InputError, match="already exists"):
        evaluate_on_robot(tmp_path, RobotConnection(), 2, policy="zero")
    with pytest.raises(InputError, match="at least one"):
        evaluate_on_robot(tmp_path, RobotConnection(), 0)
    # Two evaluations at once, neither of which has a row yet, do not overwrite each other's file.
    elsewhere = tmp_path / "elsewhere"
    with RunFolder(elsewhere).locked(), pytest.raises(InputError, match="another process"):
        evaluate_on_robot(tmp_path, RobotConnection(), 2, policy="zero", out=elsewhere)
    assert not list(elsewhere.glob("*.csv"))


def test_training_saves_its_state_when_it_ends_early(env, monkeypatch, tmp_path, forkserver):
    small = {"net_arch": (8, 8), "learning_starts": 1, "batch_size": 1, "constant_episodes": 0, "train_freq": 1}
    arguments = {"algorithm": "sac", "episodes": 5, "settings": small}
    config = configure("BncConnector", {"station": "arm", "guidance": "kgrl"}, **arguments)
    folder, idle, before = RunFolder(tmp_path), env.idle, []

    def refuse():
        before.append([file.name for file in tmp_path.rglob("*") if file.is_file()])
        idle()
        if len(before) == 6:  # the first call of the second episode
            raise InputError("not confirmed: nothing moves")

    receive = PipelinedLearner.receive_learned
    # The first episode is being learned until the exception.
    monkeypatch.setattr(
        PipelinedLearner, "receive_learned", lambda one: (not one.submitted or len(before) > 6) and receive(one)
    )
    monkeypatch.setattr(env, "idle", refuse)
    with pytest.raises(InputError, match="not confirmed"):
        _train(folder, config, env, waits=True, report=lambda row: None)
    assert "policy.json" not in before[-1]
    assert folder.episodes()["termination"].tolist() == ["time_limit"] * 2
    assert len(read_step_log(folder.steps)) == 20
    assert np.isfinite(Policy.load(tmp_path)(np.zeros(env.observation_space.shape, np.float32))).all()
    assert env._station.get_fault_output_port().Eval(env._context)[0] == Fault.USER_STOP  # at rest
    assert env.asked == []

    monkeypatch.undo()
    first = folder.episodes()
    rows = _train(folder, config, env, waits=True, resume=True, report=lambda row: None)
    table = folder.episodes()
    pd.testing.assert_frame_equal(table[:2], first)
    assert table["episode"].tolist() == [0, 1, 2, 3, 4]
    assert [row["episodes_known"] for row in rows] == [0, 0, 1, 2, 3]
    assert len(read_step_log(folder.steps)) == 50


def test_operator_stop_truncates_and_reset_resumes(env):
    env.reset()
    env.step(np.zeros(2))
    env.keys.request_stop()
    _, _, _, truncated, info = env.step(np.zeros(2))
    assert (truncated, info["termination"], info["stopped"]) == (True, "stopped", "stop requested by the user")
    velocities = env.clock.robot.plant.GetVelocities(
        env.clock.robot.plant.GetMyContextFromRoot(env.clock.simulator.get_context())
    )
    assert np.abs(velocities).max() < 0.01
    assert env.asked == []
    env.reset()
    assert env.asked == ["stop requested by the user"]


def test_stop_requested_while_statuses_settle_is_asked_about_again(env, monkeypatch):
    env.reset()
    env.keys.request_stop()
    env.step(np.zeros(2))
    messages = []

    def confirm(reason):
        env.asked.append(reason)
        if len(env.asked) == 1:
            env.clock.happens = {env.clock.step + 20: env.keys.request_stop}

    monkeypatch.setattr(env, "_confirm_resume", confirm)
    monkeypatch.setattr(env, "_log", messages.append)
    env.reset()
    assert (len(env.asked), messages) == (2, ["resuming from here"])


def test_single_wrong_status_before_control_is_taken_moves_nothing(monkeypatch):
    start = preflight.start_simulator

    def start_simulator(station, *arguments):
        with monkeypatch.context() as patch:
            station.driver.receive()
            status = station.driver.read()
            wrong = replace(status, positions=status.positions + [0.15, 0, 0, 0, 0, 0, 0])
            patch.setattr(station.driver, "read", lambda: wrong)
            return start(station, *arguments)

    monkeypatch.setattr(preflight, "start_simulator", start_simulator)
    env = make(monkeypatch, START)
    assert np.linalg.norm((env.pose - START)[:3]) > 0.05
    env._take_control()
    np.testing.assert_allclose(env.pose, START, atol=1e-3)


def unplugged(*arguments):
    raise OSError("cable unplugged")


@pytest.mark.parametrize(
    ("method", "replacement", "fault"),
    [
        ("read", unplugged, Fault.MALFORMED),
        ("receive", unplugged, Fault.MALFORMED),
        ("read", lambda: JointStatus("now", 0.0, None, 0.0), Fault.MALFORMED),
        ("read", lambda: None, Fault.NO_STATUS),
        ("write", unplugged, Fault.COMMAND_FAILED),
    ],
)
def test_episode_is_truncated_when_the_driver_fails(env, monkeypatch, method, replacement, fault):
    driver, messages = env._task_station.driver, []
    env.reset()
    monkeypatch.setattr(env, "_log", messages.append)
    with monkeypatch.context() as patch:
        env.clock.happens = {env.clock.step + 10: lambda: patch.setattr(driver, method, replacement)}
        *_, truncated, info = env.step(np.zeros(2))
        assert (truncated, info["termination"], env.fault) == (True, "stopped", fault)
        env.rest()
        env._switch_to_new_transfer()  # neither waits nor raises
    assert any("could not be sent: write raised OSError" in message for message in messages) == (method == "write")
    env.reset()  # asks, and resumes
    assert len(env.asked) == 1
    assert ("raised OSError: cable unplugged" in env.asked[0]) == (replacement is unplugged)


def test_arm_does_not_resume_when_the_recovery_raises(env, monkeypatch):
    env.reset()
    env.keys.request_stop()
    env.step(np.zeros(2))
    with monkeypatch.context() as patch:
        patch.setattr(env._station.driver, "recover", unplugged)
        with pytest.raises(InputError, match="the driver iiwa failed: recover raised OSError: cable unplugged"):
            env.reset()


def test_motions_between_episodes_have_the_bound_of_the_episode(monkeypatch):
    env = make(monkeypatch, START, force_limit_range=(8.0, 25.0))
    np.testing.assert_array_equal(env._station.read_max_wrench(env._context), max_wrench(8.0))
    env.preflight.repeat()
    np.testing.assert_array_equal(env._station.read_max_wrench(env._context), max_wrench(8.0))
    env.reset()
    env.task.declaration.episode_constants["max_wrench"].set(env._root_context, max_wrench(11.0))
    for _ in range(2):
        env.idle()
        assert env._station is env._transfer_station
        np.testing.assert_array_equal(env._station.read_max_wrench(env._context), max_wrench(11.0))
        env._switch_to_new_transfer()


def test_row_of_a_stopped_episode_includes_its_last_action(monkeypatch):
    monkeypatch.setattr("guiderail.tools.hardware.preflight.SETTLING_TIME", 0.1)
    env = make(monkeypatch, START, guidance="residual", bound=0.0005)
    observations = []

    def act(observation):
        observations.append(observation)
        if len(observations) == 2:
            env.clock.happens = {
                env.clock.step + 16: env.keys.request_stop
            }  # in the fourth of five control steps of the action
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
        seen = env.trace.signals[signal]
        assert row[column] == seen.max() > seen[:5].max()
        assert infos[-1][-1][key] == seen[5:].max()
    assert infos[-1][-1]["contact_force"] == env.trace.force[5:].max()


@pytest.fixture
def ready(monkeypatch):
    """Return clock of a waiting arm, list of the questions, and function that starts a `robot_session`."""
    lcm, declared = DrakeLcm("memq://"), EnvConfig.resolve("BncConnector", OPTIONS).make_task()
    clock, requests = SteppedRobotClock(declared.workcell(), lcm, START), []

    @contextmanager
    def no_process(connection, *arguments):
        yield

    monkeypatch.setattr("guiderail.diagrams.hardware.lcm.open_bus", lambda url: lcm)
    monkeypatch.setattr(RobotConnection, "simulated_driver", no_process)
    monkeypatch.setattr(RobotConnection, "clocks", lambda connection, station: (clock, None))
    monkeypatch.setattr("guiderail.tools.hardware.session.set_realtime_priority", lambda: True)
    monkeypatch.setattr("guiderail.tools.hardware.preflight.confirm", requests.append)
    config = configure("BncConnector", OPTIONS, seed=0, episodes=1)

    def begin(*, sim=False, assume_yes=False):
        return robot_session(config, RobotConnection(sim=sim), assume_yes=assume_yes, log=lambda text: None)

    return clock, requests, begin


@pytest.mark.parametrize("name", ["start", "monitor", "commands"])
def test_session_raises_when_a_check_fails_after_the_question(ready, monkeypatch, name):
    clock, _, begin = ready
    driver = clock.monitor._driver

    def change(question):
        if name == "start":
            pose = START + [0.16, 0.0, 0.05, 0.0, 0.0, 0.0]
            clock.robot.set_pose(clock.simulator.get_mutable_context(), pose)
        elif name == "monitor":
            monkeypatch.setattr(driver, "write_heartbeat", lambda heartbeat: None)
        else:
            driver.write(np.zeros(7), 1.0)

    monkeypatch.setattr("guiderail.tools.hardware.preflight.confirm", change)
    with pytest.raises(InputError, match=f"stays where it is: {name}"), begin():
        pass


def test_clock_begins_again_before_control_is_taken(ready, monkeypatch):
    """Time for the question and for building the learner is no gap between statuses."""
    clock, requests, begin = ready
    commands = []
    clock.monitor._driver.lcm.Subscribe(IiwaDriver.command_channel, commands.append)
    with begin() as (env, _):
        assert (len(requests), commands) == (1, [])  # nothing was sent yet
        begun, step = [], clock.step
        monkeypatch.setattr(clock, "begin", lambda: begun.append(clock.step))
        env._take_control()
        assert begun == [step]


@pytest.mark.parametrize(("sim", "assume_yes"), [(False, False), (False, True), (True, False), (True, True)])
def test_resuming_is_confirmed_and_releasing_unless_simulated(ready, monkeypatch, sim, assume_yes):
    _, _, begin = ready
    questions, offsets = [], []
    monkeypatch.setattr(
        "guiderail.tools.hardware.session.confirm", lambda question, has_yes: questions.append(question)
    )
    monkeypatch.setattr(
        "guiderail.tools.hardware.session.publish_part_offsets", lambda driver, parts: offsets.append(parts)
    )
    with begin(sim=sim, assume_yes=assume_yes) as (env, _):
        env._confirm_resume("stopped")
        env._free_workpiece("stuck")
    assert [question.split()[0] for question in questions] == ["Resume"] + ["Release"] * (not sim)
    assert offsets == [[[1.0, 0.0], [0.0, 0.0]]] * sim


def test_arm_does_not_resume_after_a_signal_that_ends_the_program(ready):
    begin = ready[2]
    with begin(sim=True, assume_yes=True) as (env, _):
        raise_signal(SIGTERM)
        with pytest.raises(InputError, match="stopped by a signal"):
            env._confirm_resume("stopped")


def test_commands_check_fails_when_another_program_commands(monkeypatch):
    env = make(monkeypatch, START)

    def check():
        return {one.name: one.passed for one in env.preflight.run()}["commands"]

    assert check()
    IiwaDriver(env._transfer_station.driver.lcm).write(np.zeros(7), 1.0)
    env._advance_statuses(1)
    assert not check()


def test_resume_works_a_minute_after_the_stop(monkeypatch):
    """Neither the status from before the question nor the gap since then is a fault."""
    env = make(monkeypatch, START)
    env.clock.clock = 100.0

    def think(message):
        env.asked.append(message)
        env.clock.clock += 60.0

    env._confirm_resume = think
    env.reset()
    env.keys.request_stop()
    env.step(np.zeros(2))
    env.reset()
    assert env.asked == ["stop requested by the user"]
    assert env._station.get_arm_state_output_port().Eval(env._context)[0] == ArmState.RUNNING


def test_arm_moved_by_hand_returns_slowly_to_its_path(monkeypatch):
    """The speed is that of a slow approach, and not the largest of a command."""
    env = make(monkeypatch, START)
    env.reset()
    env.step(np.zeros(2))
    env.keys.request_stop()
    env.step(np.zeros(2))
    context = env.clock.simulator.get_mutable_context()
    env.clock.robot.set_pose(context, env.pose + [0.0, 0.0, 0.03, 0.0, 0.0, 0.0])
    places, advance = [], env._advance

    def watched():
        advance()
        places.append(env.pose[:3])

    monkeypatch.setattr(env, "_advance", watched)
    env.reset()
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / env.task.control_period
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
    plant = env.clock.robot.plant
    velocities = plant.GetVelocities(plant.GetMyContextFromRoot(env.clock.simulator.get_context()))
    assert np.abs(velocities).max() < 0.01


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
    assert len(env.asked) == 1
    row = rollout(env, still)
    assert row["termination"] == "time_limit"


def test_reset_repeats_its_path_once_if_the_start_is_not_reached(env, monkeypatch):
    env.reset()
    env.step(np.zeros(2))
    env._extend_return_path()
    path, commanded, command = env._return_path.copy(), [], env._command

    def record(pose):
        commanded.append(pose)
        command(pose)

    monkeypatch.setattr(env, "_command", record)
    at_start = iter([False])
    monkeypatch.setattr(env, "_is_at_start", lambda: next(at_start, True))
    env.reset()
    back = [tuple(pose) for pose in path[::-1]]
    commanded = [tuple(pose) for pose in commanded]
    there_and_back = back[::-1] + back
    first = range(commanded.index(back[-1]) + 1, len(commanded))  # the path's end may be commanded twice in a row
    assert sum(commanded[step : step + len(there_and_back)] == there_and_back for step in first) == 1


def test_reset_has_the_workpiece_released_by_hand_if_the_start_is_not_reached(env, monkeypatch):
    env.reset()
    env.step(np.zeros(2))
    env._extend_return_path()
    at_start = iter([False, False])
    monkeypatch.setattr(env, "_is_at_start", lambda: next(at_start, True))
    env.reset()
    assert len(env.asked) == 1
    assert env.asked[0].startswith("the arm did not reach the start")


def test_reset_raises_if_the_start_is_not_reached_after_the_release(env, monkeypatch):
    env.reset()
    env.step(np.zeros(2))
    env._extend_return_path()
    with monkeypatch.context() as patch:
        patch.setattr(env, "_is_at_start", lambda: False)
        with pytest.raises(InputError, match="did not reach the start"):
            env.reset()
    assert len(env.asked) == 1


@pytest.mark.parametrize("snaps_in", [False, True])
def test_workpiece_that_snapped_in_is_released_by_hand(env, monkeypatch, snaps_in):
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
    assert env.asked == ["the workpiece has snapped in"] * snaps_in
    env.reset()
    assert len(env.asked) == snaps_in


def test_reset_completes_after_a_stop(env):
    env.clock.happens = {env.clock.step + 20: env.keys.request_stop}
    env.reset()
    assert env.asked == ["stop requested by the user"]
    assert np.linalg.norm((env.pose - env.begin)[:3]) < 3e-3


@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
def test_push_tells_an_inserted_workpiece_from_a_loose_one(env, monkeypatch, direction):
    test = HoldTest(tuple(HOLD_DISTANCE * np.array(direction)), MAX_HOLD_MOTION)
    for one, holds in ((env, False), (make(monkeypatch, np.zeros(6)), True)):
        monkeypatch.setattr(one, "_hold_tests", lambda pose: [test])
        one._retry_until_ok(one._take_control)
        before = one.pose
        assert one._holds() == holds
        np.testing.assert_allclose(one.pose[:3], before[:3], atol=1.5e-3)  # it returns


def test_success_needs_every_push_to_be_resisted(env, monkeypatch):
    results = iter([True, False])
    monkeypatch.setattr(env, "_hold_tests", lambda pose: [HoldTest((0.0, 0.0, 1e-3), 1e-3)] * 2)
    monkeypatch.setattr(env, "_resists", lambda test, before: next(results))
    assert not env._holds()


@pytest.mark.parametrize(
    ("task", "options", "message"),
    [
        ("GridClamp", {"reward": "aligned"}, "needs simulation state"),
        ("BncConnector", {"reward": "aligned"}, "needs simulation state"),
    ],
)
def test_train_raises_when_success_is_not_observable(task, options, message, tmp_path):
    with pytest.raises(InputError, match=message):
        train_on_robot(
            task, tmp_path / "run", RobotConnection(sim=True), environment={"station": "hardware"} | options, given={}
        )


@pytest.mark.parametrize(("sim", "words"), [(True, "a simulated driver: give --sim"), (False, "a robot: leave --sim")])
def test_run_is_resumed_with_the_kind_of_driver_that_it_began_with(sim, words, tmp_path):
    """The address of a simulated driver differs between processes."""
    begun, other = (
        configure("BncConnector", OPTIONS | {"robot_url": f"udpm://239.255.76.67:{port}"}, seed=0, episodes=1)
        for port in (20001, 20002)
    )
    assert begun.identity == other.identity
    RunFolder(tmp_path).write_config(replace(begun, simulated_driver=sim))
    connection = RobotConnection(sim=not sim)
    with pytest.raises(InputError, match=f"was trained with {words}"):
        train_on_robot(None, tmp_path, connection, environment={"station": "hardware"}, given={}, resume=True)


@pytest.mark.parametrize("setting", ["demonstration_episodes", "stop_after_successes"])
def test_settings_without_meaning_on_a_robot_are_refused(setting, tmp_path):
    with pytest.raises(InputError, match=f"leave the setting {setting} out"):
        train_on_robot(
            "BncConnector",
            tmp_path / "run",
            RobotConnection(sim=True),
            environment={"station": "hardware", "guidance": "kgrl"},
            given={},
            settings={setting: 1},
        )
    assert not (tmp_path / "run").exists()


def test_folder_without_room_for_the_step_log_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: SimpleNamespace(free=9))
    environment = {"station": "hardware", "guidance": "kgrl"}
    with pytest.raises(InputError, match="has room for 9 bytes"):
        train_on_robot("BncConnector", tmp_path / "run", RobotConnection(sim=True), environment=environment, given={})
    assert not (tmp_path / "run").exists()
