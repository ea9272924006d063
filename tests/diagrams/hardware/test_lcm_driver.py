"""Driver on LCM: which messages contradict others."""

import numpy as np
import pytest
from drake import lcmt_iiwa_status
from pydrake.lcm import DrakeLcm

from guiderail.diagrams.hardware.lcm import HEARTBEAT_FORMAT, MAX_HEARTBEATS_MISSED, IiwaDriver
from guiderail.models.control.joint_status import Heartbeat

OWN, OTHER = np.full(7, 0.5), np.full(7, -0.5)


class Pair:
    """This program's driver and another one on the same bus."""

    def __init__(self):
        lcm = DrakeLcm("memq://")
        self.driver, self.other, self.step = IiwaDriver(lcm), IiwaDriver(lcm), 0

    def status(self, time=None, position=0.0):
        self.step += 1
        message = lcmt_iiwa_status()
        message.utime, message.num_joints = round((self.step * 0.005 if time is None else time) * 1e6), 7
        for name in message.__slots__[2:]:
            setattr(message, name, [0.0] * 7)
        message.joint_position_measured = [position] * 7
        self.driver.lcm.Publish("IIWA_STATUS", message.encode())
        return self.read()

    def read(self):
        while self.driver.lcm.HandleSubscriptions(0):
            pass
        return self.driver.read()


def test_own_commands_are_not_foreign():
    pair = Pair()
    pair.driver.write(OWN, 1.0)
    assert pair.status().foreign_commands == pair.driver.num_foreign_commands == 0


def test_foreign_commands_contradict_once_this_program_commands():
    pair = Pair()
    pair.other.write(OTHER, 1.0)
    assert pair.status().foreign_commands == 0
    assert pair.driver.num_foreign_commands == 1
    pair.driver.write(OWN, 1.0)
    assert pair.read().foreign_commands == 0
    pair.other.write(OTHER, 1.0)
    assert pair.read().foreign_commands == 1  # without a new status
    pair.other.write(OTHER, 1.005)
    assert pair.status().foreign_commands == pair.driver.num_foreign_commands - 1 == 2


@pytest.mark.parametrize("is_stopping", [False, True])
def test_commands_of_a_safety_monitor_are_not_foreign(is_stopping):
    pair = Pair()
    pair.driver.write(OWN, 1.0)
    pair.other.write_heartbeat(Heartbeat(1, False, 5))
    pair.other.write_heartbeat(Heartbeat(1, is_stopping, 4))
    pair.other.write(OTHER, 1.0)
    assert pair.status().foreign_commands == pair.driver.num_foreign_commands == (not is_stopping)
    pair.other.write_heartbeat(Heartbeat(2, False, 4))
    pair.other.write(OTHER, 1.005)
    assert pair.read().foreign_commands == 1 + (not is_stopping)


def test_monitor_that_ended_during_a_stop_excuses_no_commands():
    pair = Pair()
    pair.driver.write(OWN, 1.0)
    pair.other.write_heartbeat(Heartbeat(7, True, 4))
    for sequence in range(MAX_HEARTBEATS_MISSED + 1):
        pair.other.write(OTHER, sequence * 0.005)
        assert pair.read() is None
        assert pair.driver.num_foreign_commands == 0
        pair.other.write_heartbeat(Heartbeat(sequence, False, 5))  # of the monitor that replaces it
    pair.read()
    assert {heartbeat.sender for heartbeat in pair.driver.read_heartbeats()} == {5}
    pair.other.write(OTHER, 9.0)
    assert pair.status().foreign_commands == pair.driver.num_foreign_commands == 1


def test_every_status_is_compared_also_if_it_is_not_read():
    pair = Pair()
    assert pair.status().conflicts == 0
    pair.status(time=0.006, position=0.1)
    assert pair.status(time=0.006, position=0.2).conflicts == 1
    assert pair.status(time=0.006, position=0.2).conflicts == 1
    pair.status(time=0.009, position=0.4)
    assert pair.status(time=0.012, position=0.2).conflicts == 2
    np.testing.assert_array_equal(pair.read().positions, 0.2)


def test_command_is_decoded_with_its_time():
    torque, time = IiwaDriver.decode_command(IiwaDriver.encode(OWN, 2.5))
    np.testing.assert_array_equal(torque, OWN)
    assert time == 2.5
    assert IiwaDriver.decode_command(b"nonsense") is None


class UdpBus:
    """Bus that keeps one unread message of a channel for each program, as `DrakeLcm` does on UDP."""

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


def test_older_heartbeat_of_another_channel_does_not_replace_a_newer_one():
    pair = Pair()
    for number, sequence in ((1, 5), (0, 4)):
        pair.other.lcm.Publish(IiwaDriver.heartbeat_channel(number), HEARTBEAT_FORMAT.pack(sequence, True, 7))
        pair.read()
    assert pair.driver.read_heartbeats() == (Heartbeat(5, True, 7),)


@pytest.mark.parametrize("timeout", [3e6, np.inf])
def test_a_wait_beyond_the_range_of_lcm_ends_with_the_first_message(timeout):
    pair = Pair()
    pair.status(0.005)
    message = lcmt_iiwa_status()
    message.utime = 10_000
    pair.driver.lcm.Publish("IIWA_STATUS", message.encode())
    pair.driver.receive(timeout)
    assert pair.driver.lcm.HandleSubscriptions(0) == 0
