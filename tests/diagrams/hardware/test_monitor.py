"""Safety monitor on a bus in memory, by a clock of the test."""

from dataclasses import replace

import numpy as np
import pytest
from drake import lcmt_iiwa_status
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.hardware.driver import safety_limits, torque_tolerance
from guiderail.diagrams.hardware.lcm import HEARTBEAT_FORMAT, IiwaDriver
from guiderail.diagrams.hardware.monitor import MAX_REPEATS, MonitorState, SafetyMonitor
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES, Fault, JointStatus, damping_torque
from guiderail.systems.support.drake_multibody import JointDynamics
from guiderail.systems.torque_safety_limiter import ZERO_TORQUE_TIME

PERIOD = IiwaDriver.period
MOVING = np.array([0.3, -0.2, 0.1, 0.2, 0.05, 0.1, -0.1])
PUSH = np.array([0.5, 0.4, 0.5, 0.3, 0.1, 0.1, 0.1])
NAMES = lcmt_iiwa_status.__slots__[2:]


@pytest.fixture(scope="module")
def arm():
    return ArmControllerPlant(BncWorkcell())


class Bus:
    """Bus with a simulated robot, a safety monitor, and records of the monitor's commands and heartbeats."""

    def __init__(self, arm, velocity=MOVING):
        self.lcm, self.step, self.commands, self.heartbeats = DrakeLcm("memq://"), 0, [], []
        self.plant, self.dynamics = arm.plant, JointDynamics(arm.plant)
        self.context = self.plant.CreateDefaultContext()
        self.limits = safety_limits(arm.plant, IiwaDriver)
        self.positions, self.velocities, self.torque = np.full(7, 0.2), np.array(velocity), np.zeros(7)
        self.clock = self.offset = 0.0
        self.monitor = SafetyMonitor(IiwaDriver(self.lcm), arm.plant, self.limits, clock=lambda: self.now)
        self.lcm.Subscribe("IIWA_COMMAND", self.record_command)
        self.lcm.Subscribe(IiwaDriver.heartbeat_channel(), self.heartbeats.append)

    @property
    def now(self):
        return 7.0 + self.step * PERIOD

    @property
    def is_stopping(self):
        return HEARTBEAT_FORMAT.unpack(self.heartbeats[-1])[1]

    def record_command(self, message):
        command = IiwaDriver.decode_command(message)
        if command is not None and len(command[0]) == 7:
            self.torque = command[0]
            self.commands.append(self.torque)

    def go(self, steps=1, status=True, command=False, **changed):
        """Advance the robot, send its status (or another message, or none), and possibly a command."""
        for _ in range(steps):
            self.step += 1
            self.plant.SetPositionsAndVelocities(self.context, [*self.positions, *self.velocities])
            M, drag = self.dynamics.evaluate(self.context)
            self.velocities = self.velocities + PERIOD * np.linalg.solve(M, self.torque - drag)
            self.positions = self.positions + PERIOD * self.velocities
            message = lcmt_iiwa_status()
            message.utime, message.num_joints = round((100.0 + self.step * PERIOD) * 1e6), 7
            for name in NAMES:
                setattr(message, name, [0.0] * 7)
            message.joint_position_measured = self.positions.tolist()
            message.joint_velocity_estimated = self.velocities.tolist()
            for name, value in changed.items():
                setattr(message, name, value)
            if status:
                self.lcm.Publish("IIWA_STATUS", message.encode() if status is True else status)
            self.monitor.receive()
            if command:
                self.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(PUSH, self.now))
            self.settle()

    def settle(self):
        for _ in range(100):
            if not self.lcm.HandleSubscriptions(0):
                return
        raise AssertionError("messages answer each other without end")

    def watch(self):
        """Command the arm until the monitor accepts its statuses."""
        self.go(100)
        self.go(10, command=True)
        assert (self.monitor.state, self.monitor.fault) == (MonitorState.WATCHING, Fault.NONE)
        assert not self.is_stopping
        self.commands.clear()
        return self

    @property
    def speed(self):
        return np.abs(self.velocities).max()


def test_monitor_damps_then_rests_when_commands_stop(arm):
    bus = Bus(arm).watch()
    bus.go(MAX_MISSED_MESSAGES)
    assert bus.commands == []
    moving = bus.speed
    bus.go(1)
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.DAMPING, True)
    bus.go(20)
    assert bus.speed < 0.02 * moving
    bus.go(round(bus.limits.damping_time / PERIOD) - 20)
    assert bus.monitor.state == MonitorState.RESTING
    np.testing.assert_array_equal(bus.commands[-1], 0.0)
    bus.go(round(ZERO_TORQUE_TIME / PERIOD) - 1)
    assert bus.monitor.state == MonitorState.RESTING
    bus.go(2)
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.IDLE, False)
    count = len(bus.commands)
    bus.go(20)
    assert len(bus.commands) == count


def test_damping_torque_is_clipped_to_its_limits(arm):
    bus = Bus(arm, velocity=5.0 * MOVING).watch()
    bus.go(MAX_MISSED_MESSAGES + 1)
    assert (np.abs(bus.commands[-1]) <= np.array(bus.limits.torque)).all()
    assert np.isclose(np.abs(bus.commands[-1]), bus.limits.torque).any()


def test_monitor_finishes_damping_when_commands_return(arm):
    bus = Bus(arm).watch()
    bus.go(MAX_MISSED_MESSAGES + 1)
    bus.go(5, command=True)
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.DAMPING, True)


def test_monitor_is_idle_without_a_torque_to_stop(arm):
    bus = Bus(arm)
    bus.go(50)
    assert bus.monitor.state == MonitorState.IDLE
    bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.zeros(7), 0.0))
    bus.settle()
    bus.commands.clear()
    assert bus.monitor.state == MonitorState.WATCHING
    bus.go(1, joint_velocity_estimated=[np.nan] * 7)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.WATCHING, Fault.NOT_FINITE)
    bus.go(50)
    assert (bus.monitor.state, bus.commands) == (MonitorState.IDLE, [])


FAULTY = {
    "NaN in a velocity": ({"joint_velocity_estimated": [np.nan] * 7}, Fault.NOT_FINITE),
    "NaN in an external torque": ({"joint_torque_external": [np.nan, *[0.0] * 6]}, Fault.NOT_FINITE),
    "wrong joint count": ({"num_joints": 3} | {name: [0.0] * 3 for name in NAMES}, Fault.WRONG_SIZE),
    "position jump": ({"joint_position_measured": [1.0] * 7}, Fault.POSITION_JUMP),
    "velocity jump": ({"joint_velocity_estimated": [2.0] * 7}, Fault.VELOCITY_JUMP),
    "frozen time stamp": ({"utime": 100_500_000}, Fault.OUT_OF_ORDER),
    "clock from zero": ({"utime": 1000}, Fault.OUT_OF_ORDER),
    "clock ahead": ({"utime": 900_000_000}, Fault.FUTURE),
}


@pytest.mark.parametrize("name", FAULTY)
def test_monitor_stops_the_arm_when_a_status_is_wrong(arm, name):
    """And while it stays wrong, although the commanding program goes on, it never repeats a torque."""
    bus, (changed, fault) = Bus(arm).watch(), FAULTY[name]
    moving = bus.speed
    bus.go(1, command=True, **changed)
    assert (bus.monitor.state, bus.monitor.fault, bus.is_stopping) == (MonitorState.DAMPING, fault, True)
    for _ in range(20):
        bus.go(1, **changed)
        assert bus.speed < 1.1 * moving
    assert bus.speed < 0.15
    bus.go(round(bus.limits.damping_time / PERIOD) + 1, **changed)
    np.testing.assert_array_equal(bus.commands[-1], 0.0)
    assert bus.speed < 0.15


@pytest.mark.parametrize("message", [bytes(range(100)), b"\x00"])
def test_monitor_stops_the_arm_when_a_status_cannot_be_decoded(arm, message):
    bus = Bus(arm).watch()
    bus.go(1, status=message)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.DAMPING, Fault.MALFORMED)


def test_monitor_stops_the_arm_when_statuses_stop(arm):
    """By its own clock; torques are sent without any status, and become zero."""
    bus = Bus(arm).watch()
    bus.go(MAX_MISSED_MESSAGES + 1, status=False, command=True)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.DAMPING, Fault.STALE)
    bus.go(round(bus.limits.damping_time / PERIOD) + 1, status=False)
    np.testing.assert_array_equal(bus.commands[-1], 0.0)
    assert bus.speed < 0.15


def test_monitor_ignores_commands_of_another_size(arm):
    bus = Bus(arm).watch()
    for _ in range(MAX_MISSED_MESSAGES + 1):
        bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.ones(3), bus.now))
        bus.lcm.Publish("IIWA_COMMAND", bytes(range(60)))
        bus.go(1)
    assert bus.monitor.state == MonitorState.DAMPING


def test_monitor_drops_reordered_statuses(arm):
    bus = Bus(arm).watch()
    old = round((100.0 + (bus.step - 1) * PERIOD) * 1e6)
    bus.go(1, command=True, utime=old)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.WATCHING, Fault.NONE)


def contend(bus, steps, torque, clock=0.0):
    """Let a second program send torques after each command of the first; return what the robot did in between."""
    for _ in range(steps):
        bus.go(1, command=True)
        bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(torque, bus.now + clock))
        bus.settle()


@pytest.mark.parametrize("torque", [0.001 * PUSH, -PUSH], ids=["small", "negated"])
@pytest.mark.parametrize("clock", [0.0, -5.0, 300.0])
def test_monitor_stops_the_arm_when_two_programs_command(arm, torque, clock):
    bus = Bus(arm).watch()
    contend(bus, 3, torque, clock)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.DAMPING, Fault.SECOND_COMMANDER)
    contend(bus, 20, torque, clock)
    assert bus.speed < 0.02
    contend(bus, 100, torque, clock)  # the robot obeys the monitor's zero torque as long as both command
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.RESTING, True)
    np.testing.assert_array_equal(bus.torque, 0.0)
    bus.go(round(IiwaDriver.hold_off / PERIOD) + 3, command=True)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.WATCHING, Fault.NONE)


def test_monitor_repeats_its_torque_twice_between_checks(arm):
    bus = Bus(arm).watch()
    bus.go(MAX_MISSED_MESSAGES + 1)
    bus.commands.clear()
    for torque in (1.0, 2.0, 3.0, 4.0):
        bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.full(7, torque), bus.now))
        bus.settle()
    assert len(bus.commands) == 4 + 2


def test_two_monitors_stop_the_arm_and_go_on(arm):
    """Each one repeats its torque after a command, but not after the other one's without end."""
    bus = Bus(arm)
    other = SafetyMonitor(IiwaDriver(bus.lcm), arm.plant, bus.limits, clock=lambda: bus.now)

    def go(steps, command=True, **changed):
        for _ in range(steps):
            bus.go(1, command=command, **changed)
            other.receive()
            bus.settle()
        return [(monitor.state, monitor.fault) for monitor in (bus.monitor, other)]

    go(100, command=False)
    assert go(10) == [(MonitorState.WATCHING, Fault.NONE)] * 2
    bus.commands.clear()
    assert go(1, joint_velocity_estimated=[np.nan] * 7) == [(MonitorState.DAMPING, Fault.NOT_FINITE)] * 2
    go(20)
    assert len(bus.commands) <= 21 * (1 + 2 * (1 + MAX_REPEATS))
    assert bus.speed < 0.02
    assert go(200) == [(MonitorState.WATCHING, Fault.NONE)] * 2


def test_monitor_announces_its_commands_by_a_heartbeat(arm):
    bus, order = Bus(arm).watch(), []
    bus.lcm.Subscribe("IIWA_COMMAND", lambda message: order.append("command"))
    bus.lcm.Subscribe(IiwaDriver.heartbeat_channel(), lambda message: order.append(bus.is_stopping))
    bus.go(MAX_MISSED_MESSAGES + 1)
    assert order[-2:] == [True, "command"]


def test_monitors_heartbeats_have_its_number(arm):
    first, second = Bus(arm), Bus(arm)
    first.go(3)
    second.go(1)
    sent = [HEARTBEAT_FORMAT.unpack(message) for message in first.heartbeats]
    assert [sequence for sequence, _, _ in sent] == [1, 2, 3]
    assert len({sender for _, _, sender in sent}) == 1
    assert sent[0][2] != HEARTBEAT_FORMAT.unpack(second.heartbeats[0])[2]


def unplugged(*arguments):
    raise OSError("cable unplugged")


@pytest.mark.parametrize(
    ("method", "replacement"),
    [
        ("read", unplugged),
        ("receive", unplugged),
        ("read", lambda: {"time": 1.0}),
        ("read", lambda: JointStatus("now", None, 0.0, 0.0)),
    ],
)
def test_monitor_damps_when_the_driver_fails(arm, method, replacement):
    bus = Bus(arm).watch()
    setattr(bus.monitor._driver, method, replacement)
    moving = bus.speed
    bus.go(1)
    assert (bus.monitor.state, bus.monitor.fault, bus.is_stopping) == (MonitorState.DAMPING, Fault.MALFORMED, True)
    bus.go(20)
    assert bus.speed < 0.2 * moving


@pytest.mark.parametrize("failures", [1, 20, 60])
def test_monitor_damps_when_its_commands_have_failed(arm, failures):
    """The robot executes the last torque meanwhile."""
    bus = Bus(arm).watch()
    bus.monitor._driver.write = unplugged
    bus.go(MAX_MISSED_MESSAGES + failures)
    assert (bus.monitor.state, bus.is_stopping, bus.commands) == (MonitorState.DAMPING, True, [])
    del bus.monitor._driver.write
    speed = bus.speed
    bus.go(1)
    for _ in range(30):
        bus.go(1)
        assert bus.speed < 1.05 * speed
    assert bus.speed < 0.1 * speed
    bus.go(60)
    assert bus.monitor.state == MonitorState.IDLE


@pytest.mark.parametrize("method", ["write_heartbeat", "read_heartbeats"])
def test_monitor_continues_when_heartbeats_fail(arm, method):
    bus = Bus(arm).watch()
    setattr(bus.monitor._driver, method, unplugged)
    bus.go(MAX_MISSED_MESSAGES + 10)
    assert bus.monitor.state == MonitorState.DAMPING
    assert bus.commands


def test_monitor_sends_torques_when_the_driver_fails_to_hold(arm):
    bus = Bus(arm).watch()
    bus.monitor._driver.can_hold, bus.monitor._driver.hold = True, unplugged
    moving = bus.speed
    bus.go(20, status=b"text")
    assert bus.monitor.state == MonitorState.DAMPING
    assert bus.speed < 0.2 * moving


def test_monitor_sends_heartbeats_before_the_first_status(arm):
    bus = Bus(arm)
    bus.go(1, status=False)
    assert (len(bus.heartbeats), bus.monitor.fault, bus.commands) == (1, Fault.NO_STATUS, [])


def test_monitor_checks_once_per_period_without_a_new_status(arm):
    bus = Bus(arm)
    bus.go(1)
    bus.monitor.receive()
    bus.settle()
    assert len(bus.heartbeats) == 1
    bus.go(1, status=False)
    assert len(bus.heartbeats) == 2


class Clocked:
    """Monitor without a robot, by a clock that a test sets, after a command that turns one joint."""

    def __init__(self, arm, commanded_at):
        self.now, self.lcm = commanded_at, DrakeLcm("memq://")
        limits = replace(safety_limits(arm.plant, IiwaDriver), damping_time=0.25)
        self.monitor = SafetyMonitor(IiwaDriver(self.lcm), arm.plant, limits, clock=lambda: self.now)
        self.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(PUSH * (np.arange(7) == 3), commanded_at))
        self.lcm.HandleSubscriptions(0)

    def state_at(self, now):
        self.now = now
        self.monitor.check()
        return self.monitor.state


@pytest.mark.parametrize(("share", "state"), [(1.0, MonitorState.WATCHING), (1.0005, MonitorState.DAMPING)])
def test_commands_may_be_silent_for_their_time(arm, share, state):
    assert Clocked(arm, 0.0).state_at(share * MAX_MISSED_MESSAGES * PERIOD) == state


@pytest.mark.parametrize(("seconds", "state"), [(0.05, MonitorState.RESTING), (0.05002, MonitorState.IDLE)])
def test_states_of_a_stop_last_for_their_times(arm, seconds, state):
    clocked = Clocked(arm, -0.5)
    assert clocked.state_at(-0.25) == MonitorState.DAMPING
    assert clocked.state_at(-0.005) == MonitorState.DAMPING
    assert clocked.state_at(0.0) == MonitorState.RESTING
    assert clocked.state_at(seconds) == state


@pytest.mark.parametrize(("gap", "is_due"), [(0.9895, False), (0.99, True), (1.0, True)])
def test_check_without_a_status_is_due_after_a_period(arm, gap, is_due):
    """The tolerance is for the rounding of a clock."""
    bus, times = Bus(arm), [0.0]
    bus.monitor = SafetyMonitor(IiwaDriver(bus.lcm), arm.plant, bus.limits, clock=lambda: times[-1])
    bus.monitor.receive()
    times.append(gap * PERIOD)
    bus.monitor.receive()
    bus.settle()
    assert len(bus.heartbeats) == 1 + is_due


def test_new_status_is_checked_at_once(arm):
    bus = Bus(arm)
    bus.go(1)
    now = bus.now
    bus.monitor = SafetyMonitor(IiwaDriver(bus.lcm), arm.plant, bus.limits, clock=lambda: now)
    bus.heartbeats.clear()
    bus.go(3)
    assert len(bus.heartbeats) == 3


@pytest.mark.parametrize(("timeout", "expected"), [((), 0.0), ((0.25,), 0.25)])
def test_monitor_waits_for_messages_only_when_asked(arm, timeout, expected):
    timeouts = []

    class Recording(IiwaDriver):
        def receive(self, timeout):
            timeouts.append(timeout)

    monitor = SafetyMonitor(Recording(DrakeLcm("memq://")), arm.plant, safety_limits(arm.plant, Recording))
    monitor.receive(*timeout)
    assert timeouts == [expected]


def test_damping_is_that_of_the_arm_in_its_posture(arm):
    bus = Bus(arm).watch()
    bus.go(MAX_MISSED_MESSAGES)
    bus.plant.SetPositions(bus.context, bus.positions)
    bus.go(1)
    M, limits = bus.plant.CalcMassMatrix(bus.context), np.array(bus.limits.torque)
    expected = damping_torque(M, bus.velocities, bus.limits.decay_time, period=PERIOD)
    np.testing.assert_allclose(bus.commands[-1], np.clip(expected, -limits, limits), rtol=1e-5)


def test_velocity_is_predicted_by_the_model_of_the_arm(arm):
    bus = Bus(arm, velocity=5.0 * MOVING).watch()
    bus.go(MAX_MISSED_MESSAGES, status=False)
    assert bus.monitor.fault == Fault.NONE
    np.testing.assert_allclose(bus.monitor._estimated.velocity, bus.velocities, atol=4e-3)


def test_monitor_asks_the_driver_to_hold_after_a_status_fault(arm):
    held = []

    class Holding(IiwaDriver):
        can_hold = True

        def hold(self):
            held.append(True)

    bus = Bus(arm)
    bus.monitor = SafetyMonitor(Holding(bus.lcm), bus.plant, bus.limits, clock=lambda: bus.now)
    bus.watch()
    bus.go(2, joint_velocity_estimated=[np.nan] * 7)
    assert bus.commands == []
    bus.go(1, command=True, joint_velocity_estimated=[np.nan] * 7)
    assert (len(held), bus.monitor.state) == (3, MonitorState.DAMPING)
    bus.go(100)
    bus.go(10, command=True)
    bus.commands.clear()
    bus.go(MAX_MISSED_MESSAGES + 2)  # no fault of the status: damped
    assert (len(held) <= 3 + round(0.5 / PERIOD), len(bus.commands)) == (True, 2)


def test_monitor_refuses_a_driver_that_is_not_usable(arm):
    class Unusable(IiwaDriver):
        def check_usable(self):
            raise InputError("not usable")

    with pytest.raises(InputError, match="not usable"):
        SafetyMonitor(Unusable(DrakeLcm("memq://")), arm.plant, safety_limits(arm.plant, Unusable))


def test_torque_tolerances_are_a_share_of_the_limits(arm):
    limits = safety_limits(arm.plant, IiwaDriver)
    np.testing.assert_allclose(torque_tolerance(limits), 0.02 * np.array(limits.torque))
