"""Safety monitor on a bus in memory, with a simulated clock."""

from dataclasses import replace

import numpy as np
import pytest
from drake import lcmt_iiwa_status
from hardware_doubles import unplugged
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail_hardware.drivers.driver import safety_limits, torque_tolerance
from guiderail_hardware.drivers.lcm import HEARTBEAT_FORMAT, IiwaDriver
from guiderail_hardware.models.joint_dynamics import JointDynamics
from guiderail_hardware.models.joint_status import HOLD_TIME, MAX_MISSED_MESSAGES, Fault, JointStatus, damping_torque
from guiderail_hardware.monitor import MAX_REPEATS, MonitorState, SafetyMonitor
from guiderail_hardware.systems.torque_safety_limiter import ZERO_TORQUE_TIME

PERIOD = IiwaDriver.period
VELOCITY = np.array([0.3, -0.2, 0.1, 0.2, 0.05, 0.1, -0.1])  # joint velocities at the start [rad/s]
PUSH = np.array([0.5, 0.4, 0.5, 0.3, 0.1, 0.1, 0.1])  # commanded torques [Nm]
JOINT_FIELDS = lcmt_iiwa_status.__slots__[2:]


@pytest.fixture(scope="module")
def arm():
    return ArmControllerPlant(BncWorkcell())


class Bus:
    """Bus with a simulated robot, a safety monitor, and records of the monitor's commands and heartbeats."""

    def __init__(self, arm, velocity=VELOCITY):
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

    def advance(self, steps=1, status=True, command=False, **changed):
        """Advance the robot, and send its status and a command after each step.

        Args:
            steps: Number of status periods.
            status: True to send the status, False to send nothing, or bytes to send instead.
            command: True to send the torques `PUSH`.
            **changed: Values of fields of the status that replace the robot's.
        """
        for _ in range(steps):
            self.step += 1
            self.plant.SetPositionsAndVelocities(self.context, [*self.positions, *self.velocities])
            M, drag = self.dynamics.evaluate(self.context)
            self.velocities = self.velocities + PERIOD * np.linalg.solve(M, self.torque - drag)
            self.positions = self.positions + PERIOD * self.velocities
            message = lcmt_iiwa_status()
            message.utime, message.num_joints = round((100.0 + self.step * PERIOD) * 1e6), 7
            for name in JOINT_FIELDS:
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
        """Handle messages until none is left."""
        for _ in range(100):
            if not self.lcm.HandleSubscriptions(0):
                return
        raise AssertionError("the bus has messages after 100 rounds")

    def start_watching(self):
        """Command the arm until the monitor accepts its statuses; return the bus."""
        self.advance(100)
        self.advance(10, command=True)
        assert (self.monitor.state, self.monitor.fault) == (MonitorState.WATCHING, Fault.NONE)
        assert not self.is_stopping
        self.commands.clear()
        return self

    @property
    def speed(self):
        return np.abs(self.velocities).max()


def test_monitor_damps_then_commands_zero_when_commands_stop(arm):
    bus = Bus(arm).start_watching()
    bus.advance(MAX_MISSED_MESSAGES)
    assert bus.commands == []
    initial_speed = bus.speed
    bus.advance(1)
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.DAMPING, True)
    bus.advance(20)
    assert bus.speed < 0.02 * initial_speed
    bus.advance(round(bus.limits.damping_time / PERIOD) - 20)
    assert bus.monitor.state == MonitorState.RESTING
    np.testing.assert_array_equal(bus.commands[-1], 0.0)
    bus.advance(round(ZERO_TORQUE_TIME / PERIOD) - 1)
    assert bus.monitor.state == MonitorState.RESTING
    bus.advance(2)
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.IDLE, False)
    count = len(bus.commands)
    bus.advance(20)
    assert len(bus.commands) == count


def test_damping_torque_is_clipped_to_its_limits(arm):
    bus = Bus(arm, velocity=5.0 * VELOCITY).start_watching()
    bus.advance(MAX_MISSED_MESSAGES + 1)
    assert (np.abs(bus.commands[-1]) <= np.array(bus.limits.torque)).all()
    assert np.isclose(np.abs(bus.commands[-1]), bus.limits.torque).any()


def test_monitor_finishes_damping_when_commands_return(arm):
    bus = Bus(arm).start_watching()
    bus.advance(MAX_MISSED_MESSAGES + 1)
    bus.advance(5, command=True)
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.DAMPING, True)


def test_monitor_is_idle_when_no_torque_is_commanded(arm):
    bus = Bus(arm)
    bus.advance(50)
    assert bus.monitor.state == MonitorState.IDLE
    bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.zeros(7), 0.0))
    bus.settle()
    bus.commands.clear()
    assert bus.monitor.state == MonitorState.WATCHING
    bus.advance(1, joint_velocity_estimated=[np.nan] * 7)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.WATCHING, Fault.NOT_FINITE)
    bus.advance(50)
    assert (bus.monitor.state, bus.commands) == (MonitorState.IDLE, [])


# Changed fields of a status, and the expected faults.
FAULTY = {
    "NaN in a velocity": ({"joint_velocity_estimated": [np.nan] * 7}, Fault.NOT_FINITE),
    "NaN in an external torque": ({"joint_torque_external": [np.nan, *[0.0] * 6]}, Fault.NOT_FINITE),
    "wrong joint count": ({"num_joints": 3} | {name: [0.0] * 3 for name in JOINT_FIELDS}, Fault.WRONG_SIZE),
    "position jump": ({"joint_position_measured": [1.0] * 7}, Fault.POSITION_JUMP),
    "velocity jump": ({"joint_velocity_estimated": [2.0] * 7}, Fault.VELOCITY_JUMP),
    "frozen time stamp": ({"utime": 100_500_000}, Fault.OUT_OF_ORDER),
    "clock from zero": ({"utime": 1000}, Fault.OUT_OF_ORDER),
    "clock ahead": ({"utime": 900_000_000}, Fault.FUTURE),
    "noise": ({"status": bytes(range(100))}, Fault.MALFORMED),
    "one byte": ({"status": b"\x00"}, Fault.MALFORMED),
}


@pytest.mark.parametrize("name", FAULTY)
def test_monitor_stops_the_arm_when_a_status_is_wrong(arm, name):
    """The arm is damped to rest although the following statuses are wrong as well."""
    bus, (changed, fault) = Bus(arm).start_watching(), FAULTY[name]
    initial_speed = bus.speed
    bus.advance(1, command=True, **changed)
    assert (bus.monitor.state, bus.monitor.fault, bus.is_stopping) == (MonitorState.DAMPING, fault, True)
    for _ in range(20):
        bus.advance(1, **changed)
        assert bus.speed < 1.1 * initial_speed
    assert bus.speed < 0.15
    bus.advance(round(bus.limits.damping_time / PERIOD) + 1, **changed)
    np.testing.assert_array_equal(bus.commands[-1], 0.0)
    assert bus.speed < 0.15


def test_monitor_stops_the_arm_when_statuses_stop(arm):
    """The monitor detects this by its own clock; it sends damping torques without statuses, and then zero torque."""
    bus = Bus(arm).start_watching()
    bus.advance(MAX_MISSED_MESSAGES + 1, status=False, command=True)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.DAMPING, Fault.STALE)
    bus.advance(round(bus.limits.damping_time / PERIOD) + 1, status=False)
    np.testing.assert_array_equal(bus.commands[-1], 0.0)
    assert bus.speed < 0.15


def test_monitor_ignores_commands_of_a_wrong_size(arm):
    bus = Bus(arm).start_watching()
    for _ in range(MAX_MISSED_MESSAGES + 1):
        bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.ones(3), bus.now))
        bus.lcm.Publish("IIWA_COMMAND", bytes(range(60)))
        bus.advance(1)
    assert bus.monitor.state == MonitorState.DAMPING


def test_monitor_drops_reordered_statuses(arm):
    bus = Bus(arm).start_watching()
    old = round((100.0 + (bus.step - 1) * PERIOD) * 1e6)
    bus.advance(1, command=True, utime=old)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.WATCHING, Fault.NONE)


def contend(bus, steps, torque, clock=0.0):
    """Send torques of a second program after each command of the first; `clock` [s] is the offset of their times."""
    for _ in range(steps):
        bus.advance(1, command=True)
        bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(torque, bus.now + clock))
        bus.settle()


@pytest.mark.parametrize("torque", [0.001 * PUSH, -PUSH], ids=["small", "negated"])
@pytest.mark.parametrize("clock", [0.0, -5.0, 300.0])
def test_monitor_stops_the_arm_when_two_programs_command(arm, torque, clock):
    bus = Bus(arm).start_watching()
    contend(bus, 3, torque, clock)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.DAMPING, Fault.SECOND_COMMANDER)
    contend(bus, 20, torque, clock)
    assert bus.speed < 0.02
    contend(bus, 100, torque, clock)  # the monitor's zero torque is the last command of each step
    assert (bus.monitor.state, bus.is_stopping) == (MonitorState.RESTING, True)
    np.testing.assert_array_equal(bus.torque, 0.0)
    bus.advance(round(IiwaDriver.hold_off / PERIOD) + 3, command=True)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.WATCHING, Fault.NONE)


def test_monitor_repeats_its_torque_twice_between_checks(arm):
    bus = Bus(arm).start_watching()
    bus.advance(MAX_MISSED_MESSAGES + 1)
    bus.commands.clear()
    for torque in (1.0, 2.0, 3.0, 4.0):
        bus.lcm.Publish("IIWA_COMMAND", IiwaDriver.encode(np.full(7, torque), bus.now))
        bus.settle()
    assert len(bus.commands) == 4 + 2  # foreign commands and repeats of the monitor


def test_two_monitors_stop_the_arm_and_resume(arm):
    """A monitor repeats its torque after a foreign command, at most `MAX_REPEATS` times per period."""
    bus = Bus(arm)
    second = SafetyMonitor(IiwaDriver(bus.lcm), arm.plant, bus.limits, clock=lambda: bus.now)

    def advance(steps, command=True, **changed):
        for _ in range(steps):
            bus.advance(1, command=command, **changed)
            second.receive()
            bus.settle()
        return [(monitor.state, monitor.fault) for monitor in (bus.monitor, second)]

    advance(100, command=False)
    assert advance(10) == [(MonitorState.WATCHING, Fault.NONE)] * 2
    bus.commands.clear()
    assert advance(1, joint_velocity_estimated=[np.nan] * 7) == [(MonitorState.DAMPING, Fault.NOT_FINITE)] * 2
    advance(20)
    assert len(bus.commands) <= 21 * (1 + 2 * (1 + MAX_REPEATS))
    assert bus.speed < 0.02
    assert advance(200) == [(MonitorState.WATCHING, Fault.NONE)] * 2


def test_monitor_sends_a_heartbeat_before_a_command(arm):
    bus, order = Bus(arm).start_watching(), []
    bus.lcm.Subscribe("IIWA_COMMAND", lambda message: order.append("command"))
    bus.lcm.Subscribe(IiwaDriver.heartbeat_channel(), lambda message: order.append(bus.is_stopping))
    bus.advance(MAX_MISSED_MESSAGES + 1)
    assert order[-2:] == [True, "command"]


def test_heartbeats_have_sequence_and_sender_numbers(arm):
    first, second = Bus(arm), Bus(arm)
    first.advance(3)
    second.advance(1)
    sent = [HEARTBEAT_FORMAT.unpack(message) for message in first.heartbeats]
    assert [sequence for sequence, *_ in sent] == [1, 2, 3]
    assert len({sender for _, _, sender, _ in sent}) == 1
    assert sent[0][2] != HEARTBEAT_FORMAT.unpack(second.heartbeats[0])[2]


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
    bus = Bus(arm).start_watching()
    setattr(bus.monitor._driver, method, replacement)
    initial_speed = bus.speed
    bus.advance(1)
    assert (bus.monitor.state, bus.monitor.fault, bus.is_stopping) == (MonitorState.DAMPING, Fault.MALFORMED, True)
    bus.advance(20)
    assert bus.speed < 0.2 * initial_speed


@pytest.mark.parametrize("failures", [1, 20, 60])
def test_monitor_damps_the_arm_after_failed_commands(arm, failures):
    """While commands fail, the robot executes the last torque."""
    bus = Bus(arm).start_watching()
    bus.monitor._driver.write = unplugged
    bus.advance(MAX_MISSED_MESSAGES + failures)
    assert (bus.monitor.state, bus.is_stopping, bus.commands) == (MonitorState.DAMPING, True, [])
    del bus.monitor._driver.write
    speed = bus.speed
    bus.advance(1)
    for _ in range(30):
        bus.advance(1)
        assert bus.speed < 1.05 * speed
    assert bus.speed < 0.1 * speed
    bus.advance(60)
    assert bus.monitor.state == MonitorState.IDLE


@pytest.mark.parametrize("method", ["write_heartbeat", "read_heartbeats"])
def test_monitor_continues_when_heartbeats_fail(arm, method):
    bus = Bus(arm).start_watching()
    setattr(bus.monitor._driver, method, unplugged)
    bus.advance(MAX_MISSED_MESSAGES + 10)
    assert bus.monitor.state == MonitorState.DAMPING
    assert bus.commands


def test_monitor_sends_torques_when_hold_raises(arm):
    bus = Bus(arm).start_watching()
    bus.monitor._driver.can_hold, bus.monitor._driver.hold = True, unplugged
    initial_speed = bus.speed
    bus.advance(20, status=b"text")
    assert bus.monitor.state == MonitorState.DAMPING
    assert bus.speed < 0.2 * initial_speed


def test_monitor_sends_heartbeats_before_the_first_status(arm):
    bus = Bus(arm)
    bus.advance(1, status=False)
    assert (len(bus.heartbeats), bus.monitor.fault, bus.commands) == (1, Fault.NO_STATUS, [])
    assert HEARTBEAT_FORMAT.unpack(bus.heartbeats[0])[3] == -1  # no command yet


def test_monitor_checks_once_per_period_without_statuses(arm):
    bus = Bus(arm)
    bus.advance(1)
    bus.monitor.receive()
    bus.settle()
    assert len(bus.heartbeats) == 1
    bus.advance(1, status=False)
    assert len(bus.heartbeats) == 2


class ClockedMonitor:
    """Monitor without a robot, with a clock that tests set; one command at `commanded_at` [s] turns joint 4."""

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


@pytest.mark.parametrize(("timeouts", "state"), [(1.0, MonitorState.WATCHING), (1.0005, MonitorState.DAMPING)])
def test_monitor_damps_after_the_command_timeout(arm, timeouts, state):
    assert ClockedMonitor(arm, 0.0).state_at(timeouts * MAX_MISSED_MESSAGES * PERIOD) == state


@pytest.mark.parametrize(("seconds", "state"), [(0.05, MonitorState.RESTING), (0.05002, MonitorState.IDLE)])
def test_damping_and_resting_last_for_their_durations(arm, seconds, state):
    monitor = ClockedMonitor(arm, -0.5)
    assert monitor.state_at(-0.25) == MonitorState.DAMPING
    assert monitor.state_at(-0.005) == MonitorState.DAMPING
    assert monitor.state_at(0.0) == MonitorState.RESTING
    assert monitor.state_at(seconds) == state


@pytest.mark.parametrize(("gap", "is_due"), [(0.9895, False), (0.99, True), (1.0, True)])
def test_check_without_a_status_is_due_after_a_period(arm, gap, is_due):
    """A tolerance of 1 % of a period allows for rounding of the clock."""
    bus, times = Bus(arm), [0.0]
    bus.monitor = SafetyMonitor(IiwaDriver(bus.lcm), arm.plant, bus.limits, clock=lambda: times[-1])
    bus.monitor.receive()
    times.append(gap * PERIOD)
    bus.monitor.receive()
    bus.settle()
    assert len(bus.heartbeats) == 1 + is_due


def test_new_status_is_checked_immediately(arm):
    bus = Bus(arm)
    bus.advance(1)
    now = bus.now
    bus.monitor = SafetyMonitor(IiwaDriver(bus.lcm), arm.plant, bus.limits, clock=lambda: now)
    bus.heartbeats.clear()
    bus.advance(3)
    assert len(bus.heartbeats) == 3


@pytest.mark.parametrize(("timeout", "expected"), [((), 0.0), ((0.25,), 0.25)])
def test_receive_passes_its_timeout_to_the_driver(arm, timeout, expected):
    timeouts = []

    class RecordingDriver(IiwaDriver):
        def receive(self, timeout):
            timeouts.append(timeout)

    monitor = SafetyMonitor(RecordingDriver(DrakeLcm("memq://")), arm.plant, safety_limits(arm.plant, RecordingDriver))
    monitor.receive(*timeout)
    assert timeouts == [expected]


def test_damping_torque_has_the_mass_matrix_of_the_posture(arm):
    bus = Bus(arm).start_watching()
    bus.advance(MAX_MISSED_MESSAGES)
    bus.plant.SetPositions(bus.context, bus.positions)
    bus.advance(1)
    M, limits = bus.plant.CalcMassMatrix(bus.context), np.array(bus.limits.torque)
    expected = damping_torque(M, bus.velocities, bus.limits.decay_time, period=PERIOD)
    np.testing.assert_allclose(bus.commands[-1], np.clip(expected, -limits, limits), rtol=1e-5)


def test_velocity_is_predicted_while_statuses_are_missing(arm):
    bus = Bus(arm, velocity=5.0 * VELOCITY).start_watching()
    bus.advance(MAX_MISSED_MESSAGES, status=False)
    assert bus.monitor.fault == Fault.NONE
    np.testing.assert_allclose(bus.monitor._estimated.velocity, bus.velocities, atol=4e-3)


def test_monitor_calls_hold_after_a_status_fault(arm):
    holds = []

    class HoldingDriver(IiwaDriver):
        can_hold = True

        def hold(self):
            holds.append(True)

    bus = Bus(arm)
    bus.monitor = SafetyMonitor(HoldingDriver(bus.lcm), bus.plant, bus.limits, clock=lambda: bus.now)
    bus.start_watching()
    bus.advance(2, joint_velocity_estimated=[np.nan] * 7)
    np.testing.assert_array_equal(bus.commands, np.zeros((1, 7)))  # before the driver holds the arm
    np.testing.assert_array_equal(bus.monitor._command, np.zeros(7))  # with which the velocity is predicted
    bus.advance(1, command=True, joint_velocity_estimated=[np.nan] * 7)
    assert (len(holds), bus.monitor.state) == (3, MonitorState.DAMPING)
    bus.advance(100)
    bus.advance(10, command=True)
    bus.commands.clear()
    bus.advance(MAX_MISSED_MESSAGES + 2)  # a missing command is no status fault, so the arm is damped
    assert (len(holds) <= 3 + round(0.5 / PERIOD), len(bus.commands)) == (True, 2)


def test_arm_is_damped_when_hold_has_no_effect(arm):
    class DeafDriver(IiwaDriver):
        can_hold = True

        def hold(self):
            return True

    bus = Bus(arm, velocity=1.2 * VELOCITY)
    bus.monitor = SafetyMonitor(DeafDriver(bus.lcm), bus.plant, bus.limits, clock=lambda: bus.now)
    bus.start_watching()
    bus.torque = np.zeros(7)
    initial_speed = bus.speed
    bus.advance(1, status=b"noise")
    bus.advance(round(HOLD_TIME / PERIOD) - 3)
    assert bus.monitor.state == MonitorState.DAMPING
    np.testing.assert_array_equal(bus.commands, np.zeros((1, 7)))
    bus.advance(round(0.05 / PERIOD) + 3)
    assert np.any(bus.commands)
    assert bus.speed < 0.15 < initial_speed


def test_every_stop_begins_with_its_speed_and_another_hold(arm):
    class HoldingDriver(IiwaDriver):
        can_hold = True

        def hold(self):
            return True

    bus = Bus(arm, velocity=np.linspace(-0.4, 0.1, 7))
    bus.monitor = SafetyMonitor(HoldingDriver(bus.lcm), bus.plant, bus.limits, clock=lambda: bus.now)
    bus.start_watching()
    bus.monitor._can_hold = False  # as after a stop in which the driver did not hold the arm
    velocity = bus.velocities.copy()
    assert -velocity.min() > velocity.max()
    bus.advance(1, status=b"noise")
    assert bus.monitor._can_hold
    assert bus.monitor._initial_speed == pytest.approx(-velocity.min(), rel=0.1)


def test_second_robot_is_not_adopted_while_the_commander_pauses(arm):
    """Damping its velocity would accelerate the arm at rest."""
    bus = Bus(arm, velocity=np.zeros(7))
    bus.advance(100)
    bus.advance(20, command=True)
    bus.advance(100)
    assert (bus.monitor.state, bus.monitor.fault) == (MonitorState.IDLE, Fault.NONE)
    speed = 1.0
    for step in range(round(0.6 / PERIOD)):
        positions = (bus.positions + speed * step * PERIOD).tolist()
        other = {"joint_position_measured": positions, "joint_velocity_estimated": [speed] * 7}
        bus.advance(1, utime=round((500.0 + step * PERIOD) * 1e6), **other)
    bus.commands.clear()
    bus.velocities = np.zeros(7)
    for step in range(round(0.6 / PERIOD), round(0.9 / PERIOD)):
        positions = (bus.positions + speed * step * PERIOD).tolist()
        other = {"joint_position_measured": positions, "joint_velocity_estimated": [speed] * 7}
        bus.advance(1, command=step % 20 == 0, utime=round((500.0 + step * PERIOD) * 1e6), **other)
    assert bus.monitor.fault != Fault.NONE
    sent = [torque for torque in bus.commands if not np.allclose(torque, PUSH)]
    assert sent
    np.testing.assert_allclose(sent, 0.0, atol=1e-9)


def test_heartbeat_reports_the_newest_command(arm):
    bus = Bus(arm).start_watching()
    bus.advance(1)
    assert HEARTBEAT_FORMAT.unpack(bus.heartbeats[-1])[3] == round(1e6 * (bus.now - PERIOD))


def test_monitor_raises_when_the_driver_is_not_usable(arm):
    class UnusableDriver(IiwaDriver):
        def check_usable(self):
            raise InputError("not usable")

    with pytest.raises(InputError, match="not usable"):
        SafetyMonitor(UnusableDriver(DrakeLcm("memq://")), arm.plant, safety_limits(arm.plant, UnusableDriver))


def test_torque_tolerances_are_a_share_of_the_limits(arm):
    limits = safety_limits(arm.plant, IiwaDriver)
    np.testing.assert_allclose(torque_tolerance(limits), 0.02 * np.array(limits.torque))
