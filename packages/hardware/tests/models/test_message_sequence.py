"""Messages of two robots or two programs, on both sides of each limit."""

import numpy as np
import pytest

import guiderail_hardware.models.message_sequence as module
from guiderail_hardware.models.joint_status import MALFORMED_STATUS, MAX_MISSED_MESSAGES, JointStatus
from guiderail_hardware.models.message_sequence import CommandSequence, StatusSequence

PERIOD = 2.0**-8
TORQUE = np.array([1.0, -2.0])
MAX_DELAY = MAX_MISSED_MESSAGES * PERIOD  # maximum delay of a message [s]


def status(time, *positions, velocity=0.0):
    return JointStatus(time, np.array(positions), np.full(len(positions), velocity), np.zeros(len(positions)))


def status_conflicts(*statuses):
    """Return the number of conflicts in a sequence of statuses."""
    sequence = StatusSequence(PERIOD)
    for each in statuses:
        sequence.add(each)
    return sequence.num_conflicts


def test_equal_time_stamps_conflict_when_values_differ():
    assert status_conflicts(status(1.0, 0.0), status(1.0, 0.0)) == 0
    assert status_conflicts(status(1.0, 0.0), status(1.0, 0.0, velocity=1e-9)) == 1
    assert status_conflicts(status(1.0, 0.0), status(1.0, 1e-9), status(1.0, 0.0)) == 2
    assert status_conflicts(status(1.0, 0.0), status(1.0, 0.0), status(1.0, 1e-9)) == 1


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("joint", [0, 1])
@pytest.mark.parametrize(("share", "is_conflict"), [(0.9999, False), (1.0001, True)])
def test_positions_conflict_when_they_move_back_and_forth(share, is_conflict, joint, sign):
    """The position of a joint changes in 3/4 of a period and returns in 1/4."""
    times = 1.0 + PERIOD * np.array([0.0, 0.75, 1.0])
    rates = 1.0 / np.diff(times)
    limit = (module.REVERSAL + 2.0 * module.RESOLUTION * rates.sum()) / rates.sum()
    positions = np.zeros((3, 2))
    positions[1, joint] = sign * share * limit
    assert status_conflicts(*(status(*each) for each in zip(times, *positions.T, strict=True))) == is_conflict
    assert module.REVERSAL == 1.5
    assert module.RESOLUTION == 1e-4


def test_positions_do_not_conflict_without_a_reversal():
    """A collision or a jump changes the positions in one direction."""
    steps = [0.0, 0.05, 0.05, 0.0501, 0.0502]
    assert status_conflicts(*(status(n * PERIOD, q) for n, q in enumerate(steps))) == 0
    assert status_conflicts(*(status(n * PERIOD, q) for n, q in enumerate([0.0, 0.001, 0.05]))) == 0
    assert status_conflicts(*(status(n * PERIOD, q) for n, q in enumerate([0.0, 0.0, -0.05]))) == 0


@pytest.mark.parametrize(("gap", "is_conflict"), [(MAX_DELAY, True), (MAX_DELAY + 1e-9, False)])
def test_positions_are_compared_within_the_maximum_interval(gap, is_conflict):
    times = np.cumsum([1.0, gap, PERIOD])
    assert status_conflicts(*(status(t, q) for t, q in zip(times, [0.0, 0.5, 0.0], strict=True))) == is_conflict
    times = np.cumsum([1.0, PERIOD, gap])
    assert status_conflicts(*(status(t, q) for t, q in zip(times, [0.0, 0.5, 0.0], strict=True))) == is_conflict


@pytest.mark.parametrize(
    "between",
    [MALFORMED_STATUS, status(1.0 + 1.5 * PERIOD, 0.0, 0.0, 0.0), status(0.5, 0.0)],
    ids=["malformed", "size", "reordered"],
)
def test_positions_are_compared_again_after_a_gap(between):
    before, peak = status(1.0, 0.0), status(1.0 + PERIOD, 0.5)
    assert status_conflicts(before, peak, status(1.0 + 2 * PERIOD, 0.0)) == 1
    assert status_conflicts(before, peak, between, status(1.0 + 2 * PERIOD, 0.0)) == 0
    second = (status(1.0 + n * PERIOD, 0.5 * (n % 2)) for n in range(2, 5))
    assert status_conflicts(before, peak, between, *second) == 1


@pytest.mark.parametrize(("interval", "is_conflict"), [(0.5, False), (0.4999, True), (0.01, True), (0.0, False)])
def test_two_short_intervals_conflict(interval, is_conflict):
    """The statuses are from two robots at rest, whose clocks differ by `interval` periods."""
    times = 1.0 + PERIOD * np.array([0.0, interval, 1.0, 1.0 + interval])
    assert status_conflicts(*(status(t, 0.0) for t in times)) == is_conflict
    assert status_conflicts(*(status(t, 0.0) for t in times[:3])) == 0


@pytest.mark.parametrize(("distance", "is_conflict"), [(2.0, True), (2.0 + 2.0**-10, False)])
def test_short_intervals_far_apart_do_not_conflict(distance, is_conflict):
    """A single early status, as after a delay, is no conflict."""
    times = 1.0 + PERIOD * np.array([0.0, 0.25, 1.0, distance, 0.25 + distance])
    assert status_conflicts(*(status(t, 0.0) for t in times)) == is_conflict


def test_statuses_of_a_second_robot_at_rest_conflict():
    speed, sequence = 0.4, StatusSequence(PERIOD)
    for step in range(4):
        time = step * PERIOD
        sequence.add(status(time, speed * time, velocity=speed))
        sequence.add(status(time + 0.2 * PERIOD, 0.0))
    assert sequence.num_conflicts >= 2


@pytest.mark.parametrize("offset", [-1e4, -1.0, -MAX_DELAY - 2 * PERIOD, MAX_DELAY + 2 * PERIOD, 1.0, 1e4])
@pytest.mark.parametrize("run", [1, 2, 7, 50])
def test_alternating_clocks_of_two_robots_conflict(offset, run):
    """Statuses of a second robot at rest arrive in groups of `run`, with a clock far from the first robot's."""
    sequence = StatusSequence(PERIOD)
    for step in range(4 * run):
        is_second = step // run % 2
        sequence.add(status(100.0 + step * PERIOD + is_second * offset, 0.0))
    assert sequence.num_conflicts >= 1


@pytest.mark.parametrize("offset", [-0.9, -0.6, -0.3, -2.2, 0.3])
def test_moving_and_resting_robot_conflict_when_their_clocks_are_close(offset):
    """Time stamps of the second robot may precede those of the first."""
    sequence, speed = StatusSequence(PERIOD), 1.0
    for step in range(8):
        time = 1.0 + step * PERIOD
        sequence.add(status(time, speed * time, velocity=speed))
        sequence.add(status(time + offset * PERIOD, 0.0))
    assert sequence.num_conflicts >= 1


@pytest.mark.parametrize(("late", "is_conflict"), [(0, True), (1, False)])
def test_clocks_must_return_within_the_maximum_number_of_statuses(late, is_conflict):
    """The senders change after 200 statuses, or after 201."""
    run = 200 + late
    times = [1.0 + n * PERIOD + 1e4 * (n // run % 2) for n in range(3 * run + 1)]
    assert status_conflicts(*(status(t, 0.0) for t in times)) == is_conflict


@pytest.mark.parametrize(("jump", "is_conflict"), [(1.0, False), (1.0005, True)])
def test_clocks_alternate_if_they_differ_by_more_than_the_maximum_interval(jump, is_conflict):
    assert status_conflicts(*(status(1.0 + MAX_DELAY * jump * (n % 2), 0.0) for n in range(4))) == is_conflict


@pytest.mark.parametrize(("share", "is_conflict"), [(1.0, True), (1.0005, False), (-1.0, True), (-1.0005, False)])
def test_clock_returns_to_where_it_would_be_without_the_jump(share, is_conflict):
    """One status later, a clock is within one period, and the delay of a message, of its time stamp before the jump."""
    times = [1.0, 100.0, 1.0 + share * (PERIOD + MAX_DELAY), 100.0]
    assert status_conflicts(*(status(t, 0.0) for t in times)) == is_conflict


@pytest.mark.parametrize(("share", "is_conflict"), [(0.9999, False), (1.0001, True)])
def test_reordered_statuses_of_two_velocities_conflict(share, is_conflict):
    rates = np.array([1.0, 1.0 / 0.75]) / PERIOD
    limit = (module.REVERSAL + 2.0 * module.RESOLUTION * rates.sum()) / (rates[1] - rates[0])
    times, positions = 1.0 + PERIOD * np.array([0.0, 1.0, 0.25]), [0.0, share * limit, 0.0]
    assert status_conflicts(*(status(*each) for each in zip(times, positions, strict=True))) == is_conflict


def test_short_intervals_before_and_after_a_jump_do_not_conflict():
    assert status_conflicts(*(status(t, 0.0) for t in [2.0, 2.0 + 0.25 * PERIOD, 1.0, 1.0 + 0.25 * PERIOD])) == 0


def test_two_short_intervals_conflict_when_time_stamps_go_back():
    times = 1.0 + PERIOD * np.array([0.0, -0.25, 1.0, 0.75])
    assert status_conflicts(*(status(t, 0.0) for t in times)) == 1


@pytest.mark.parametrize("jump", [-1e4, -1.0, 1.0, 1e4])
def test_restarted_clock_of_one_robot_does_not_conflict(jump):
    times = 1.0 + PERIOD * np.arange(60)
    times[30:] += jump
    assert status_conflicts(*(status(t, 0.0) for t in times)) == 0


def test_lost_and_reordered_statuses_of_a_moving_robot_do_not_conflict():
    order = [0, 1, 2, 3, 5, 4, 6, 8, 7, 9, 10, 30, 31, 32, 60, 61, 63, 62, 64]
    assert status_conflicts(*(status(1.0 + n * PERIOD, 1.5 * n * PERIOD, velocity=1.5) for n in order)) == 0


# Sequences of commands.


def command_conflicts(times, receipt_times=None, torques=None):
    """Return the number of conflicts of commands with time stamps and receipt times [s]."""
    sequence = CommandSequence(PERIOD)
    receipt_times = times if receipt_times is None else receipt_times
    for n, (time, now) in enumerate(zip(times, receipt_times, strict=True)):
        sequence.add(TORQUE + n if torques is None else torques[n], time, now)
    return sequence.num_conflicts


def test_commands_of_one_program_do_not_conflict():
    times = PERIOD * np.arange(500)
    assert command_conflicts(times) == 0
    assert command_conflicts(times + 100.0, times) == 0
    assert command_conflicts(times / 1.15) == 0  # 15 % faster
    assert command_conflicts(np.repeat(times, 2), torques=np.repeat(times, 2)[:, None]) == 0  # each message twice


def test_gaps_do_not_conflict():
    times = PERIOD * np.array([*range(10), *range(30, 40), *range(60, 70), *range(90, 100)])
    assert command_conflicts(times) == 0


def test_restart_does_not_conflict():
    receipt_times = PERIOD * np.arange(60)
    times = np.where(receipt_times < 30 * PERIOD, receipt_times + 50.0, receipt_times - 30 * PERIOD)
    assert command_conflicts(times, receipt_times) == 0
    twice = np.where(receipt_times < 40 * PERIOD, times, receipt_times - 40 * PERIOD)
    assert command_conflicts(twice, receipt_times) == 0


@pytest.mark.parametrize("offset", [-50.0, 50.0, 2.0 * MAX_DELAY])
def test_returning_time_stamps_conflict(offset):
    receipt_times = PERIOD * np.repeat(np.arange(10), 2)
    times = receipt_times + np.tile([0.0, offset], 10)
    assert command_conflicts(times[:2], receipt_times[:2]) == 0
    assert command_conflicts(times[:3], receipt_times[:3]) == 1
    assert command_conflicts(times, receipt_times) >= 17


@pytest.mark.parametrize(("share", "is_conflict"), [(1.0, True), (1.0001, False), (-1.0, True), (-1.0001, False)])
def test_return_to_an_earlier_clock_conflicts_within_the_delay(share, is_conflict):
    elapsed = 0.25
    assert command_conflicts([100.0, 3.0, 100.0 + elapsed + share * MAX_DELAY], [0.0, 0.01, elapsed]) == is_conflict


@pytest.mark.parametrize(("elapsed", "is_conflict"), [(1.0, True), (1.0 + 1e-9, False)])
def test_return_to_an_earlier_clock_conflicts_for_a_second(elapsed, is_conflict):
    assert command_conflicts([100.0, 3.0, 100.0 + elapsed], [0.0, 0.01, elapsed]) == is_conflict
    assert module.RETURN_TIME == 1.0


@pytest.mark.parametrize(("jump", "is_conflict"), [(MAX_DELAY, False), (MAX_DELAY + 2.0**-20, True)])
def test_jump_of_the_clock_exceeds_the_delay_of_a_message(jump, is_conflict):
    assert command_conflicts([1.0, 1.0 - jump, 1.0 + MAX_DELAY], [0.0, 0.0, MAX_DELAY]) == is_conflict


@pytest.mark.parametrize(("gap", "is_conflict"), [(0.1, True), (0.1 + 1e-9, False)])
def test_equal_time_stamps_conflict_when_repeated_within_0_1_s(gap, is_conflict):
    assert command_conflicts([1.0, 1.0], [0.0, 0.0]) == 0
    assert command_conflicts([1.0, 1.0, 1.005, 1.005], [0.0, 0.0, gap, gap]) == is_conflict
    assert module.EQUAL_TIME == 0.1


def test_rate_conflicts_above_its_limit():
    """Two programs with the same clock send 2 commands per period; the limit is 1.2 per period."""
    times = PERIOD * (0.5 * np.arange(60))
    sequence = CommandSequence(PERIOD)
    first_conflict = None
    for n, time in enumerate(times):
        sequence.add(TORQUE + n, time, time)
        first_conflict = n if first_conflict is None and sequence.num_conflicts else first_conflict
    # The level rises by 1 − 0.6 with each command after the first, up to 8.
    assert first_conflict == int((module.MAX_LEVEL - 1.0) / 0.4) + 1
    assert command_conflicts(PERIOD / 1.19 * np.arange(1000)) == 0
    assert command_conflicts(PERIOD / 1.25 * np.arange(1000)) > 0
    assert (module.LEAK, module.MAX_LEVEL) == (1.2, 8)


@pytest.mark.parametrize(("number", "is_conflict"), [(8, False), (9, True)])
def test_rate_allows_a_burst(number, is_conflict):
    assert command_conflicts(1.0 + 1e-3 * np.arange(number), np.zeros(number)) == is_conflict


@pytest.mark.parametrize(("periods", "is_conflict"), [(0.999 / 1.2, True), (1.001 / 1.2, False)])
def test_rate_allows_a_command_when_the_level_falls_by_one(periods, is_conflict):
    times = 1.0 + 1e-3 * np.arange(9)
    assert command_conflicts(times, [*np.zeros(8), periods * PERIOD]) == is_conflict


def test_level_falls_when_one_of_two_programs_stops():
    sequence = CommandSequence(PERIOD)
    for n in range(100):
        sequence.add(TORQUE + n, 0.5 * n * PERIOD, 0.5 * n * PERIOD)
    before = sequence.num_conflicts
    for n in range(1, 100):
        sequence.add(TORQUE + n, (49.5 + n) * PERIOD, (49.5 + n) * PERIOD)
    assert sequence.num_conflicts == before


def test_level_does_not_fall_below_zero():
    times = [0.0, *(10.0 + 1e-3 * np.arange(9))]
    receipt_times = [0.0, *np.full(9, 10.0)]
    assert command_conflicts(times, receipt_times) == 1
