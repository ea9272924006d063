"""Driver on Universal Robots' RTDE, with a double of the robot's controller (`rtde_server`)."""

import os
import time
from types import SimpleNamespace

import numpy as np
import pytest
from hardware_doubles import failed_checks
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from rtde_server import END_FORCE_MODE, FORCE_MODE, ZERO_SENSOR, DirectClient, RtdeProcess, RtdeServer

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers import rtde
from guiderail_hardware.drivers.rtde import RtdeDriver
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation, make_robot_impedance
from guiderail_hardware.systems.torque_safety_limiter import ArmState

WORKCELL = BncWorkcell()
IMPEDANCE = Impedance().with_max_force(18.0)
TIMEOUT = 60.0  # longest wall-clock time to wait for messages [s]


def wait_until(condition):
    """Wait until a condition, a function without arguments, returns True."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end
        time.sleep(1e-3)


@pytest.fixture(scope="module")
def model():
    return ArmControllerPlant(WORKCELL, "ur5e")


@pytest.fixture(scope="module")
def impedance(model):
    return make_robot_impedance(model, IMPEDANCE)


@pytest.fixture
def robot(model):
    return RtdeServer("192.0.2.1", model.solve(START, model.posture))


@pytest.fixture
def driver(robot, impedance):
    driver = RtdeDriver(robot.host, client=DirectClient(robot))
    driver.read()
    driver.configure(impedance)
    return driver


def model_pose(model, driver):
    """Return the tool's pose in the base frame by the model, at the measured joint positions."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, driver.read().positions)
    return model.tool_center.CalcPoseInWorld(context)


def test_configuration_sets_tool_and_payload(robot, driver, impedance):
    np.testing.assert_allclose(robot.tcp[:3], impedance.X_FlangeTool.translation(), atol=1e-9)
    np.testing.assert_allclose(robot.payload[0], impedance.mass)
    np.testing.assert_allclose(robot.payload[1:4], impedance.center_of_mass)
    expected = impedance.inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    np.testing.assert_allclose(robot.payload[4:], expected)


@pytest.mark.parametrize(("share", "is_refused"), [(0.95, False), (1.05, True), (np.nan, True)])
def test_configure_refuses_to_zero_a_loaded_sensor(robot, impedance, share, is_refused):
    robot.bias = np.array([0.0, 0.0, share * rtde.MAX_ZEROED_FORCE, 0.0, 0.0, 0.0])
    driver = RtdeDriver(robot.host, client=DirectClient(robot))
    driver.read()
    if is_refused:
        with pytest.raises(InputError, match="free its tool"):
            driver.configure(impedance)
    else:
        driver.configure(impedance)
        np.testing.assert_array_equal(robot.bias, np.zeros(6))


def test_status_has_the_joint_torques_of_the_tool_force(robot, driver, model):
    force = np.array([3.0, -5.0, 7.0, 0.2, 0.3, -0.4])
    robot.bias = force
    robot.advance(0.01)
    status, torques = driver.read(), []
    before = model_pose(model, driver)
    for joint in range(6):
        q = status.positions.copy()
        q[joint] += 1e-6
        context = model.plant.CreateDefaultContext()
        model.plant.SetPositions(context, q)
        after = model.tool_center.CalcPoseInWorld(context)
        rotation = (after.rotation() @ before.rotation().inverse()).ToAngleAxis()
        displacement = np.concatenate([after.translation() - before.translation(), rotation.angle() * rotation.axis()])
        # Virtual work per joint displacement; the controller's base frame is rotated by half a turn about z.
        torques.append(np.array([-1, -1, 1, -1, -1, 1]) * force @ displacement / 1e-6)
    np.testing.assert_allclose(status.external_torque, torques, atol=1e-4)


def test_commanded_wrench_equals_the_bounded_spring_force(robot, driver, model, impedance):
    actual = model_pose(model, driver)
    error = np.array([0.004, -0.003, 0.002])
    driver.write_pose(RigidTransform(actual.rotation(), actual.translation() + error), 0.0)
    spring = np.diag(impedance.stiffness)[:3] * error
    np.testing.assert_allclose(robot.wrench, [-spring[0], -spring[1], spring[2], 0.0, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(robot.speed_limits[:3], RtdeDriver.motion_limits.linear[0])
    np.testing.assert_allclose(robot.task_frame[:3], robot.pose()[:3], atol=1e-6)
    driver.write_pose(RigidTransform([5.0, 5.0, -5.0]) @ actual, 0.0)
    np.testing.assert_allclose(np.abs(robot.wrench[:3]), impedance.max_wrench[:3])
    assert (np.abs(robot.wrench) <= impedance.max_wrench + 1e-12).all()


def test_sensor_is_not_zeroed_when_resuming_in_contact(robot, driver, model, impedance):
    robot.plane = robot.pose()[2] - 0.001
    below = RigidTransform([0.0, 0.0, -0.05]) @ model_pose(model, driver)
    for _ in range(2):
        for _ in range(100):
            robot.advance(0.004)
            driver.read()
            driver.write_pose(below, 0.0)
        assert robot.contact_force()[2] == pytest.approx(impedance.max_wrench[2], rel=1e-3)
        driver.stop()
        driver._stopping.join()
        driver.recover()
        driver.configure(impedance)
    assert robot.commands.count(ZERO_SENSOR) == 1


@pytest.mark.parametrize(("timeouts", "is_alive"), [(0.9, True), (1.2, False)])
def test_program_ends_after_the_watchdog_timeout(robot, driver, model, timeouts, is_alive):
    driver.write_pose(model_pose(model, driver), 0.0)
    robot.advance(timeouts / rtde.WATCHDOG_FREQUENCY)
    assert robot.is_running == is_alive
    if not is_alive:
        assert not driver.read().is_readable
        driver.recover()
        assert driver.read().is_readable


def test_watchdog_is_reset_by_reads_while_the_robot_holds(robot, driver, model):
    driver.write_pose(model_pose(model, driver), 0.0)
    driver.stop()
    driver.stop()
    driver._stopping.join()
    assert robot.wrench is None
    assert robot.commands.count(END_FORCE_MODE) == 1
    for _ in range(4):
        robot.advance(0.5 / rtde.WATCHDOG_FREQUENCY)
        assert driver.read().is_readable
    assert robot.is_running
    driver.write_pose(model_pose(model, driver), 0.0)
    assert robot.commands[-1] == FORCE_MODE


def refuse():
    return False


def fail():
    raise RuntimeError("connection lost")


@pytest.mark.parametrize("stop", [refuse, fail])
def test_watchdog_ends_the_program_when_stopping_fails(robot, driver, model, monkeypatch, stop):
    driver.write_pose(model_pose(model, driver), 0.0)
    with monkeypatch.context() as patch:
        patch.setattr(driver._control, "forceModeStop", stop, raising=False)
        driver.stop()
        driver._stopping.join()
    for _ in range(4):
        robot.advance(0.5 / rtde.WATCHDOG_FREQUENCY)
        driver.read()
    assert not robot.is_running
    assert not driver.read().is_readable
    driver.recover()
    for _ in range(4):
        robot.advance(0.5 / rtde.WATCHDOG_FREQUENCY)
        assert driver.read().is_readable


def test_protective_stop_is_a_fault_until_recovery(robot, driver, monkeypatch):
    monkeypatch.setattr(rtde, "RECOVERY_TIME", 0.0)
    robot.safety_bits = 1 + 4
    assert not driver.read().is_readable
    assert driver.error == "protective stop"
    assert failed_checks(driver.check_setup()) == ["state"]
    driver.recover()
    assert driver.read().is_readable
    robot.safety_bits = 128
    assert not driver.read().is_readable
    with pytest.raises(InputError, match="cannot recover: emergency stop"):
        driver.recover()


def test_recover_raises_when_the_robot_does_not_answer(robot, driver, monkeypatch):
    robot.safety_bits = 1 + 4
    monkeypatch.setattr(driver._client, "DashboardClient", lambda url: SimpleNamespace(connect=fail), raising=False)
    with pytest.raises(InputError, match="cannot recover: connection lost"):
        driver.recover()
    assert driver.error == "protective stop"


@pytest.mark.parametrize(("share", "is_refused"), [(0.9, False), (1.1, True), (np.nan, True)])
def test_write_pose_raises_when_the_kinematics_differ(robot, driver, model, share, is_refused):
    robot.calibration = np.array([0.0, share * rtde.MAX_POSE_DIFFERENCE, 0.0])
    driver.read()
    assert failed_checks(driver.check_setup()) == ["kinematics"] * is_refused
    if is_refused:
        with pytest.raises(InputError, match="another robot, or another tool"):
            driver.write_pose(model_pose(model, driver), 0.0)
        assert FORCE_MODE not in robot.commands
    else:
        driver.write_pose(model_pose(model, driver), 0.0)


def test_methods_raise_before_the_first_status(impedance):
    driver = RtdeDriver("192.0.2.1", client=SimpleNamespace())
    with pytest.raises(InputError, match="configured"):
        driver.write_pose(RigidTransform(), 0.0)
    for call in (lambda: driver.configure(impedance), driver.check_setup, driver.recover):
        with pytest.raises(InputError, match="the driver rtde is used before it has read a status"):
            call()


def test_check_names_a_stop_that_exists_at_the_connection(robot, monkeypatch):
    driver = RtdeDriver(robot.host, client=DirectClient(robot))
    monkeypatch.setattr(RtdeDriver, "error", "protective stop")
    assert not driver.read().is_readable
    (check,) = driver.check_setup()
    assert (check.description, check.passed) == ("protective stop", False)


def test_station_presses_with_the_bounded_force_and_stops(robot):
    station = HardwareStation(WORKCELL, RtdeDriver(robot.host, client=DirectClient(robot)), IMPEDANCE, robot="ur5e")
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.get_desired_pose_input_port().FixValue(context, START)
    station.start(simulator)
    height = robot.pose()[2]
    robot.plane = height - 0.003

    def advance(seconds):
        for step in range(round(seconds / station.period)):
            robot.advance(0.006 if step % 2 else 0.004)  # 2 ms cycles of the robot, on average 5 ms per station step
            station.receive(context)
            simulator.AdvanceTo(context.get_time() + station.period)

    def state():
        return ArmState(int(station.get_arm_state_output_port().Eval(context)[0]))

    advance(0.8)
    assert state() == ArmState.RUNNING
    assert abs(robot.pose()[2] - height) < 5e-4
    station.get_desired_pose_input_port().FixValue(context, START - [0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
    advance(0.4)
    assert state() == ArmState.RUNNING, Fault(int(station.get_fault_output_port().Eval(context)[0])).description
    force = station.get_wrench_output_port().Eval(context)[2]
    assert force == pytest.approx(IMPEDANCE.limits[2], rel=0.05)
    robot.safety_bits = 1 + 4
    advance(0.02)
    assert state() == ArmState.DAMPING


def test_lost_connection_is_a_fault_until_a_restart(robot, driver):
    driver._client.is_connected = False
    assert not driver.read().is_readable
    driver._client.is_connected = True
    assert not driver.read().is_readable
    with pytest.raises(InputError, match="is lost"):
        driver.recover()


def test_driver_with_the_real_client_controls_the_double(model, impedance, forkserver):
    pytest.importorskip("rtde_control", reason="ur-rtde has no wheel for this Python")
    host = f"127.42.{os.getpid() // 250 % 250}.{os.getpid() % 250 + 1}"
    robot = RtdeProcess(host, model.solve(START, model.posture))
    driver = RtdeDriver(host)
    wait_until(lambda: driver.read() is not None)
    driver.configure(impedance)
    np.testing.assert_allclose(robot.tcp[:3], impedance.X_FlangeTool.translation(), atol=1e-9)
    np.testing.assert_allclose(robot.payload[:4], [impedance.mass, *impedance.center_of_mass], atol=1e-9)
    robot.bias = np.array([0.0, 0.0, 4.0, 0.0, 0.0, 0.0])
    robot.advance(0.01)
    time_of_force = robot.time
    wait_until(lambda: driver.read().time == time_of_force)
    assert driver.read().external_torque @ driver.read().external_torque > 1.0
    np.testing.assert_allclose(driver.read().positions, robot.positions)
    X = RigidTransform([0.0, 0.0, 0.005]) @ model_pose(model, driver)
    driver.write_pose(X, 0.0)
    wait_until(lambda: robot.wrench is not None)
    np.testing.assert_allclose(robot.wrench, [0.0, 0.0, 7.5, 0.0, 0.0, 0.0], atol=1e-4)
    assert robot.watchdog == rtde.WATCHDOG_FREQUENCY
    driver.stop()
    driver._stopping.join(TIMEOUT)
    assert robot.wrench is None
    robot.safety_bits = 5
    wait_until(lambda: not driver.read().is_readable)
    driver.recover()
    wait_until(lambda: driver.read().is_readable)
    robot.advance(2.0 / rtde.WATCHDOG_FREQUENCY)
    wait_until(lambda: driver.error == "its program has ended")
    driver.recover()
    wait_until(lambda: driver.read().is_readable)
    driver._control.disconnect()
    driver._receiver.disconnect()
    robot.kill()
