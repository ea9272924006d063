import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.systems.command_checks import CommandWatchdog

PERIOD, TIMEOUT = 2.0**-6, 2.0**-3
START, FIRST, SECOND = np.zeros(6), np.full(6, 1.0), np.full(6, 2.0)


class Rig:
    """Watchdog of a robot at `start`, with fixed inputs."""

    def __init__(self, command, time=None, start=START, timeout=(TIMEOUT,)):
        self.system = CommandWatchdog(PERIOD, *timeout, pose_size=len(start))
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.pristine = self.system.CreateDefaultContext()
        self.system.get_pose_input_port().FixValue(self.context, start)
        self.command(command, time)
        self.simulator.Initialize()

    def command(self, pose, time=None):
        self.system.get_desired_pose_input_port().FixValue(self.context, pose)
        if time is not None:
            self.system.get_command_time_input_port().FixValue(self.context, [time])

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    def check(self, pose, command_timed_out):
        """Assert that the outputs have these values."""
        np.testing.assert_array_equal(self.system.get_safe_pose_output_port().Eval(self.context), pose)
        assert self.system.get_command_timed_out_output_port().Eval(self.context) == [command_timed_out]


def test_valid_command_is_passed_through_at_once():
    rig = Rig(FIRST)
    rig.check(FIRST, command_timed_out=0)
    rig.command(SECOND)
    rig.check(SECOND, command_timed_out=0)


def test_commands_never_time_out_without_a_time_stamp():
    rig = Rig(FIRST)
    rig.advance(100 * TIMEOUT)
    rig.check(FIRST, command_timed_out=0)


def test_last_valid_command_replaces_a_stale_command():
    rig = Rig(FIRST, time=0.0)
    rig.advance(TIMEOUT)
    rig.check(FIRST, command_timed_out=0)
    # The check that detects the timeout is at most one period later.
    rig.advance(2.5 * PERIOD)
    rig.check(FIRST, command_timed_out=1)
    rig.command(SECOND, time=0.0)  # a message that arrives late
    rig.check(FIRST, command_timed_out=1)


@pytest.mark.parametrize("phase", [0.0, 0.3, 1.0])
def test_new_command_is_valid_at_once_after_a_timeout(phase):
    rig = Rig(FIRST, time=0.0)
    rig.advance(3 * TIMEOUT + phase * PERIOD)
    rig.check(FIRST, command_timed_out=1)
    rig.command(SECOND, time=rig.context.get_time())
    rig.check(SECOND, command_timed_out=0)


def test_age_is_that_at_the_last_check_and_not_the_present_one():
    """The outputs do not depend on time, so that an age from the present time would depend on when they are cached."""
    rig = Rig(FIRST, time=-0.5 * PERIOD)
    rig.advance(TIMEOUT - 0.5 * PERIOD)  # after the check at which the age is TIMEOUT − 0.5 PERIOD
    rig.context.SetTime(rig.context.get_time() + 0.4 * PERIOD)
    rig.context.SetAllCacheEntriesOutOfDate()
    rig.check(FIRST, command_timed_out=0)


def test_late_command_is_stored_before_it_times_out():
    rig = Rig(FIRST, time=0.0)
    rig.advance(4.5 * PERIOD)
    # This command is valid, and stale at the next check.
    rig.command(SECOND, time=rig.context.get_time() - TIMEOUT - 0.25 * PERIOD)
    rig.check(SECOND, command_timed_out=0)
    rig.advance(PERIOD)
    rig.check(SECOND, command_timed_out=1)


@pytest.mark.parametrize("phase", [0.0, 0.3, 1.0])
def test_command_is_ignored_when_its_time_is_in_the_future(phase):
    """Such a command would never time out."""
    rig = Rig(FIRST, time=0.0)
    rig.advance(3 * PERIOD + phase * PERIOD)
    for ahead in (1.5 * PERIOD, 1000.0, np.inf):
        rig.command(SECOND, time=rig.context.get_time() + ahead)
        rig.check(FIRST, command_timed_out=1)
    rig.advance(3 * PERIOD)
    rig.check(FIRST, command_timed_out=1)


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.9])
def test_command_is_valid_when_it_is_early_by_less_than_a_period(phase):
    rig = Rig(FIRST, time=0.5 * PERIOD)
    rig.check(FIRST, command_timed_out=0)
    rig.advance((3 + phase) * PERIOD)
    rig.command(SECOND, time=rig.context.get_time() + 0.9 * PERIOD)
    rig.check(SECOND, command_timed_out=0)


@pytest.mark.parametrize(
    ("age", "command_timed_out"),
    [(TIMEOUT, 0), (1.0005 * TIMEOUT, 1), (-(PERIOD + 1e-6), 0), (-(PERIOD + 1.0005e-6), 1), (np.nan, 1)],
)
def test_age_of_a_command_is_checked_at_its_limits(age, command_timed_out):
    rig = Rig(FIRST, time=-age)
    rig.check(START if command_timed_out else FIRST, command_timed_out)


@pytest.mark.parametrize(("size", "command_timed_out"), [(1e6, 0), (1.0005e6, 1)])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_command_is_valid_up_to_its_largest_coordinate(sign, size, command_timed_out):
    command = np.array([0.0, 0.0, 0.0, sign * size, 0.0, 0.0])
    rig = Rig(command)
    rig.check(START if command_timed_out else command, command_timed_out)


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_measured_pose_must_be_finite_at_initialization(number):
    with pytest.raises(InputError, match="measured pose must be finite"):
        Rig(FIRST, start=np.full(6, number))


@pytest.mark.parametrize("number", [np.nan, np.inf])
def test_measured_pose_is_output_before_the_first_command(number):
    rig = Rig(np.full(6, number))
    rig.check(START, command_timed_out=1)
    rig.advance(3 * PERIOD)
    rig.check(START, command_timed_out=1)


def test_command_is_ignored_while_it_is_not_finite():
    rig = Rig(FIRST)
    rig.advance(3 * PERIOD)
    rig.command(np.array([2.0, 2.0, np.nan, 2.0, 2.0, 2.0]))
    rig.check(FIRST, command_timed_out=1)
    rig.command(SECOND)
    rig.check(SECOND, command_timed_out=0)


@pytest.mark.parametrize("size", [1, 2, 7])
def test_pose_size_is_arbitrary(size):
    rig = Rig(np.full(size, np.nan), start=np.arange(float(size)))
    rig.check(np.arange(float(size)), command_timed_out=1)
    rig.command(np.ones(size))
    rig.check(np.ones(size), command_timed_out=0)


def test_initialization_resets_the_last_valid_pose():
    rig = Rig(FIRST, time=0.0)
    rig.advance(3 * TIMEOUT)
    rig.context.SetTimeStateAndParametersFrom(rig.pristine)
    rig.simulator.Initialize()
    rig.check(FIRST, command_timed_out=0)
    rig.command(np.full(6, np.nan))
    rig.check(START, command_timed_out=1)


@pytest.mark.parametrize(("blend_factor", "pose"), [(0.0, SECOND), (0.5, FIRST), (1.0, FIRST)])
def test_measured_pose_is_output_when_the_blend_factor_was_zero(blend_factor, pose):
    rig = Rig(FIRST)
    factor = rig.system.get_blend_factor_input_port().FixValue(rig.context, [1.0])
    rig.advance(2 * PERIOD)
    factor.GetMutableData().set_value([blend_factor])
    rig.command(np.full(6, np.nan))
    for measured in (SECOND, np.full(6, np.nan)):
        rig.system.get_pose_input_port().FixValue(rig.context, measured)
        rig.advance(2 * PERIOD)
    factor.GetMutableData().set_value([1.0])
    rig.advance(2 * PERIOD)
    rig.check(pose, command_timed_out=1)
    rig.command(START)
    rig.check(START, command_timed_out=0)


@pytest.mark.parametrize(("age", "command_timed_out"), [(0.5 * TIMEOUT, 0), (2.0 * TIMEOUT, 1), (-2.0 * PERIOD, 1)])
def test_age_is_relative_to_the_start_before_the_first_check(age, command_timed_out):
    rig, start = Rig(FIRST), 5.0 + 0.5 * PERIOD
    rig.context.SetTime(start)
    rig.command(FIRST, time=start - age)
    rig.simulator.Initialize()
    rig.check(START if command_timed_out else FIRST, command_timed_out)


@pytest.mark.parametrize("timeout", [0.0, -0.1, np.nan, np.inf])
def test_constructor_refuses_a_timeout_out_of_range(timeout):
    with pytest.raises(InputError, match="the timeout of commands must be positive and finite"):
        CommandWatchdog(PERIOD, timeout)
