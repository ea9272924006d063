"""Driver on LCM: commands of other programs, contradicting statuses, and heartbeats."""

import numpy as np
import pytest
from drake import lcmt_iiwa_status
from pydrake.lcm import DrakeLcm

from guiderail_hardware.drivers.lcm import HEARTBEAT_FORMAT, MAX_HEARTBEATS_MISSED, IiwaDriver
from guiderail_hardware.models.joint_status import Heartbeat

OWN, FOREIGN = np.full(7, 0.5), np.full(7, -0.5)


class TwoPrograms:
    """Drivers of two programs on the same bus; `driver` is under test, and `second` is foreign."""

    def __init__(self):
        lcm = DrakeLcm("memq://")
        self.driver, self.second, self.step = IiwaDriver(lcm), IiwaDriver(lcm), 0

    def send_status(self, time=None, position=0.0):
        """Send a status at `time` [s], by default a period later, and read it."""
        self.step += 1
        message = lcmt_iiwa_status()
        message.utime, message.num_joints = round((self.step * 0.005 if time is None else time) * 1e6), 7
        for name in message.__slots__[2:]:
            setattr(message, name, [0.0] * 7)
        message.joint_position_measured = [position] * 7
        self.driver.lcm.Publish("IIWA_STATUS", message.encode())
        return self.read()

    def read(self):
        """Handle all messages and return the newest status."""
        while self.driver.lcm.HandleSubscriptions(0):
            pass
        return self.driver.read()


def test_own_commands_are_not_foreign():
    programs = TwoPrograms()
    programs.driver.write(OWN, 1.0)
    assert programs.send_status().foreign_commands == programs.driver.num_foreign_commands == 0


def test_foreign_commands_count_after_the_first_own_command():
    programs = TwoPrograms()
    programs.second.write(FOREIGN, 1.0)
    assert programs.send_status().foreign_commands == 0
    assert programs.driver.num_foreign_commands == 1
    programs.driver.write(OWN, 1.0)
    assert programs.read().foreign_commands == 0
    programs.second.write(FOREIGN, 1.0)
    assert programs.read().foreign_commands == 1  # without a new status
    programs.second.write(FOREIGN, 1.005)
    assert programs.send_status().foreign_commands == programs.driver.num_foreign_commands - 1 == 2


@pytest.mark.parametrize("is_stopping", [False, True])
def test_commands_of_a_safety_monitor_are_not_foreign(is_stopping):
    programs = TwoPrograms()
    programs.driver.write(OWN, 1.0)
    programs.second.write_heartbeat(Heartbeat(1, False, 5))
    programs.second.write_heartbeat(Heartbeat(1, is_stopping, 4))
    programs.second.write(FOREIGN, 1.0)
    assert programs.send_status().foreign_commands == programs.driver.num_foreign_commands == (not is_stopping)
    programs.second.write_heartbeat(Heartbeat(2, False, 4))
    programs.second.write(FOREIGN, 1.005)
    assert programs.read().foreign_commands == 1 + (not is_stopping)


def test_commands_are_foreign_after_a_stopping_monitor_ended():
    programs = TwoPrograms()
    programs.driver.write(OWN, 1.0)
    programs.second.write_heartbeat(Heartbeat(7, True, 4))
    for sequence in range(MAX_HEARTBEATS_MISSED + 1):
        programs.second.write(FOREIGN, sequence * 0.005)
        assert programs.read() is None
        assert programs.driver.num_foreign_commands == 0
        programs.second.write_heartbeat(Heartbeat(sequence, False, 5))  # of the monitor that replaces the ended monitor
    programs.read()
    assert {heartbeat.sender for heartbeat in programs.driver.read_heartbeats()} == {5}
    programs.second.write(FOREIGN, 9.0)
    assert programs.send_status().foreign_commands == programs.driver.num_foreign_commands == 1


def test_conflicts_are_counted_in_statuses_that_are_not_read():
    programs = TwoPrograms()
    assert programs.send_status().conflicts == 0
    programs.send_status(time=0.006, position=0.1)
    assert programs.send_status(time=0.006, position=0.2).conflicts == 1
    assert programs.send_status(time=0.006, position=0.2).conflicts == 1
    programs.send_status(time=0.009, position=0.4)
    assert programs.send_status(time=0.012, position=0.2).conflicts == 2
    np.testing.assert_array_equal(programs.read().positions, 0.2)


def test_decode_command_returns_torque_and_time():
    torque, time = IiwaDriver.decode_command(IiwaDriver.encode(OWN, 2.5))
    np.testing.assert_array_equal(torque, OWN)
    assert time == 2.5
    assert IiwaDriver.decode_command(b"nonsense") is None


class UdpBus:
    """Bus that keeps the oldest unread message of each channel for each program, as `DrakeLcm` does on UDP."""

    def __init__(self, programs):
        self.programs, self.handlers, self.unread = programs, {}, {}
        programs.append(self)

    def Subscribe(self, channel, handler):
        self.handlers[channel] = handler

    def Publish(self, channel, message):
        for program in self.programs:
            program.unread.setdefault(channel, message)

    def HandleSubscriptions(self, timeout):
        unread, self.unread = self.unread, {}
        for channel, message in unread.items():
            self.handlers[channel](message)


def test_heartbeats_of_two_monitors_do_not_displace_each_other():
    programs = []
    *monitors, station = [IiwaDriver(UdpBus(programs)) for _ in range(3)]
    for sequence in range(1, 60):
        for sender, monitor in enumerate(monitors):
            monitor.write_heartbeat(Heartbeat(sequence, False, sender))
        for program in programs:
            program.HandleSubscriptions(0)
    assert {heartbeat.sender: heartbeat.sequence for heartbeat in station.read_heartbeats()} == {0: 59, 1: 59}


def test_older_heartbeat_does_not_replace_a_newer_heartbeat():
    programs = TwoPrograms()
    for number, sequence in ((1, 5), (0, 4)):
        programs.second.lcm.Publish(IiwaDriver.heartbeat_channel(number), HEARTBEAT_FORMAT.pack(sequence, True, 7, -1))
        programs.read()
    assert programs.driver.read_heartbeats() == (Heartbeat(5, True, 7),)


@pytest.mark.parametrize("timeout", [3e6, np.inf])
def test_receive_with_a_huge_timeout_ends_with_a_message(timeout):
    programs = TwoPrograms()
    programs.send_status(0.005)
    message = lcmt_iiwa_status()
    message.utime = 10_000
    programs.driver.lcm.Publish("IIWA_STATUS", message.encode())
    programs.driver.receive(timeout)
    assert programs.driver.lcm.HandleSubscriptions(0) == 0
