"""A driver that raises exceptions or returns wrong objects: a moving arm is damped to rest nevertheless."""

from copy import deepcopy
from dataclasses import replace
from functools import partial
from typing import ClassVar

import numpy as np
import pytest
from direct_driver import START, DirectDriver, start_station
from hardware_doubles import unplugged
from pydrake.systems.analysis import InitializeParams, Simulator

from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers.clock import WallClock
from guiderail_hardware.drivers.driver import PoseDriver, describe_stop, safety_limits
from guiderail_hardware.models.joint_status import MALFORMED_STATUS, Fault, Heartbeat, JointStatus
from guiderail_hardware.station import HardwareStation
from guiderail_hardware.systems.torque_safety_limiter import ArmState

DAMPING_STEPS = 60  # steps in which the arm is damped to rest
PERIOD = DirectDriver.period


class NoisyDriver(DirectDriver):
    """Robot with noise in its velocities, because constant velocities would count as frozen."""

    is_repeating = False  # while `write` fails, the robot repeats the last torque

    def read(self):
        status = super().read()
        return replace(status, velocities=status.velocities + 1e-9 * (-1) ** round(self.time / self.period))

    def elapse(self):
        if self.is_repeating:
            DirectDriver.write(self, self.torques.pop(), self.time)
        super().elapse()


class MovingArm:
    """Arm that a station moves at about 0.3 rad/s; each type of driver is started once, and restored in later tests."""

    started: ClassVar[dict] = {}

    def __init__(self, driver_type=NoisyDriver):
        if driver_type not in self.started:
            self.start(driver_type())
            driver, guard = vars(self.driver), vars(self.driver.guard)
            saved = {**driver, "torques": [*driver["torques"]]}, deepcopy({**guard, "_driver": None})
            self.started[driver_type] = (
                self.station,
                self.driver,
                self.simulator.get_context().Clone(),
                self.step,
                saved,
            )
        self.station, self.driver, context, self.step, (driver, guard) = self.started[driver_type]
        vars(self.driver).clear()
        vars(self.driver).update({**driver, "torques": [*driver["torques"]]})
        vars(self.driver.guard).update({**deepcopy(guard), "_driver": self.driver})
        self.simulator = Simulator(self.station, context.Clone())
        self.simulator.Initialize(InitializeParams(suppress_initialization_events=True))  # these would stop the arm
        self.context = self.simulator.get_mutable_context()
        self.num_torques = len(self.driver.torques)

    def start(self, driver):
        self.driver = driver
        limits = replace(safety_limits(driver.model.plant, driver), ramp_time=0.1)
        self.station = HardwareStation(BncWorkcell(), driver, limits=limits)
        self.simulator = Simulator(self.station)
        self.context = self.simulator.get_mutable_context()
        self.step = 0
        desired_pose = self.station.get_desired_pose_input_port()
        desired_pose.FixValue(self.context, START)
        self.station.start(self.simulator)
        self.advance(30)  # longer than the ramp of the torques
        desired_pose.FixValue(self.context, START + [0.03, 0.0, 0.03, 0.0, 0.0, 0.0])
        self.advance(50)
        assert self.speed > 0.2

    def advance(self, steps=1):
        for _ in range(steps):
            self.step += 1
            self.driver.elapse()
            self.simulator.AdvancePendingEvents()
            self.station.receive(self.context)
            self.simulator.AdvanceTo(self.step * PERIOD)

    @property
    def speed(self):
        return np.abs(self.driver.velocities).max()

    @property
    def fault(self):
        return Fault(int(self.station.get_fault_output_port().Eval(self.context)[0]))

    @property
    def arm_state(self):
        return ArmState(int(self.station.get_arm_state_output_port().Eval(self.context)[0]))

    @property
    def torques(self):
        return self.driver.torques[self.num_torques :]


def exit_program(*arguments):
    raise SystemExit(3)


def change_statuses(driver, change):
    """Apply a function to every status that a driver returns."""
    read = driver.read
    driver.read = lambda: change(read())


# Changes of a status, and the expected faults; `test_joint_status.py` has all invalid fields.
STATUSES = {
    "text": (lambda status: replace(status, positions=["a"] * 7), Fault.MALFORMED),
    "scalar": (lambda status: JointStatus(status.time, 0.0, 0.0, 0.0), Fault.WRONG_SIZE),
    "array as time": (lambda status: replace(status, time=np.zeros(2)), Fault.MALFORMED),
    "dictionary": (lambda status: {"time": status.time}, Fault.MALFORMED),
    "no status": (lambda status: None, Fault.NO_STATUS),
}
METHODS = ("read", "receive", "read_heartbeats")


@pytest.mark.parametrize("name", STATUSES)
def test_arm_is_damped_when_a_status_is_malformed(name):
    change, fault = STATUSES[name]
    arm = MovingArm()
    change_statuses(arm.driver, change)
    arm.advance(DAMPING_STEPS)
    assert (arm.fault, arm.arm_state) == (fault, ArmState.OFF)
    assert arm.speed < 0.05
    assert len(arm.torques) >= 40


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("fail", [unplugged, exit_program])
def test_arm_is_damped_when_a_read_raises(method, fail):
    arm = MovingArm()
    setattr(arm.driver, method, fail)
    arm.advance(DAMPING_STEPS)
    assert (arm.fault, arm.arm_state) == (Fault.MALFORMED, ArmState.OFF)
    assert arm.speed < 0.05
    assert len(arm.torques) >= 40
    reason = "OSError: cable unplugged" if fail is unplugged else "SystemExit: 3"
    assert describe_stop(arm.fault, arm.driver) == f"{Fault.MALFORMED.description} ({method} raised {reason})"


@pytest.mark.parametrize(
    ("method", "replacement"),
    [*((method, unplugged) for method in METHODS)]
    + [("read_heartbeats", lambda value=value: value) for value in (None, 3, ["heartbeat"])],
)
def test_arm_is_damped_after_a_single_failure(method, replacement):
    arm = MovingArm()
    setattr(arm.driver, method, replacement)
    arm.advance()
    delattr(arm.driver, method)
    arm.advance(DAMPING_STEPS)
    assert (arm.fault, arm.arm_state) == (Fault.MALFORMED, ArmState.OFF)
    assert arm.speed < 0.05


def test_guard_returns_the_heartbeats_of_the_driver():
    driver, heartbeat = DirectDriver(), Heartbeat(1, False)
    driver.read_heartbeats = lambda: [heartbeat]
    assert driver.guard.read_heartbeats() == (heartbeat,)


def test_round_trip_is_measured_when_a_heartbeat_reports_the_command():
    guard = DirectDriver().guard
    guard.write(np.zeros(7), 1.0)
    assert np.isnan(guard.measure_round_trip((Heartbeat(1, False),), 0.005))
    assert guard.measure_round_trip((Heartbeat(2, False, command=1_000_000),), 0.015) == pytest.approx(0.015)


def test_round_trip_counts_periods_without_a_clock():
    guard = DirectDriver().guard
    guard.write(np.zeros(7), 1.0)
    guard.measure_round_trip((Heartbeat(1, False),), None)
    assert guard.measure_round_trip((Heartbeat(2, False, command=1_000_000),), None) == pytest.approx(2 * PERIOD)


def test_round_trip_does_not_grow_while_the_monitor_is_silent():
    guard, heartbeats = DirectDriver().guard, (Heartbeat(2, False, command=1_000_000),)
    guard.write(np.zeros(7), 1.0)
    guard.measure_round_trip(heartbeats, 0.01)
    guard.write(np.zeros(7), 1.005)
    assert {guard.measure_round_trip(heartbeats, time) for time in (0.02, 0.03, 0.04, 0.05, 0.06)} == {0.01}


def test_arrival_of_a_failed_command_is_not_awaited():
    driver = DirectDriver()
    driver.write = unplugged
    assert not driver.guard.write(np.zeros(7), 1.0)
    assert np.isnan(driver.guard.measure_round_trip((Heartbeat(2, False, command=1_000_000),), 0.01))


@pytest.mark.parametrize(
    ("fail", "failures", "is_repeating"),
    [
        (exit_program, 5, False),
        *((unplugged, failures, False) for failures in (1, 20, 38, 60)),
        *((unplugged, failures, True) for failures in (5, 38, 60)),
    ],
)
def test_arm_is_damped_when_commands_fail(fail, failures, is_repeating):
    """When commands can be sent again, the arm is damped for the full 40 steps."""
    arm = MovingArm()
    arm.driver.write, arm.driver.is_repeating = fail, is_repeating
    arm.advance(failures)
    del arm.driver.write
    arm.driver.is_repeating, speed = False, arm.speed
    assert len(arm.torques) == 0
    for _ in range(DAMPING_STEPS):
        arm.advance()
        assert arm.speed <= speed + 0.01
    assert (arm.fault, arm.arm_state) == (Fault.COMMAND_FAILED, ArmState.OFF)
    assert arm.speed < 0.03
    assert arm.driver.guard.num_failed_commands == failures
    assert describe_stop(arm.fault, arm.driver).startswith("a command could not be sent to the robot (write raised ")


@pytest.mark.parametrize(("failures", "max_speed"), [(1, 0.05), (5, 0.1), (15, 0.2)])
def test_arm_is_damped_when_reads_and_commands_fail(failures, max_speed):
    """For 20 steps, the velocity is predicted from the torques that were sent."""
    arm = MovingArm()
    arm.driver.write = arm.driver.read = unplugged
    arm.advance(failures)
    del arm.driver.write
    for _ in range(DAMPING_STEPS):
        speed = arm.speed
        arm.advance()
        assert arm.speed <= speed + 1e-3
    assert arm.arm_state == ArmState.OFF
    assert arm.speed < max_speed


def test_first_fault_remains_when_a_later_command_fails():
    arm = MovingArm()
    arm.station.stop(arm.context)
    arm.driver.write = unplugged
    arm.advance(DAMPING_STEPS)
    assert (arm.fault, arm.arm_state) == (Fault.USER_STOP, ArmState.OFF)


class HoldingDriver(NoisyDriver):
    """Driver of a robot that can hold its position by itself."""

    can_hold = True


@pytest.mark.parametrize("hold", [unplugged, lambda: False], ids=["raises", "refuses"])
def test_arm_is_damped_when_hold_fails(hold):
    arm = MovingArm(HoldingDriver)
    arm.driver.hold = hold
    change_statuses(arm.driver, lambda status: MALFORMED_STATUS)
    arm.advance(DAMPING_STEPS)
    assert (arm.fault, arm.arm_state) == (Fault.MALFORMED, ArmState.OFF)
    assert arm.speed < 0.05


def test_arm_is_not_damped_when_hold_succeeds():
    arm, holds = MovingArm(HoldingDriver), []
    arm.driver.hold = partial(holds.append, True)
    change_statuses(arm.driver, lambda status: MALFORMED_STATUS)
    arm.advance(5)
    assert len(holds) == 5
    np.testing.assert_array_equal(arm.torques, np.zeros((1, 7)))  # before the driver holds the arm


def test_zero_torque_is_sent_once_after_each_torque_before_a_hold():
    """A driver that does not hold the arm would repeat its last torque."""
    driver = HoldingDriver()
    driver.hold, torques = lambda: True, []
    driver.write = lambda torque, time: torques.append(torque)
    for torque in (2.0, 3.0):
        driver.guard.write(np.full(7, torque), 0.0)
        driver.guard.hold()
        driver.guard.hold()
    np.testing.assert_array_equal(torques, np.outer([2.0, 0.0, 3.0, 0.0], np.ones(7)))


def test_refusal_to_hold_is_reported_once():
    driver = HoldingDriver()
    driver.hold = lambda: False
    driver.guard.hold()
    assert [driver.guard.take_refusal(), driver.guard.take_refusal()] == [True, False]


@pytest.mark.parametrize("answer", [True, None])
def test_arm_is_damped_when_hold_has_no_effect(answer):
    arm = MovingArm(HoldingDriver)
    arm.driver.hold = lambda: answer
    read = arm.driver.read
    arm.driver.read = lambda: MALFORMED_STATUS
    arm.advance()
    arm.driver.read = read
    arm.advance(round(0.1 / PERIOD) - 1)
    assert (arm.fault, arm.arm_state) == (Fault.MALFORMED, ArmState.DAMPING)
    assert arm.speed < 0.15
    arm.advance(DAMPING_STEPS)
    assert (arm.arm_state, arm.speed < 0.05) == (ArmState.OFF, True)


@pytest.mark.parametrize("method", ["read", "receive"])
def test_take_over_does_not_wait_when_a_read_fails(method):
    """`start` would wait for the robot, or raise an error, while the arm moves."""
    arm = MovingArm()
    if method == "read":
        arm.driver.read = lambda: None
    else:
        arm.driver.receive = unplugged
    station = arm.station.clone(BncWorkcell())
    simulator = Simulator(station)
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), np.full(6, np.nan))
    station.take_over(simulator, arm.station, arm.context)
    arm.station, arm.simulator, arm.context, arm.step = station, simulator, simulator.get_mutable_context(), 0
    arm.advance(DAMPING_STEPS)
    assert arm.fault == (Fault.NO_STATUS if method == "read" else Fault.MALFORMED)
    assert arm.speed < 0.05


@pytest.mark.parametrize("method", METHODS)
def test_start_raises_when_a_read_raises(method):
    driver = DirectDriver()
    station = HardwareStation(BncWorkcell(), driver)
    setattr(driver, method, unplugged)
    simulator = Simulator(station)
    station.get_desired_pose_input_port().FixValue(simulator.get_mutable_context(), START)
    message = f"no status can be read from the driver direct: {method} raised OSError: cable unplugged"
    with pytest.raises(InputError, match=message):
        station.start(simulator)
    delattr(driver, method)
    station.start(simulator)  # succeeds, because the errors have been cleared


def test_wall_clock_steps_when_receiving_raises():
    driver = DirectDriver()
    (station, simulator), clock = start_station(driver), WallClock(driver)
    calls = []

    def receive(timeout=0.0):
        calls.append(timeout)
        unplugged()

    driver.receive = receive
    clock.begin()
    clock.advance(simulator, station, 3)
    assert simulator.get_context().get_time() == 3 * driver.period
    assert len(calls) < 20  # `receive` is not called in a busy loop


@pytest.mark.parametrize(("arguments", "timeout", "wait"), [((), 0.0, 0.0), ((1.0,), 1.0, PERIOD)])
def test_receive_waits_for_at_most_a_period_when_it_raises(monkeypatch, arguments, timeout, wait):
    driver, timeouts, waits = DirectDriver(), [], []
    monkeypatch.setattr("time.sleep", waits.append)
    driver.receive = lambda timeout: timeouts.append(timeout) or unplugged()
    driver.guard.receive(*arguments)
    assert (timeouts, waits) == ([timeout], [wait])


def test_describe_stop_names_an_exception_after_a_valid_status():
    """The fault of a single failure remains while later statuses are valid."""
    driver = NoisyDriver()
    driver.receive = unplugged
    driver.guard.receive()
    assert driver.guard.read() is MALFORMED_STATUS
    assert driver.guard.read() is not MALFORMED_STATUS
    assert describe_stop(Fault.MALFORMED, driver).endswith("(receive raised OSError: cable unplugged)")


def test_describe_stop_names_an_exception_of_error():
    class DriverWithoutError(DirectDriver):
        error = property(unplugged)

    assert describe_stop(Fault.STALE, DriverWithoutError()).endswith("(error raised OSError: cable unplugged)")
    assert describe_stop(Fault.STALE, DirectDriver()) == Fault.STALE.description


def test_describe_stop_omits_the_exception_of_an_older_status():
    driver = DirectDriver()
    driver.read = unplugged
    assert driver.guard.read() is MALFORMED_STATUS
    driver.read = lambda: "status"
    assert driver.guard.read() is MALFORMED_STATUS
    assert describe_stop(Fault.MALFORMED, driver) == Fault.MALFORMED.description


def test_recover_raises_one_error_for_any_exception():
    driver = DirectDriver()
    driver.recover = unplugged
    with pytest.raises(InputError, match="the driver direct failed: recover raised OSError: cable unplugged"):
        driver.guard.recover()

    def refuse():
        raise InputError("the error persists")

    driver.recover = refuse
    with pytest.raises(InputError, match="the error persists"):
        driver.guard.recover()


def test_recover_forgets_errors():
    driver = DirectDriver()
    driver.receive = unplugged
    driver.guard.receive()
    with pytest.raises(InputError, match="no status can be read"):
        driver.guard.check_readable()
    driver.recover = lambda: None
    driver.guard.recover()
    driver.guard.check_readable()


def test_heartbeat_is_sent_and_its_exception_is_a_failure():
    driver, heartbeats = DirectDriver(), []
    driver.write_heartbeat = heartbeats.append
    driver.guard.write_heartbeat(Heartbeat(1, False))
    assert (heartbeats, driver.guard.take_failure()) == ([Heartbeat(1, False)], False)
    driver.write_heartbeat = unplugged
    driver.guard.write_heartbeat(Heartbeat(2, False))
    assert driver.guard.take_failure()


@pytest.mark.parametrize("method", ["configure", "write_pose", "stop"])
def test_pose_command_that_raises_is_reported_once(method):
    class FailingPoseDriver(PoseDriver):
        name = "poses"
        configure = write_pose = stop = read = unplugged

    guard = FailingPoseDriver().guard
    getattr(guard, method)(*[None] * {"configure": 1, "write_pose": 2, "stop": 0}[method])
    assert guard.command_error == f"{method} raised OSError: cable unplugged"
    assert [guard.take_failure(), guard.take_failure()] == [True, False]


def test_forget_errors_clears_failure_and_recovery():
    driver = NoisyDriver()
    guard = driver.guard
    for _ in range(2):
        assert (guard.take_failure(), guard.take_recovery()) == (False, False)
        driver.write = lambda torque, time: 1 / 0
        guard.write(np.zeros(7), 0.0)
        guard.forget_errors()
        del driver.write
        guard.write(np.zeros(7), 0.0)
        guard.receive()
        assert guard.read() is not MALFORMED_STATUS
    assert (guard.take_failure(), guard.take_recovery()) == (False, False)
    assert (guard.has_torque, guard.take_refusal()) == (True, False)
    driver.hold = lambda: False
    assert (guard.hold(), guard.has_torque) == (False, False)
    guard.forget_errors()
    assert (guard.has_torque, guard.take_refusal()) == (True, False)
