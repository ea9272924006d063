"""Safety monitor on a bus in memory."""

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
    """Bus with statuses of a robot, a safety monitor, and records of commands and heartbeats."""

    def __init__(self, known):
        self.lcm, self.time, self.commands, self.heartbeats = DrakeLcm("memq://"), 100.0, [], []
        self.limits = safety_limits(known.plant, IiwaDriver)
        self.monitor = SafetyMonitor(IiwaDriver(self.lcm), known.plant, self.limits)
        self.lcm.Subscribe("IIWA_COMMAND", self.record_command)
        self.lcm.Subscribe(IiwaDriver.heartbeat_channel(), self.heartbeats.append)

    def record_command(self, message):
        torque = IiwaDriver.decode_command(message)
        if torque is not None:
            self.commands.append(torque)

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


def test_monitor_damps_then_rests_when_commands_stop(known):
    bus = Bus(known)
    for _ in range(10):
        bus.status()
        bus.command([1.0] * 7)
    bus.commands.clear()
    bus.status(steps=MAX_MISSED_MESSAGES)
    assert bus.commands == []
    bus.status(velocities=10.0 * MOVING, steps=2)
    assert bus.monitor.state == MonitorState.DAMPING
    M = known.plant.CalcMassMatrix(known.plant.CreateDefaultContext())
    decay_time = bus.limits.decay_time
    wanted = -(M @ (10.0 * MOVING)) * (1.0 - np.exp(-PERIOD / decay_time)) / PERIOD
    np.testing.assert_allclose(bus.commands[-1], np.clip(wanted, -np.array(bus.limits.torque), bus.limits.torque))
    assert (np.abs(wanted) > bus.limits.torque).any()
    bus.status(steps=round(bus.limits.damping_time / PERIOD) + 2)
    assert bus.monitor.state == MonitorState.RESTING
    np.testing.assert_array_equal(bus.commands[-1], 0.0)
    bus.status(steps=20)
    assert bus.monitor.state == MonitorState.IDLE
    count = len(bus.commands)
    bus.status(steps=20)
    assert len(bus.commands) == count


def test_monitor_finishes_damping_when_commands_return(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    bus.status(steps=MAX_MISSED_MESSAGES + 2)
    acting = bus.heartbeats[-1]
    assert acting[-1] == 1
    for _ in range(5):
        bus.command([1.0] * 7)
        bus.status()
    assert bus.monitor.state == MonitorState.DAMPING
    assert bus.heartbeats[-1][-1] == 1
    assert bus.heartbeats[-1] != acting


def test_monitor_is_idle_without_a_torque_to_stop(known):
    bus = Bus(known)
    bus.status(steps=50)
    assert bus.monitor.state == MonitorState.IDLE
    bus.command([1.0] * 7)
    bus.status()
    bus.command([0.0] * 7)
    bus.commands.clear()
    bus.status(steps=50)
    assert (bus.monitor.state, bus.commands) == (MonitorState.IDLE, [])


def test_monitor_ignores_malformed_messages(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    count = len(bus.heartbeats)
    for message in (bytes(range(100)), b""):
        bus.publish("IIWA_STATUS", message)
        bus.publish("IIWA_COMMAND", message)
    bus.status(joint_velocity_estimated=[np.nan] * 7)
    bus.status(num_joints=3, **{name: [0.0] * 3 for name in lcmt_iiwa_status.__slots__[2:]})
    assert len(bus.heartbeats) == count
    bus.status(steps=MAX_MISSED_MESSAGES)
    assert bus.monitor.state == MonitorState.DAMPING


def test_monitor_damps_at_once_when_the_robot_restarts(known):
    """Commands for the robot before its restart may still arrive; reordered statuses have no effect."""
    bus = Bus(known)
    bus.status(steps=5)
    bus.command([1.0] * 7)
    bus.time -= 3.5 * PERIOD
    bus.status()
    assert bus.monitor.state == MonitorState.WATCHING
    bus.commands.clear()
    bus.time = 0.0
    bus.status(velocities=0.1 * MOVING)
    assert bus.monitor.state == MonitorState.DAMPING
    M = known.plant.CalcMassMatrix(known.plant.CreateDefaultContext())
    share = -np.expm1(-PERIOD / bus.limits.decay_time)
    np.testing.assert_allclose(bus.commands[-1], -(M @ (0.1 * MOVING)) * share / PERIOD, rtol=1e-6)


def test_monitor_rests_in_time_when_the_clock_is_set_back(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    bus.time = 3.0
    bus.status(steps=MAX_MISSED_MESSAGES + 3)
    assert bus.monitor.state == MonitorState.DAMPING
    bus.time = 1.0
    bus.status(steps=round(bus.limits.damping_time / PERIOD) + 2)
    assert bus.monitor.state == MonitorState.RESTING


def test_monitor_damps_in_time_with_reordered_statuses(known):
    bus = Bus(known)
    bus.status()
    bus.command([1.0] * 7)
    for _ in range(MAX_MISSED_MESSAGES):
        for ahead in (2, 0):  # the second of two arrives first
            bus.status(utime=round((bus.time + ahead * PERIOD) * 1e6))
    assert bus.monitor.state == MonitorState.DAMPING
