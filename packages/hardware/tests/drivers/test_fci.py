"""Driver on the Franka Control Interface, with a double of the client library; `make fci` tests the real library."""

from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from hardware_doubles import failed_checks
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.make import make_skill
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import approach_impedance
from guiderail_hardware.drivers import fci
from guiderail_hardware.drivers.driver import describe_stop
from guiderail_hardware.drivers.fci import (
    FORCE_THRESHOLD_SHARE,
    MIN_FORCE_THRESHOLD,
    NO_ERRORS,
    FciDriver,
)
from guiderail_hardware.models.joint_status import Fault
from guiderail_hardware.robot.preflight import PreflightChecks, check_robot, confirm_checks
from guiderail_hardware.robot.sim_driver import START
from guiderail_hardware.station import HardwareStation, make_robot_impedance, tool_jacobian
from guiderail_hardware.systems.torque_safety_limiter import ArmState
from oracles.franka import FRANKA_LIMITS

WORKCELL = BncWorkcell()
IMPEDANCE = Impedance().with_max_force(18.0)
READ_PERIOD = 0.0025  # the driver reads twice per period [s]


class FrankyError(Exception):
    """Base class of the client's errors."""


class NetworkError(FrankyError):
    """Error of a lost connection."""


class Affine:
    """Double of the client's transform."""

    def __init__(self, matrix):
        self.matrix = np.array(matrix)


class Robot:
    """Double of the client's robot: it moves with constant joint velocities and records calls of its methods."""

    def __init__(self, positions):
        self.calls, self.errors, self.is_connected, self.motion_error = [], NO_ERRORS, True, None
        self.positions, self.external, self.time = positions, np.zeros(7), 0.0
        self.velocities = np.zeros(7)
        self.can_recover, self.mode, self.tool, self.mass = True, "RobotMode.Idle", np.eye(4), 0.0

    @property
    def state(self):
        if not self.is_connected:
            raise NetworkError
        self.time += READ_PERIOD
        self.positions = self.positions + READ_PERIOD * self.velocities
        return SimpleNamespace(
            q=self.positions,
            dq=self.velocities,
            tau_ext_hat_filtered=self.external,
            time=SimpleNamespace(to_sec=lambda time=self.time: time),
            current_errors=self.errors,
            F_T_NE=Affine(RigidTransform([0.0, 0.0, 0.1]).GetAsMatrix4()),
            F_T_EE=Affine(self.tool),
            m_ee=0.0,
            m_load=self.mass,
            robot_mode=self.mode,
        )

    def recover_from_errors(self):
        if not self.is_connected:
            raise NetworkError
        if self.can_recover:
            self.errors = NO_ERRORS
        return self.can_recover

    def join_motion(self, timeout):
        error, self.motion_error = self.motion_error, None
        if error is not None:
            raise error

    def move(self, motion, asynchronous):
        self.join_motion(None)  # the client raises the error of a motion when the next motion begins
        self.calls.append(("move", (motion,), {}))

    def set_ee(self, matrix):
        self.calls.append(("set_ee", (matrix,), {}))
        self.tool = (RigidTransform([0.0, 0.0, 0.1]) @ RigidTransform(np.reshape(matrix, (4, 4), "F"))).GetAsMatrix4()

    def set_load(self, mass, center, inertia):
        self.calls.append(("set_load", (mass, center, inertia), {}))
        self.mass = mass

    def __getattr__(self, name):
        return lambda *args, **options: self.calls.append((name, args, options))


class Motion(SimpleNamespace):
    """Double of the client's impedance motion."""

    def set_gains(self, gains):
        self.gains = gains

    def set_reference(self, reference):
        self.references = [*getattr(self, "references", []), reference]


def client(robot):
    """Return a double of the module `franky` that connects to `robot`."""

    def connect(url, realtime_config):
        if not robot.is_connected:
            raise NetworkError
        return robot

    return SimpleNamespace(
        Robot=connect,
        RealtimeConfig=SimpleNamespace(Ignore=0),
        NetworkException=NetworkError,
        Exception=FrankyError,
        CartesianReference=lambda target: target.matrix,
        Affine=Affine,
        CartesianImpedanceTrackingMotion=lambda **options: Motion(**options),
        CartesianImpedanceGains=SimpleNamespace,
        PostureTask=lambda *values: values,
        TorqueStopMotion=lambda **options: ("stop", options),
    )


@pytest.fixture(scope="module")
def model():
    return ArmControllerPlant(WORKCELL, "panda")


@pytest.fixture
def robot(model):
    return Robot(model.solve(START, model.posture))


@pytest.fixture
def driver(robot, model):
    driver = FciDriver("192.0.2.1", client=client(robot))
    assert driver.read() is not None
    driver.configure(make_robot_impedance(model, IMPEDANCE))
    return driver


@pytest.mark.parametrize("error", [FrankyError("in motion"), ValueError("mass")])
def test_configure_raises_when_the_robot_refuses(robot, driver, model, error):
    robot.set_collision_behavior = Mock(side_effect=error)
    with pytest.raises(InputError, match="refuses its configuration"):
        driver.configure(make_robot_impedance(model, IMPEDANCE))


def test_configure_reraises_errors_of_the_program(robot, driver, model):
    robot.set_collision_behavior = Mock(side_effect=AttributeError)
    with pytest.raises(AttributeError):
        driver.configure(make_robot_impedance(model, IMPEDANCE))


def motions(robot):
    """Return the motions that the robot was commanded, in order."""
    return [args[0] for name, args, _ in robot.calls if name == "move"]


def test_motion_limits_are_within_the_published_limits():
    limits, published = FciDriver.motion_limits, FRANKA_LIMITS
    assert (np.array(limits.linear + limits.angular) <= np.array(published.linear + published.angular)).all()


def test_status_has_the_opposite_of_the_reported_torque(driver, robot):
    robot.external = np.arange(7.0)
    status = driver.read()
    np.testing.assert_array_equal(status.external_torque, -np.arange(7.0))
    np.testing.assert_array_equal(status.positions, robot.positions)
    assert driver.read().time > status.time


def test_read_returns_none_until_the_robot_answers(robot):
    robot.is_connected = False
    driver = FciDriver("192.0.2.1", client=client(robot))
    assert driver.read() is None
    robot.is_connected = True
    assert driver.read().is_readable


@pytest.mark.parametrize("failure", ["reflex", "connection"])
def test_status_is_malformed_after_a_failure(driver, robot, failure):
    if failure == "reflex":
        robot.errors = "cartesian_reflex"
    else:
        robot.is_connected = False
    assert not driver.read().is_readable
    reason = " (cartesian_reflex)" if failure == "reflex" else ""
    assert describe_stop(Fault.MALFORMED, driver) == Fault.MALFORMED.description + reason


def test_recover_clears_the_error_or_raises(driver, robot):
    robot.errors, robot.can_recover = "cartesian_reflex", False
    with pytest.raises(InputError, match="cannot recover: cartesian_reflex"):
        driver.recover()
    robot.can_recover = True
    driver.recover()
    assert driver.read().is_readable
    robot.recover_from_errors = Mock(side_effect=FrankyError("command rejected"))
    with pytest.raises(InputError, match="cannot recover: command rejected"):
        driver.recover()


def test_motion_continues_after_a_reflex_is_cleared(driver, robot):
    driver.write_pose(RigidTransform(), 0.0)
    robot.motion_error = FrankyError("cartesian_reflex")
    driver.stop()  # no error, although the reflex has ended the motion
    robot.motion_error = FrankyError("cartesian_reflex")
    driver.recover()
    driver.write_pose(RigidTransform(), 0.0)
    assert len(motions(robot)) == 2


@pytest.mark.parametrize("is_noticed", [True, False])
def test_recover_connects_again_and_configures_the_robot(driver, robot, monkeypatch, is_noticed):
    robot.is_connected = False
    assert not is_noticed or not driver.read().is_readable
    monkeypatch.setattr(fci, "RECONNECTION_TIME", 0.0)
    with pytest.raises(InputError, match="does not answer"):
        driver.recover()
    robot.is_connected = True
    robot.calls.clear()
    driver.recover()
    assert driver.read().is_readable
    assert [name for name, *_ in robot.calls] == ["set_ee", "set_load", "set_collision_behavior"]


def test_recover_raises_when_the_connection_is_lost_again(driver, robot, monkeypatch):
    def lose():
        robot.is_connected = False
        raise NetworkError

    monkeypatch.setattr(robot, "recover_from_errors", lose, raising=False)
    monkeypatch.setattr(fci, "RECONNECTION_TIME", 0.0)
    robot.is_connected = False
    driver.read()
    robot.is_connected = True
    with pytest.raises(InputError, match="cannot recover: the connection is lost"):
        driver.recover()
    assert not driver.read().is_readable


@pytest.mark.parametrize("is_noticed", [True, False])
def test_checks_fail_when_the_connection_is_lost(driver, robot, is_noticed):
    robot.is_connected = False
    assert not is_noticed or not driver.read().is_readable
    assert driver.error == ""
    assert [(check.name, check.passed) for check in driver.check_setup()] == [("connection", False)]


def test_configure_raises_nothing_when_the_connection_is_lost(driver, robot, model):
    robot.is_connected = False
    driver.configure(make_robot_impedance(model, IMPEDANCE))
    assert not driver.read().is_readable


def test_angular_limit_allows_the_turn_of_the_connector():
    assert FciDriver.motion_limits.angular[0] / np.sqrt(3.0) > 1.02  # fastest turn of pretrained:connector [rad/s]


def test_configuration_sets_tool_payload_and_thresholds(driver, robot, model):
    calls = {name: args for name, args, _ in robot.calls}
    impedance = make_robot_impedance(model, IMPEDANCE)
    expected = RigidTransform([0.0, 0.0, -0.1]) @ impedance.X_FlangeTool
    np.testing.assert_allclose(calls["set_ee"][0], expected.GetAsMatrix4().ravel("F"), atol=1e-12)
    assert calls["set_load"][0] == pytest.approx(impedance.mass)
    force, torque = (FORCE_THRESHOLD_SHARE * part.max() for part in np.split(impedance.max_wrench, 2))
    assert force > MIN_FORCE_THRESHOLD
    assert calls["set_collision_behavior"][1] == pytest.approx([force] * 3 + [torque] * 3)


def test_collision_thresholds_have_a_minimum_force(robot, model):
    driver = FciDriver("192.0.2.1", client=client(robot))
    assert driver.read() is not None
    driver.configure(make_robot_impedance(model, Impedance().with_max_force(5.0)))
    calls = {name: args for name, args, _ in robot.calls}
    assert calls["set_collision_behavior"][1][:3] == [MIN_FORCE_THRESHOLD] * 3


def test_robot_is_not_configured_during_a_motion(driver, robot, model):
    impedance = make_robot_impedance(model, IMPEDANCE)
    driver.write_pose(RigidTransform(), 0.0)
    number = len(robot.calls)
    driver.configure(impedance)
    assert len(robot.calls) == number
    driver.stop()
    driver.configure(impedance)
    assert [name for name, *_ in robot.calls[number + 1 :]] == ["set_ee", "set_load", "set_collision_behavior"]


@pytest.mark.parametrize(
    ("attribute", "valid", "invalid", "check"),
    [
        ("mode", "RobotMode.Idle", "RobotMode.Guiding", "mode"),
        ("mode", "RobotMode.Idle", "RobotMode.UserStopped", "mode"),
        ("mass", 0.9 * fci.MAX_MASS_ERROR, 1.1 * fci.MAX_MASS_ERROR, "mass"),
        ("tool", 0.9 * fci.MAX_TOOL_ERROR, 1.1 * fci.MAX_TOOL_ERROR, "tool center"),
    ],
)
def test_check_fails_when_the_setup_differs(driver, robot, attribute, valid, invalid, check):
    assert {"reflex", "motion", "kernel"} < {check.name for check in driver.check_setup()}
    configured = getattr(robot, attribute)
    for value, expected in ((valid, []), (invalid, [check])):
        setattr(robot, attribute, value if attribute == "mode" else configured + value)
        assert failed_checks(driver.check_setup()) == expected


def test_spring_deflection_is_bounded_by_the_wrench_limits(driver, robot):
    driver.write_pose(RigidTransform(), 0.0)
    (motion,) = motions(robot)
    limits = np.array(IMPEDANCE.limits)
    np.testing.assert_allclose(motion.translational_error_clip * 1500.0, limits[:3])
    np.testing.assert_allclose(motion.rotational_error_clip * 30.0, limits[3:])
    np.testing.assert_allclose(motion.gains.stiffness, np.diag([1500.0] * 3 + [30.0] * 3))
    assert (np.linalg.eigvalsh(motion.gains.damping + motion.gains.damping.T) > 0.0).all()


def test_poses_update_a_single_motion_until_the_stop(driver, robot):
    for x in (0.1, 0.2):
        driver.write_pose(RigidTransform([x, 0.0, 0.0]), 0.0)
    (motion,) = motions(robot)
    assert [reference[0, 3] for reference in motion.references] == [0.1, 0.2]
    driver.stop()
    driver.stop()
    assert [kind for kind, _ in motions(robot)[1:]] == ["stop"]
    driver.write_pose(RigidTransform(), 0.0)
    assert isinstance(motions(robot)[2], Motion)


def test_methods_raise_before_the_first_status(robot, model):
    driver = FciDriver("192.0.2.1", client=client(robot))
    for call in (driver.check_setup, lambda: driver.write_pose(RigidTransform(), 0.0)):
        with pytest.raises(InputError, match="before it is configured"):
            call()
    for call in (lambda: driver.configure(make_robot_impedance(model, IMPEDANCE)), driver.recover):
        with pytest.raises(InputError, match="the driver fci is used before it has read a status"):
            call()


def test_write_refuses_torques(driver):
    with pytest.raises(InputError, match="poses, not torques"):
        driver.write(np.zeros(7), 0.0)


def test_impedance_raises_when_target_and_base_axes_differ(model):
    class RotatedWorkcell(BncWorkcell):
        @property
        def X_WT(self):
            return super().X_WT @ RigidTransform(np.diag([-1.0, -1.0, 1.0, 1.0]))

    with pytest.raises(InputError, match="axes of its base"):
        make_robot_impedance(ArmControllerPlant(RotatedWorkcell(), "panda"), IMPEDANCE)


class Loop:
    """Hardware station on the driver and the double, advanced in steps of its period."""

    def __init__(self, robot):
        self.driver = FciDriver("192.0.2.1", client=client(robot))
        self.station = HardwareStation(WORKCELL, self.driver, IMPEDANCE, robot="panda")
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.command(START)
        self.station.start(self.simulator)
        self.time = 0.0

    def command(self, pose):
        self.station.get_desired_pose_input_port().FixValue(self.context, pose)

    def advance(self, seconds):
        for _ in range(round(seconds / self.station.period)):
            self.station.receive(self.context)
            self.time += self.station.period
            self.simulator.AdvanceTo(self.time)

    @property
    def arm_state(self):
        return ArmState(int(self.station.get_arm_state_output_port().Eval(self.context)[0]))


def test_station_sends_poses_that_begin_at_the_measured_pose(robot):
    loop = Loop(robot)
    loop.advance(0.1)
    assert not motions(robot)  # nothing is sent during the settling time
    loop.advance(1.0)
    assert loop.arm_state == ArmState.RUNNING
    (motion,) = motions(robot)
    expected = WORKCELL.X_WT @ RigidTransform([0.0, 0.0, START[2]])
    np.testing.assert_allclose(motion.references[0][:3, 3], expected.translation(), atol=1e-4)
    step = 0.9 * IMPEDANCE.limits[0] / IMPEDANCE.stiffness[0]  # within the bound of a robot that does not move
    loop.command(START + [step, 0.0, 0.0, 0.0, 0.0, 0.0])
    loop.advance(0.5)
    positions = np.array([reference[:3, 3] for reference in motion.references])
    np.testing.assert_allclose(positions[-1] - positions[0], [step, 0.0, 0.0], atol=1e-6)
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1).max() / loop.station.period
    assert 0.0 < speed <= FciDriver.motion_limits.linear[0]


@pytest.mark.parametrize(("share", "is_pushed"), [(0.5, True), (1.5, False)])
def test_robot_is_not_pushed_above_the_approach_speed(robot, share, is_pushed):
    """The force bounds the speed by F / c; see `docs/concepts/forces.md`."""
    loop = Loop(robot)
    loop.command(START - [0.0, 0.0, 0.05, 0.0, 0.0, 0.0])
    loop.advance(1.0)
    model, bound = loop.station.controller_plant, IMPEDANCE.bound
    J, context = tool_jacobian(model, robot.positions, model.target), model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, robot.positions)
    direction = np.array([0.0, 0.0, 0.0, 0.0, 0.0, -1.0])
    mass = 1.0 / (direction @ J @ np.linalg.solve(model.plant.CalcMassMatrix(context), J.T @ direction))
    speed = share * bound.force / approach_impedance(bound.contact_stiffness, mass)
    robot.velocities = np.linalg.pinv(J) @ (speed * direction)
    loop.advance(4 * loop.station.period)
    assert loop.arm_state == ArmState.RUNNING
    model.plant.SetPositions(context, robot.positions)
    below = (model.tool_center.CalcPoseInWorld(context).translation() - motions(robot)[0].references[-1][:3, 3])[2]
    gains = make_robot_impedance(model, IMPEDANCE)
    force = gains.stiffness[2, 2] * below - gains.damping[2, 2] * speed
    assert (force > 1.0) == is_pushed


def test_force_limit_that_an_action_changes_is_refused(robot, monkeypatch):
    """The bound of the robot's own controller is constant."""
    assert not Loop(robot).station.HasInputPort("max_wrench")
    monkeypatch.setattr(fci, "import_extra", lambda name: client(robot))
    options = {"station": "hardware", "driver": "fci", "robot": "panda", "robot_url": "192.0.2.1", "guidance": "kgrl"}
    with pytest.raises(InputError, match=r"force_limit_range changes .* not \(8\.0, 25\.0\)"):
        make_skill("BncConnector", lambda observation: np.zeros(2), force_limit_range=(8.0, 25.0), **options)
    skill = make_skill("BncConnector", lambda observation: np.zeros(2), force_limit_range=(12.0, 12.0), **options)
    limits = skill.diagram.GetSubsystemByName("station").impedance.limits
    assert limits == Impedance().with_max_force(12.0).limits


def test_station_stops_the_robot_after_a_reflex(robot):
    loop = Loop(robot)
    loop.advance(1.0)
    robot.errors = "cartesian_reflex"
    loop.advance(0.1)
    assert loop.arm_state == ArmState.DAMPING
    assert motions(robot)[-1][0] == "stop"
    assert Fault(int(loop.station.get_fault_output_port().Eval(loop.context)[0])) == Fault.MALFORMED


class LoopClock:
    """Clock that advances a station in steps of its period, without waiting."""

    check_robot = None

    def begin(self):
        pass

    def advance(self, simulator, station, steps):
        for _ in range(steps):
            station.receive(simulator.get_mutable_context())
            simulator.AdvanceTo(simulator.get_context().get_time() + station.period)


def test_existing_error_is_cleared_only_when_confirmed(robot, monkeypatch):
    station = Loop(robot).station
    robot.errors = "cartesian_reflex"
    checks, questions, lines = PreflightChecks(station, LoopClock(), START, 4), [], []
    with pytest.raises(InputError, match="reports cartesian_reflex: look at it"):
        confirm_checks(checks, lines.append, assume_yes=True)
    assert (robot.errors, lines) == ("cartesian_reflex", [])
    monkeypatch.setattr("guiderail_hardware.robot.preflight.confirm", questions.append)
    confirm_checks(checks, lines.append, assume_yes=False)
    assert questions[0].startswith("The robot reports cartesian_reflex")
    assert robot.errors == NO_ERRORS
    assert not any(line.startswith("NOT") for line in lines)


def test_torque_check_compares_the_full_force_with_the_limits(robot):
    loop = Loop(robot)
    loop.advance(1.0)
    (check,) = (check for check in check_robot(loop.station, loop.context, START, 0) if check.name == "torques")
    torques = loop.station.max_torque_shares(robot.positions) * loop.station.limits.torque
    share = (torques / loop.station.limits.external_torque).max()
    assert f"takes {share:.0%} of the nearest limit" in check.description
    assert "external torques of (16.0, 16.0, 14.4" in check.description
