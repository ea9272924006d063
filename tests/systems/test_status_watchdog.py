from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import FAULT_DESCRIPTIONS, MALFORMED_STATUS, Fault, JointStatus, StatusLimits
from guiderail.systems.status_watchdog import StatusWatchdog

PERIOD = 1.0 / 256.0
LIMITS = StatusLimits(velocity=(1.0, 1.0))
CLOCK = 1000.0  # of the robot, when this one starts


class SupervisedTraining:
    """A watchdog whose robot's joints move at 0.1 rad/s; a status comes just before each check."""

    def __init__(self, limits=LIMITS):
        self.system = StatusWatchdog(limits, period=PERIOD)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.port = self.system.get_status_input_port().FixValue(self.context, Value[object]())
        self.step = 0
        self.simulator.Initialize()

    def sound(self):
        time = self.step * PERIOD
        return JointStatus(CLOCK + time, np.array([0.1, 0.1]) * time, np.full(2, 0.1), np.array([3.0, 4.0]))

    def check(self, status):
        """What is found when this is the newest status, before the watchdog's own event and after it."""
        self.port.GetMutableData().set_value(status or object())
        found = self.fault
        self.step += 1
        self.simulator.AdvanceTo(self.step * PERIOD)
        return found

    def settle(self):
        for _ in range(round(LIMITS.settling_time / PERIOD) + 3):
            self.check(self.sound())
        assert self.fault == Fault.NONE
        return self

    @property
    def fault(self):
        return Fault(int(self.system.get_fault_output_port().Eval(self.context)[0]))

    @property
    def state(self):
        return self.system.get_estimated_state_output_port().Eval(self.context).copy()

    @property
    def age(self):
        return self.system.get_age_output_port().Eval(self.context)[0]


def test_passes_on_what_is_sound_at_once():
    watched = SupervisedTraining().settle()
    status = watched.sound()
    watched.check(status)
    np.testing.assert_array_equal(watched.state, status.values()[:4])
    np.testing.assert_array_equal(watched.system.get_external_torque_output_port().Eval(watched.context), [3.0, 4.0])
    assert watched.age <= PERIOD


def test_believes_nobody_before_the_settling_time():
    watched = SupervisedTraining()
    assert watched.check(None) == Fault.NO_STATUS
    faults = [watched.check(watched.sound()) for _ in range(round(LIMITS.settling_time / PERIOD))]
    assert set(faults) == {Fault.NO_STATUS}
    watched.settle()


WRONG = {
    Fault.OUT_OF_ORDER: lambda sound: replace(sound, time=sound.time - 1.0),
    Fault.FUTURE: lambda sound: replace(sound, time=sound.time + 1.0),
    Fault.MALFORMED: lambda sound: MALFORMED_STATUS,
    Fault.WRONG_SIZE: lambda sound: replace(sound, velocities=np.zeros(3)),
    Fault.NOT_FINITE: lambda sound: replace(sound, external_torque=np.array([np.nan, 0.0])),
    Fault.POSITION_JUMP: lambda sound: replace(sound, positions=sound.positions + [0.0, 0.05]),
    Fault.VELOCITY_JUMP: lambda sound: replace(sound, velocities=sound.velocities + [2.0, 0.0]),
}


@pytest.mark.parametrize("fault", WRONG, ids=lambda fault: fault.name)
def test_names_the_fault_believes_nothing_of_it_and_recovers(fault):
    watched = SupervisedTraining().settle()
    before = watched.state
    wrong = WRONG[fault](watched.sound())
    assert watched.check(wrong) == fault
    np.testing.assert_array_equal(watched.state, before)
    assert watched.age > 0.0
    # A glitch: what comes after it is judged by it at first, and nothing of it is ever believed.
    steps = 0
    while watched.fault:
        steps += 1
        watched.check(watched.sound())
        assert np.abs(watched.state).max() < 0.2
    assert LIMITS.settling_time <= steps * PERIOD <= LIMITS.settling_time + 4 * PERIOD
    watched.check(watched.sound())
    np.testing.assert_array_equal(watched.state, replace_time(watched).values()[:4])


def replace_time(watched):
    watched.step -= 1
    status = watched.sound()
    watched.step += 1
    return status


def test_silence_is_stale_and_a_repeated_status_is_silence():
    watched = SupervisedTraining().settle()
    last = watched.sound()
    found = [watched.check(last) for _ in range(20)]
    first = found.index(Fault.STALE)
    assert LIMITS.max_age < first * PERIOD < LIMITS.max_age + 3 * PERIOD
    assert set(found[first:]) == {Fault.STALE}
    assert watched.age == pytest.approx(20 * PERIOD, abs=1.5 * PERIOD)
    # Time went on for both: the next status is a new one, and nothing is believed until it has settled.
    assert watched.check(watched.sound()) == Fault.STALE
    watched.settle()


def test_statuses_that_come_late_are_stale():
    watched = SupervisedTraining().settle()
    queue = []
    found = []
    for step in range(40):
        queue.append(watched.sound())
        found.append(watched.check(queue[step // 2]))  # a queue that grows
    assert Fault.STALE in found


def test_two_clocks_may_drift_apart():
    watched = SupervisedTraining().settle()
    for _ in range(3000):
        status = watched.sound()
        assert watched.check(replace(status, time=CLOCK + 1.0003 * (status.time - CLOCK))) == Fault.NONE


def test_the_robots_clock_may_start_anew():
    """Its driver was started again: it is a fault once, and then another clock."""
    watched = SupervisedTraining().settle()
    assert watched.check(replace(watched.sound(), time=1.0)) == Fault.OUT_OF_ORDER
    start = watched.step
    for _ in range(round(LIMITS.settling_time / PERIOD) + 3):
        watched.check(replace(watched.sound(), time=1.0 + (watched.step - start + 1) * PERIOD))
    assert watched.fault == Fault.NONE


def test_an_initialization_forgets():
    watched = SupervisedTraining().settle()
    watched.simulator.Initialize()
    assert watched.fault == Fault.NO_STATUS


def test_every_fault_is_in_words():
    assert set(FAULT_DESCRIPTIONS) == set(Fault)


@pytest.mark.parametrize(
    "wrong",
    [
        {"velocity": ()},
        {"max_age": 0.0},
        {"position_jump": np.nan},
        *({name: value} for name in ("settling_time", "clock_drift") for value in (-1.0, np.nan, np.inf)),
    ],
)
def test_refuses_limits_that_make_no_sense(wrong):
    with pytest.raises(InputError):
        StatusLimits(**({"velocity": (1.0,)} | wrong))


def test_refuses_a_period_that_is_none():
    with pytest.raises(InputError):
        StatusWatchdog(LIMITS, period=0.0)


class WithClock(SupervisedTraining):
    """The same by the clock on the wall, which goes by itself."""

    def __init__(self):
        super().__init__()
        self.wall = 5000.0

    def check(self, status, gap=PERIOD):
        self.wall += gap
        self.system.get_clock_input_port().FixValue(self.context, [self.wall])
        return super().check(status)

    def sound(self, gap=PERIOD):
        return replace(super().sound(), time=CLOCK + self.wall + gap)


def test_by_the_clock_on_the_wall_a_delay_of_ones_own_is_no_fault_of_the_status():
    """A program that was held up for a few periods finds a status that is as much newer, and goes on."""
    watched = WithClock().settle()
    for gap in (3.0, 1.0, 4.0, 0.5):
        assert watched.check(watched.sound(gap * PERIOD), gap * PERIOD) == Fault.NONE
        assert watched.age <= PERIOD


def test_a_program_that_was_held_up_for_too_long_says_so_and_believes_the_newest_status():
    watched = WithClock().settle()
    status = watched.sound(0.2)
    assert watched.check(status, 0.2) == Fault.DEADLINE_MISSED
    np.testing.assert_array_equal(watched.state, status.values()[:4])
    assert watched.check(watched.sound()) == Fault.DEADLINE_MISSED  # until it has settled again
    watched.settle()


def test_by_the_clock_on_the_wall_a_status_that_stops_is_stale_however_few_checks_there_were():
    watched = WithClock().settle()
    last = watched.sound()
    watched.check(last)
    gap = 0.7 * LIMITS.max_check_interval
    assert [watched.check(last, gap) for _ in range(2)] == [Fault.NONE, Fault.STALE]
    assert watched.age == pytest.approx(2.0 * gap + PERIOD)  # at the next check


def test_what_came_after_a_check_is_not_judged_by_what_the_clock_showed_then():
    watched = WithClock().settle()
    early = replace(watched.sound(), time=watched.sound().time + LIMITS.max_lead - 0.5 * PERIOD)
    watched.port.GetMutableData().set_value(early)
    assert watched.fault == Fault.NONE
    assert watched.check(early) == Fault.NONE


def test_what_comes_soonest_tells_how_late_all_others_are():
    """Statuses that were late when the clocks were synchronized don't make later ones pass for punctual."""
    watched = SupervisedTraining().settle()

    def delayed(by):
        return replace(watched.sound(), time=watched.sound().time - by * LIMITS.max_age)

    last = watched.sound()
    while watched.check(last) != Fault.STALE:
        pass
    for _ in range(2 * round(LIMITS.settling_time / PERIOD)):
        watched.check(delayed(1.2))
    assert watched.fault == Fault.NONE
    for _ in range(20):
        assert watched.check(delayed(0.4)) == Fault.NONE
    assert {watched.check(delayed(1.2)) for _ in range(10)} == {Fault.NONE}
    watched.port.GetMutableData().set_value(delayed(1.2))
    assert watched.age == pytest.approx(0.8 * LIMITS.max_age, rel=0.05)
    assert Fault.STALE in {watched.check(delayed(1.6)) for _ in range(10)}


def test_a_single_status_that_is_a_little_early_makes_no_other_late():
    watched = SupervisedTraining().settle()
    sound, lead = watched.sound(), 0.9 * LIMITS.max_lead
    watched.check(replace(sound, time=sound.time + lead, positions=sound.positions + 0.1 * lead))
    for _ in range(50):
        assert watched.check(watched.sound()) == Fault.NONE


def test_the_limits_follow_from_the_rate():
    limits = StatusLimits.at_rate((1.0, 2.0), 0.005)
    assert (limits.max_age, limits.max_lead, limits.max_check_interval) == (0.03, 0.03, 0.03)
    with pytest.raises(InputError):
        StatusLimits((1.0,), max_check_interval=0.0)


def test_a_speed_with_which_nothing_moves_is_never_believed():
    """The first such status is a jump; the ones after it agree with each other, and with no motion."""
    watched = SupervisedTraining().settle()
    before = watched.state
    for _ in range(5):
        sound = watched.sound()
        assert watched.check(replace(sound, velocities=sound.velocities + 3.0)) == Fault.VELOCITY_JUMP
        np.testing.assert_array_equal(watched.state[2:], before[2:])


def test_a_status_that_was_overtaken_counts_as_none():
    watched = SupervisedTraining().settle()
    late = watched.sound()
    watched.check(watched.sound())
    newest = watched.sound()
    watched.check(newest)
    changed = replace(late, external_torque=late.external_torque + 50.0)
    assert watched.check(changed) == Fault.NONE
    np.testing.assert_array_equal(watched.state, newest.values()[:4])
    assert watched.age > 0.0
    assert watched.check(watched.sound()) == Fault.NONE


def test_after_a_silence_nothing_is_believed_before_it_has_settled():
    """How late the statuses are that come then nobody knows."""
    watched = SupervisedTraining().settle()
    before = watched.sound()
    watched.check(before)
    for _ in range(20):
        watched.check(before)
    assert watched.fault == Fault.STALE
    late = [replace(watched.sound(), time=watched.sound().time - 0.05 + k * PERIOD) for k in range(10)]
    for status in late:
        watched.check(status)
        np.testing.assert_array_equal(watched.state, before.values()[:4])
        assert watched.age > LIMITS.max_age


@pytest.mark.parametrize("seconds", [-1.0, 1.0])
def test_after_a_stray_status_what_keeps_to_the_known_clock_is_believed_at_once(seconds):
    """Whoever damps needs the arm's speed now; the fault is reported all the same."""
    watched = SupervisedTraining().settle()
    watched.check(replace(watched.sound(), time=watched.sound().time + seconds))
    fault = watched.fault
    for _ in range(3):
        status = watched.sound()
        assert watched.check(status) == fault
        np.testing.assert_array_equal(watched.state, status.values()[:4])
    late = replace(status, time=status.time + 0.25 * PERIOD, velocities=status.velocities + 0.3)
    for _ in range(5):
        watched.check(late)
    np.testing.assert_array_equal(watched.state, late.values()[:4])  # fresh when it came
    again = replace(watched.sound(), time=watched.sound().time - 0.75 * LIMITS.max_age)
    watched.check(again)
    np.testing.assert_array_equal(watched.state, late.values()[:4])  # too late to damp by


@pytest.mark.parametrize("between", [Fault.MALFORMED, Fault.POSITION_JUMP], ids=lambda fault: fault.name)
def test_another_clock_is_not_believed_before_it_has_settled_whatever_else_goes_wrong(between):
    watched = SupervisedTraining().settle()

    def set_back():
        status = watched.sound()
        return replace(status, time=status.time - 1.0, velocities=status.velocities + 0.05)

    for step in range(round(0.9 * LIMITS.settling_time / PERIOD)):
        watched.check(WRONG[between](set_back()) if step == 3 else set_back())
        np.testing.assert_array_equal(watched.state[2:], 0.1)
        assert watched.age > 0.0
    for _ in range(round(LIMITS.settling_time / PERIOD)):
        watched.check(set_back())
    assert watched.fault == Fault.NONE
    np.testing.assert_allclose(watched.state[2:], 0.15)


def test_a_position_that_has_jumped_and_stays_is_not_believed_before_it_has_settled():
    """Its inertia is that of another posture, and damping by it may drive the arm."""
    watched = SupervisedTraining().settle()

    def slipped():
        return replace(watched.sound(), positions=watched.sound().positions + [2.5, 0.0])

    for _ in range(round(0.9 * LIMITS.settling_time / PERIOD)):
        watched.check(slipped())
        assert watched.state[0] < 1.0
        assert watched.fault == Fault.POSITION_JUMP
    for _ in range(round(0.2 * LIMITS.settling_time / PERIOD)):
        watched.check(slipped())
    assert watched.fault == Fault.NONE
    assert watched.state[0] > 2.5


def test_the_ports_have_the_sizes_that_they_say():
    system = StatusWatchdog(LIMITS, period=PERIOD)
    ports = [system.get_output_port(i) for i in range(system.num_output_ports())]
    assert {port.get_name(): port.size() for port in ports} == {
        **{"estimated_state": 4, "external_torque": 2, "fault": 1, "age": 1, "is_new": 1}
    }
    assert system.get_clock_input_port().size() == 1


def test_new_is_what_is_believed_and_was_not_there_before():
    watched = SupervisedTraining().settle()
    is_new = watched.system.get_is_new_output_port()
    sound = watched.sound()
    jumped = WRONG[Fault.POSITION_JUMP](sound)
    for status, expected in ((sound, 1.0), (None, 0.0), (MALFORMED_STATUS, 0.0), (jumped, 0.0), (sound, 1.0)):
        watched.port.GetMutableData().set_value(status or object())
        assert is_new.Eval(watched.context)[0] == expected
    watched.check(sound)
    assert is_new.Eval(watched.context)[0] == 0.0  # it has been taken in


def test_before_any_status_the_age_is_the_time_since_the_start():
    watched = SupervisedTraining()
    assert watched.age == 0.0
    for _ in range(5):
        watched.check(None)
    assert watched.age == pytest.approx(5 * PERIOD, abs=1.5 * PERIOD)


def test_statuses_that_fall_behind_one_after_another_stay_stale():
    """Each is new, and none of them says that the clocks differ by as much."""
    watched = SupervisedTraining().settle()
    queue = [watched.sound()]
    while watched.step * PERIOD + CLOCK - queue[0].time < 1.5 * LIMITS.max_age:
        for _ in range(2):  # two come for each that is read
            queue.append(watched.sound())
            watched.check(queue[0])
        queue.pop(0)
    for _ in range(2 * round(LIMITS.settling_time / PERIOD)):
        queue.append(watched.sound())
        assert watched.check(queue.pop(0)) == Fault.STALE


def test_after_a_silence_the_clocks_are_synchronized_anew():
    watched = SupervisedTraining().settle()
    last = watched.sound()
    for _ in range(round(3.0 * LIMITS.max_age / PERIOD)):
        watched.check(last)
    for _ in range(round(LIMITS.settling_time / PERIOD) + 3):
        sound = watched.sound()
        watched.check(replace(sound, time=sound.time - 1.2 * LIMITS.max_age))
    assert watched.fault == Fault.NONE


def test_what_was_known_is_no_news_after_a_stray_status():
    watched = SupervisedTraining().settle()
    known = watched.sound()
    watched.check(known)
    watched.check(replace(watched.sound(), time=watched.sound().time + 1.0))
    assert watched.check(known) == Fault.OUT_OF_ORDER
    assert watched.age > PERIOD
