"""Who stands by at a robot, on a bus in memory."""

import numpy as np
import pytest
from drake import lcmt_iiwa_status
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.hardware.driver import safety_limits
from guiderail.diagrams.hardware.lcm.driver import IiwaDriver
from guiderail.diagrams.hardware.monitor import MonitorState, SafetyMonitor
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell
from guiderail.models.control.joint_status import MAX_MISSED_MESSAGES

PERIOD = IiwaDriver.period
MOVING = np.array([0.3, -0.2, 0.1, 0.2, 0.0, 0.1, -0.1])


@pytest.fixture(scope="module")
def known():
    return ArmControllerPlant(BncWorkcell())


class Bus:
    """A robot that says how fast it is, a deputy, and everything that is said to the robot."""

    def __init__(self, known):
        self.lcm, self.time, self.heard, self.words = DrakeLcm("memq://"), 100.0, [], []
        self.limits = safety_limits(known.plant, IiwaDriver)
        self.monitor = SafetyMonitor(IiwaDriver(self.lcm), known.plant, self.limits)
        self.lcm.Subscribe("IIWA_COMMAND", self.hear)
        self.lcm.Subscribe(IiwaDriver.heartbeat_channel(), self.words.append)

    def hear(self, message):
        torque = IiwaDriver.decode_command(message)
        if torque is not None:
            self.heard.append(torque)

    def status(self, velocities=MOVING, steps=1, **changed):
        for _ in range(steps):
            self.time += PERIOD
            message = lcmt_iiwa_status()
            message.utime, message.num_joints = round(self.time * 1e6), 7
            for name in message.__slots__[2:]:
                setattr(message, name, [0.0] * 7)
            message.joint_velocity_estimated = list(velocities)
            for name, value in changed.items():
                setattr(message, name, value)
            self.publish("IIWA_STATUS", message.encode())

    def command(self, torque):
        self.publish("IIWA_COMMAND", IiwaDriver.encode(np.array(torque), self.time))

    def publish(self, channel, message):
        self.lcm.Publish(channel, message)
        while self.lcm.HandleSubscriptions(0):
            pass


def test_damps_within_the_limits_where_commands_stop_then_says_no_torque_and_falls_silent(known):
    bus = Bus(known)
    for _ in range(10):
        bus.status()
        bus.command([1.0] * 7)
    bus.heard.clear()
    bus.status(steps=MAX_MISSED_MESSAGES)
    assert bus.heard == []
    bus.status(velocities=10.0 * MOVING, steps=2)
    assert bus.monitor.state == MonitorState.DAMPING
    M = known.plant.CalcMassMatrix(known.plant.CreateDefaultContext())
    decay_time = bus.limits.decay_time
    wanted = -(M @ (10.0 * MOVING)) * (1.0 - np.exp(-PERIOD / decay_time)) / PERIOD
    np.testing.assert_allclose(bus.heard[-1], np.clip(wanted, -np.array(bus.limits.torque), bus.limits.torque))
    assert (np.abs(wanted) > bus.limits.torque).any()
    bus.status(steps=round(bus.limits.damping_time / PERIOD) + 2)
    assert bus.monitor.state == MonitorState.RESTING
    np.testing.assert_array_equal(bus.heard[-1], 0.0)
    bus.status(steps=20)
    assert bus.monitor.state == MonitorState.IDLE
    said = len(bus.heard)
    bus.status(steps=20)
    assert len(bus.heard) == said


def test_goes_on_to_the_end_where_commands_come_back_and_says_so(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    bus.status(steps=MAX_MISSED_MESSAGES + 2)
    acting = bus.words[-1]
    assert acting[-1] == 1
    for _ in range(5):
        bus.command([1.0] * 7)
        bus.status()
    assert bus.monitor.state == MonitorState.DAMPING
    assert bus.words[-1][-1] == 1
    assert bus.words[-1] != acting


def test_has_nothing_to_do_where_the_last_command_was_no_torque_or_none_ever_came(known):
    bus = Bus(known)
    bus.status(steps=50)
    assert bus.monitor.state == MonitorState.IDLE
    bus.command([1.0] * 7)
    bus.status()
    bus.command([0.0] * 7)
    bus.heard.clear()
    bus.status(steps=50)
    assert (bus.monitor.state, bus.heard) == (MonitorState.IDLE, [])


def test_what_is_no_sound_message_neither_moves_it_nor_ends_it(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    said = len(bus.words)
    for message in (bytes(range(100)), b""):
        bus.publish("IIWA_STATUS", message)
        bus.publish("IIWA_COMMAND", message)
    bus.status(joint_velocity_estimated=[np.nan] * 7)
    bus.status(num_joints=3, **{name: [0.0] * 3 for name in lcmt_iiwa_status.__slots__[2:]})
    assert len(bus.words) == said
    bus.status(steps=MAX_MISSED_MESSAGES)
    assert bus.monitor.state == MonitorState.DAMPING


def test_a_robot_that_was_started_anew_is_brought_to_rest_at_once(known):
    """What was on its way to the one before arrives at this one; statuses that were merely overtaken start nothing."""
    bus = Bus(known)
    bus.status(steps=5)
    bus.command([1.0] * 7)
    bus.time -= 3.5 * PERIOD
    bus.status()
    assert bus.monitor.state == MonitorState.WATCHING
    bus.heard.clear()
    bus.time = 0.0
    bus.status(velocities=0.1 * MOVING)
    assert bus.monitor.state == MonitorState.DAMPING
    M = known.plant.CalcMassMatrix(known.plant.CreateDefaultContext())
    share = -np.expm1(-PERIOD / bus.limits.decay_time)
    np.testing.assert_allclose(bus.heard[-1], -(M @ (0.1 * MOVING)) * share / PERIOD, rtol=1e-6)


def test_a_robots_clock_that_goes_back_does_not_make_it_wait(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    bus.time = 3.0
    bus.status(steps=MAX_MISSED_MESSAGES + 3)
    assert bus.monitor.state == MonitorState.DAMPING
    bus.time = 1.0
    bus.status(steps=round(bus.limits.damping_time / PERIOD) + 2)
    assert bus.monitor.state == MonitorState.RESTING


def test_statuses_that_overtake_each_other_do_not_make_it_wait(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    for _ in range(MAX_MISSED_MESSAGES):
        for ahead in (2, 0):  # the second of two comes first
            bus.status(utime=round((bus.time + ahead * PERIOD) * 1e6))
    assert bus.monitor.state == MonitorState.DAMPING
