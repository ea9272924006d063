import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.errors import InputError
from guiderail.systems.command_watchdog import CommandWatchdog

START, FIRST, SECOND = np.zeros(6), np.full(6, 1.0), np.full(6, 2.0)


class Watched:
    def __init__(self, command):
        self.system = CommandWatchdog(period=0.01, timeout=0.1)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.system.get_pose_input_port().FixValue(self.context, START)
        self.command(command)
        self.simulator.Initialize()

    def command(self, pose, time=None):
        self.system.get_desired_pose_input_port().FixValue(self.context, pose)
        if time is not None:
            self.system.get_command_time_input_port().FixValue(self.context, [time])

    def read(self):
        holding = self.system.get_holding_output_port().Eval(self.context)[0]
        return self.system.get_safe_pose_output_port().Eval(self.context).copy(), holding


def test_a_sound_command_passes_at_once():
    watched = Watched(FIRST)
    np.testing.assert_array_equal(watched.read()[0], FIRST)
    watched.command(SECOND)
    np.testing.assert_array_equal(watched.read()[0], SECOND)
    assert watched.read()[1] == 0.0


def test_an_old_command_gives_way_to_the_last_sound_one():
    watched = Watched(FIRST)
    watched.command(FIRST, time=0.0)
    watched.simulator.AdvanceTo(0.05)
    watched.simulator.AdvanceTo(0.3)
    watched.command(SECOND, time=0.0)
    pose, holding = watched.read()
    np.testing.assert_array_equal(pose, FIRST)
    assert holding == 1.0


def test_it_lets_go_when_commands_come_back():
    watched = Watched(FIRST)
    watched.command(FIRST, time=0.0)
    watched.simulator.AdvanceTo(0.3)
    watched.command(SECOND, time=0.3)
    pose, holding = watched.read()
    np.testing.assert_array_equal(pose, SECOND)
    assert holding == 0.0


@pytest.mark.parametrize("nonsense", [np.nan, np.inf])
def test_before_any_command_it_holds_where_the_robot_is(nonsense):
    watched = Watched(np.full(6, nonsense))
    watched.simulator.AdvanceTo(0.05)
    pose, holding = watched.read()
    np.testing.assert_array_equal(pose, START)
    assert holding == 1.0


@pytest.mark.parametrize(("period", "timeout"), [(0.0, 0.1), (0.01, 0.0), (np.nan, 0.1)])
def test_refuses_what_makes_no_sense(period, timeout):
    with pytest.raises(InputError):
        CommandWatchdog(period, timeout)
