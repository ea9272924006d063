import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ZeroOrderHold

from guiderail.models.common.errors import InputError
from guiderail.systems.command_watchdog import CommandWatchdog

PERIOD, TIMEOUT = 2.0**-6, 2.0**-3
START, FIRST, SECOND = np.zeros(6), np.full(6, 1.0), np.full(6, 2.0)


class SupervisedTraining:
    """A watchdog whose robot is at `START`, with its inputs at hand."""

    def __init__(self, command, time=None, start=START):
        self.system = CommandWatchdog(PERIOD, TIMEOUT, pose_size=len(start))
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
        np.testing.assert_array_equal(self.system.get_safe_pose_output_port().Eval(self.context), pose)
        assert self.system.get_command_timed_out_output_port().Eval(self.context) == [command_timed_out]


def test_a_valid_command_passes_at_once():
    watched = SupervisedTraining(FIRST)
    watched.check(FIRST, command_timed_out=0)
    watched.command(SECOND)
    watched.check(SECOND, command_timed_out=0)


def test_without_a_time_commands_never_get_stale():
    watched = SupervisedTraining(FIRST)
    watched.advance(100 * TIMEOUT)
    watched.check(FIRST, command_timed_out=0)


def test_a_stale_command_gives_way_to_the_last_one_that_was_followed():
    watched = SupervisedTraining(FIRST, time=0.0)
    watched.advance(TIMEOUT)
    watched.check(FIRST, command_timed_out=0)
    # Found at the first check at which it is stale: a period after the timeout at the latest.
    watched.advance(2.5 * PERIOD)
    watched.check(FIRST, command_timed_out=1)
    watched.command(SECOND, time=0.0)  # an old message that arrives late
    watched.check(FIRST, command_timed_out=1)


@pytest.mark.parametrize("phase", [0.0, 0.3, 1.0])
def test_a_fresh_command_after_a_stale_one_counts_at_once(phase):
    watched = SupervisedTraining(FIRST, time=0.0)
    watched.advance(3 * TIMEOUT + phase * PERIOD)
    watched.check(FIRST, command_timed_out=1)
    watched.command(SECOND, time=watched.context.get_time())
    watched.check(SECOND, command_timed_out=0)


def test_a_command_that_arrives_late_and_gets_stale_at_once_is_what_is_held():
    watched = SupervisedTraining(FIRST, time=0.0)
    watched.advance(4.5 * PERIOD)
    # Still followed, and stale at the very next check.
    watched.command(SECOND, time=watched.context.get_time() - TIMEOUT - 0.25 * PERIOD)
    watched.check(SECOND, command_timed_out=0)
    watched.advance(PERIOD)
    watched.check(SECOND, command_timed_out=1)


@pytest.mark.parametrize("phase", [0.0, 0.3, 1.0])
def test_a_command_from_the_future_is_never_followed(phase):
    """It would never get stale."""
    watched = SupervisedTraining(FIRST, time=0.0)
    watched.advance(3 * PERIOD + phase * PERIOD)
    for ahead in (1.5 * PERIOD, 1000.0, np.inf):
        watched.command(SECOND, time=watched.context.get_time() + ahead)
        watched.check(FIRST, command_timed_out=1)
    watched.advance(3 * PERIOD)
    watched.check(FIRST, command_timed_out=1)


def test_a_clock_that_is_ahead_by_less_than_a_period_is_no_reason_to_stop():
    watched = SupervisedTraining(FIRST, time=0.5 * PERIOD)
    watched.check(FIRST, command_timed_out=0)


def test_a_time_that_is_no_number_is_no_command():
    watched = SupervisedTraining(FIRST, time=np.nan)
    watched.check(START, command_timed_out=1)


@pytest.mark.parametrize("nonsense", [np.nan, np.inf])
def test_before_any_command_it_holds_where_the_robot_is(nonsense):
    watched = SupervisedTraining(np.full(6, nonsense))
    watched.check(START, command_timed_out=1)
    watched.advance(3 * PERIOD)
    watched.check(START, command_timed_out=1)


def test_a_command_that_is_not_finite_gives_way_and_comes_back():
    watched = SupervisedTraining(FIRST)
    watched.advance(3 * PERIOD)
    watched.command(np.array([2.0, 2.0, np.nan, 2.0, 2.0, 2.0]))
    watched.check(FIRST, command_timed_out=1)
    watched.command(SECOND)
    watched.check(SECOND, command_timed_out=0)


@pytest.mark.parametrize("size", [1, 2, 7])
def test_poses_of_any_size(size):
    watched = SupervisedTraining(np.full(size, np.nan), start=np.arange(float(size)))
    watched.check(np.arange(float(size)), command_timed_out=1)
    watched.command(np.ones(size))
    watched.check(np.ones(size), command_timed_out=0)


def test_a_reset_forgets():
    watched = SupervisedTraining(FIRST, time=0.0)
    watched.advance(3 * TIMEOUT)
    watched.context.SetTimeStateAndParametersFrom(watched.pristine)
    watched.simulator.Initialize()
    watched.check(FIRST, command_timed_out=0)
    watched.command(np.full(6, np.nan))
    watched.check(START, command_timed_out=1)


@pytest.mark.parametrize(("age", "command_timed_out"), [(0.5 * TIMEOUT, 0), (2.0 * TIMEOUT, 1), (-2.0 * PERIOD, 1)])
def test_started_between_two_checks_it_judges_by_the_time_of_the_start(age, command_timed_out):
    watched, start = SupervisedTraining(FIRST), 5.0 + 0.5 * PERIOD
    watched.context.SetTime(start)
    watched.command(FIRST, time=start - age)
    watched.simulator.Initialize()
    watched.check(START if command_timed_out else FIRST, command_timed_out)


def test_between_two_checks_nothing_is_computed_anew():
    """Python that runs at every step of a plant is what makes a simulation slow."""
    calls = []

    class Counted(CommandWatchdog):
        def _calc_safe_pose(self, context, output):
            calls.append(context.get_time())
            super()._calc_safe_pose(context, output)

    builder = DiagramBuilder()
    action_repeat = builder.AddSystem(ZeroOrderHold(PERIOD, 6))
    time_hold = builder.AddSystem(ZeroOrderHold(PERIOD, 1))
    system = builder.AddSystem(Counted(PERIOD, TIMEOUT))
    builder.Connect(action_repeat.get_output_port(), system.get_desired_pose_input_port())
    builder.Connect(time_hold.get_output_port(), system.get_command_time_input_port())
    for name, port in (
        ("command", action_repeat.get_input_port()),
        ("time", time_hold.get_input_port()),
        ("pose", system.get_pose_input_port()),
    ):
        builder.ExportInput(port, name)
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    for name, value in (("command", FIRST), ("time", [0.0]), ("pose", START)):
        diagram.GetInputPort(name).FixValue(context, value)
    simulator.Initialize()
    steps = 40
    for step in range(8 * steps):
        simulator.AdvanceTo((step + 0.5) * PERIOD / 8)
        system.get_safe_pose_output_port().Eval(system.GetMyContextFromRoot(context))
    assert len(calls) <= steps + 1


@pytest.mark.parametrize(
    "arguments", [(0.0, 0.1), (0.01, 0.0), (np.nan, 0.1), (np.inf, 0.1), (0.01, np.nan), (0.01, 0.1, 0)]
)
def test_refuses_what_makes_no_sense(arguments):
    with pytest.raises(InputError):
        CommandWatchdog(*arguments)
