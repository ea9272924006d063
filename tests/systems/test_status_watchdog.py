from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.control.joint_status import MALFORMED_STATUS, Fault, JointStatus, StatusLimits
from guiderail.systems.status_watchdog import StatusWatchdog

PERIOD = 1.0 / 256.0
LIMITS = StatusLimits(velocity=(1.0, 1.0))
CLOCK = 1000.0  # robot time at local time zero [s]


class Rig:
    """Watchdog of a robot with joint velocities of 0.1 rad/s, with a status just before each check."""

    def __init__(self, limits=LIMITS):
        self.system = StatusWatchdog(limits, period=PERIOD)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.port = self.system.get_status_input_port().FixValue(self.context, Value[object]())
        self.step = 0
        self.simulator.Initialize()

    def valid_status(self):
        time = self.step * PERIOD
        return JointStatus(CLOCK + time, np.array([0.1, 0.1]) * time, np.full(2, 0.1), np.array([3.0, 4.0]))

    def check(self, status):
        """Set the newest status, advance by one check, and return the fault before the event of the check."""
        self.port.GetMutableData().set_value(status or object())
        fault = self.fault
        self.step += 1
        self.simulator.AdvanceTo(self.step * PERIOD)
        return fault

    def settle(self):
        for _ in range(round(LIMITS.settling_time / PERIOD) + 3):
            self.check(self.valid_status())
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


def test_valid_status_is_output_at_once():
    rig = Rig().settle()
    status = rig.valid_status()
    rig.check(status)
    np.testing.assert_array_equal(rig.state, status.values()[:4])
    np.testing.assert_array_equal(rig.system.get_external_torque_output_port().Eval(rig.context), [3.0, 4.0])
    assert rig.age <= PERIOD


def test_fault_is_reported_during_the_settling_time():
    rig = Rig()
    assert rig.check(None) == Fault.NO_STATUS
    faults = [rig.check(rig.valid_status()) for _ in range(round(LIMITS.settling_time / PERIOD))]
    assert set(faults) == {Fault.NO_STATUS}
    rig.settle()


WRONG = {
    Fault.OUT_OF_ORDER: lambda status: replace(status, time=status.time - 1.0),
    Fault.FUTURE: lambda status: replace(status, time=status.time + 1.0),
    Fault.MALFORMED: lambda status: MALFORMED_STATUS,
    Fault.WRONG_SIZE: lambda status: replace(status, velocities=np.zeros(3)),
    Fault.NOT_FINITE: lambda status: replace(status, external_torque=np.array([np.nan, 0.0])),
    Fault.POSITION_JUMP: lambda status: replace(status, positions=status.positions + [0.0, 0.05]),
    Fault.VELOCITY_JUMP: lambda status: replace(status, velocities=status.velocities + [2.0, 0.0]),
}


@pytest.mark.parametrize("fault", WRONG, ids=lambda fault: fault.name)
def test_faulty_status_is_reported_and_not_accepted(fault):
    rig = Rig().settle()
    before = rig.state
    wrong = WRONG[fault](rig.valid_status())
    assert rig.check(wrong) == fault
    np.testing.assert_array_equal(rig.state, before)
    assert rig.age > 0.0
    # A single outlier: the next status is compared with it, and its values are never accepted.
    steps = 0
    while rig.fault:
        steps += 1
        rig.check(rig.valid_status())
        assert np.abs(rig.state).max() < 0.2
    assert LIMITS.settling_time <= steps * PERIOD <= LIMITS.settling_time + 4 * PERIOD
    rig.check(rig.valid_status())
    np.testing.assert_array_equal(rig.state, previous_status(rig).values()[:4])


def previous_status(rig):
    rig.step -= 1
    status = rig.valid_status()
    rig.step += 1
    return status


def test_status_is_stale_when_it_is_repeated():
    rig = Rig().settle()
    last = rig.valid_status()
    faults = [rig.check(last) for _ in range(20)]
    first = faults.index(Fault.STALE)
    assert LIMITS.max_age < first * PERIOD < LIMITS.max_age + 3 * PERIOD
    assert set(faults[first:]) == {Fault.STALE}
    assert rig.age == pytest.approx(20 * PERIOD, abs=1.5 * PERIOD)
    # The next status is new, but it is not accepted before the settling time is over.
    assert rig.check(rig.valid_status()) == Fault.STALE
    rig.settle()


def test_late_status_is_stale():
    rig = Rig().settle()
    queue = []
    faults = []
    for step in range(40):
        queue.append(rig.valid_status())
        faults.append(rig.check(queue[step // 2]))  # a growing queue
    assert Fault.STALE in faults


def test_clock_drift_is_no_fault():
    rig = Rig().settle()
    for _ in range(3000):
        status = rig.valid_status()
        assert rig.check(replace(status, time=CLOCK + 1.0003 * (status.time - CLOCK))) == Fault.NONE


def test_watchdog_recovers_when_the_robot_clock_restarts():
    """After a restart of the driver there is one fault, then a new clock."""
    rig = Rig().settle()
    assert rig.check(replace(rig.valid_status(), time=1.0)) == Fault.OUT_OF_ORDER
    start = rig.step
    for _ in range(round(LIMITS.settling_time / PERIOD) + 3):
        rig.check(replace(rig.valid_status(), time=1.0 + (rig.step - start + 1) * PERIOD))
    assert rig.fault == Fault.NONE


def test_initialization_resets_the_state():
    rig = Rig().settle()
    rig.simulator.Initialize()
    assert rig.fault == Fault.NO_STATUS


def test_every_fault_has_a_description():
    assert all(fault.description for fault in Fault)


@pytest.mark.parametrize(
    "wrong",
    [
        {"velocity": ()},
        {"max_age": 0.0},
        {"position_jump": np.nan},
        *({name: value} for name in ("settling_time", "clock_drift") for value in (-1.0, np.nan, np.inf)),
    ],
)
def test_limits_refuse_values_out_of_range(wrong):
    with pytest.raises(InputError):
        StatusLimits(**({"velocity": (1.0,)} | wrong))


def test_constructor_refuses_a_period_out_of_range():
    with pytest.raises(InputError):
        StatusWatchdog(LIMITS, period=0.0)


class WithClock(Rig):
    """Rig with a connected wall clock."""

    def __init__(self):
        super().__init__()
        self.wall = 5000.0

    def check(self, status, gap=PERIOD):
        self.wall += gap
        self.system.get_clock_input_port().FixValue(self.context, [self.wall])
        return super().check(status)

    def valid_status(self, gap=PERIOD):
        return replace(super().valid_status(), time=CLOCK + self.wall + gap)


def test_own_delay_is_no_status_fault_with_a_clock():
    """After a delay of a few periods the newest status is accepted without a fault."""
    rig = WithClock().settle()
    for gap in (3.0, 1.0, 4.0, 0.5):
        assert rig.check(rig.valid_status(gap * PERIOD), gap * PERIOD) == Fault.NONE
        assert rig.age <= PERIOD


def test_long_own_delay_is_a_missed_deadline():
    rig = WithClock().settle()
    status = rig.valid_status(0.2)
    assert rig.check(status, 0.2) == Fault.DEADLINE_MISSED
    np.testing.assert_array_equal(rig.state, status.values()[:4])
    assert rig.check(rig.valid_status()) == Fault.DEADLINE_MISSED  # until the settling time is over
    rig.settle()


def test_status_is_stale_by_the_clock_after_few_checks():
    rig = WithClock().settle()
    last = rig.valid_status()
    rig.check(last)
    gap = 0.7 * LIMITS.max_check_interval
    assert [rig.check(last, gap) for _ in range(2)] == [Fault.NONE, Fault.STALE]
    assert rig.age == pytest.approx(2.0 * gap + PERIOD)  # at the next check


def test_unchanged_clock_input_is_not_used_twice():
    rig = WithClock().settle()
    early = replace(rig.valid_status(), time=rig.valid_status().time + LIMITS.max_lead - 0.5 * PERIOD)
    rig.port.GetMutableData().set_value(early)
    assert rig.fault == Fault.NONE
    assert rig.check(early) == Fault.NONE


def test_earliest_status_determines_the_delay_of_others():
    """If the clocks were synchronized with late statuses, later ones are still detected as late."""
    rig = Rig().settle()

    def delayed(by):
        return replace(rig.valid_status(), time=rig.valid_status().time - by * LIMITS.max_age)

    last = rig.valid_status()
    while rig.check(last) != Fault.STALE:
        pass
    for _ in range(2 * round(LIMITS.settling_time / PERIOD)):
        rig.check(delayed(1.2))
    assert rig.fault == Fault.NONE
    for _ in range(20):
        assert rig.check(delayed(0.4)) == Fault.NONE
    assert {rig.check(delayed(1.2)) for _ in range(10)} == {Fault.NONE}
    rig.port.GetMutableData().set_value(delayed(1.2))
    assert rig.age == pytest.approx(0.8 * LIMITS.max_age, rel=0.05)
    assert Fault.STALE in {rig.check(delayed(1.6)) for _ in range(10)}


def test_single_early_status_does_not_make_others_late():
    rig = Rig().settle()
    status, lead = rig.valid_status(), 0.9 * LIMITS.max_lead
    rig.check(replace(status, time=status.time + lead, positions=status.positions + 0.1 * lead))
    for _ in range(50):
        assert rig.check(rig.valid_status()) == Fault.NONE


def test_limits_follow_from_the_rate():
    limits = StatusLimits.at_rate((1.0, 2.0), 0.005)
    assert (limits.max_age, limits.max_lead, limits.max_check_interval) == (0.03, 0.03, 0.03)
    with pytest.raises(InputError):
        StatusLimits((1.0,), max_check_interval=0.0)


def test_velocity_is_not_accepted_when_positions_do_not_change():
    """The first such status is a jump; the following ones agree with each other but not with the positions."""
    rig = Rig().settle()
    before = rig.state
    for _ in range(5):
        status = rig.valid_status()
        assert rig.check(replace(status, velocities=status.velocities + 3.0)) == Fault.VELOCITY_JUMP
        np.testing.assert_array_equal(rig.state[2:], before[2:])


def test_reordered_status_is_dropped():
    rig = Rig().settle()
    late = rig.valid_status()
    rig.check(rig.valid_status())
    newest = rig.valid_status()
    rig.check(newest)
    changed = replace(late, external_torque=late.external_torque + 50.0)
    assert rig.check(changed) == Fault.NONE
    np.testing.assert_array_equal(rig.state, newest.values()[:4])
    assert rig.age > 0.0
    assert rig.check(rig.valid_status()) == Fault.NONE


def test_no_status_is_accepted_before_settling_after_a_timeout():
    """The delay of the following statuses is unknown."""
    rig = Rig().settle()
    before = rig.valid_status()
    rig.check(before)
    for _ in range(20):
        rig.check(before)
    assert rig.fault == Fault.STALE
    late = [replace(rig.valid_status(), time=rig.valid_status().time - 0.05 + k * PERIOD) for k in range(10)]
    for status in late:
        rig.check(status)
        np.testing.assert_array_equal(rig.state, before.values()[:4])
        assert rig.age > LIMITS.max_age


@pytest.mark.parametrize("seconds", [-1.0, 1.0])
def test_agreeing_status_is_accepted_at_once_after_a_stray_one(seconds):
    """Damping needs the present velocity; the fault is still reported."""
    rig = Rig().settle()
    rig.check(replace(rig.valid_status(), time=rig.valid_status().time + seconds))
    fault = rig.fault
    for _ in range(3):
        status = rig.valid_status()
        assert rig.check(status) == fault
        np.testing.assert_array_equal(rig.state, status.values()[:4])
    late = replace(status, time=status.time + 0.25 * PERIOD, velocities=status.velocities + 0.3)
    for _ in range(5):
        rig.check(late)
    np.testing.assert_array_equal(rig.state, late.values()[:4])  # fresh on arrival
    again = replace(rig.valid_status(), time=rig.valid_status().time - 0.75 * LIMITS.max_age)
    rig.check(again)
    np.testing.assert_array_equal(rig.state, late.values()[:4])  # too old for damping


@pytest.mark.parametrize("between", [Fault.MALFORMED, Fault.POSITION_JUMP], ids=lambda fault: fault.name)
def test_new_clock_is_not_accepted_before_settling(between):
    rig = Rig().settle()

    def set_back():
        status = rig.valid_status()
        return replace(status, time=status.time - 1.0, velocities=status.velocities + 0.05)

    for step in range(round(0.9 * LIMITS.settling_time / PERIOD)):
        rig.check(WRONG[between](set_back()) if step == 3 else set_back())
        np.testing.assert_array_equal(rig.state[2:], 0.1)
        assert rig.age > 0.0
    for _ in range(round(LIMITS.settling_time / PERIOD)):
        rig.check(set_back())
    assert rig.fault == Fault.NONE
    np.testing.assert_allclose(rig.state[2:], 0.15)


def test_jumped_position_is_not_accepted_before_settling():
    """Damping with the inertia of another posture may drive the arm."""
    rig = Rig().settle()

    def slipped():
        return replace(rig.valid_status(), positions=rig.valid_status().positions + [2.5, 0.0])

    for _ in range(round(0.9 * LIMITS.settling_time / PERIOD)):
        rig.check(slipped())
        assert rig.state[0] < 1.0
        assert rig.fault == Fault.POSITION_JUMP
    for _ in range(round(0.2 * LIMITS.settling_time / PERIOD)):
        rig.check(slipped())
    assert rig.fault == Fault.NONE
    assert rig.state[0] > 2.5


def test_ports_have_their_documented_sizes():
    system = StatusWatchdog(LIMITS, period=PERIOD)
    ports = [system.get_output_port(i) for i in range(system.num_output_ports())]
    assert {port.get_name(): port.size() for port in ports} == {
        **{"estimated_state": 4, "external_torque": 2, "fault": 1, "age": 1, "is_new": 1}
    }
    assert system.get_clock_input_port().size() == 1


def test_is_new_is_set_only_for_a_new_accepted_status():
    rig = Rig().settle()
    is_new = rig.system.get_is_new_output_port()
    valid = rig.valid_status()
    jumped = WRONG[Fault.POSITION_JUMP](valid)
    for status, expected in ((valid, 1.0), (None, 0.0), (MALFORMED_STATUS, 0.0), (jumped, 0.0), (valid, 1.0)):
        rig.port.GetMutableData().set_value(status or object())
        assert is_new.Eval(rig.context)[0] == expected
    rig.check(valid)
    assert is_new.Eval(rig.context)[0] == 0.0  # already accepted


def test_age_is_the_time_since_start_before_the_first_status():
    rig = Rig()
    assert rig.age == 0.0
    for _ in range(5):
        rig.check(None)
    assert rig.age == pytest.approx(5 * PERIOD, abs=1.5 * PERIOD)


def test_statuses_with_growing_delay_remain_stale():
    """Each status is new, but the growing delay must not be taken for a clock offset."""
    rig = Rig().settle()
    queue = [rig.valid_status()]
    while rig.step * PERIOD + CLOCK - queue[0].time < 1.5 * LIMITS.max_age:
        for _ in range(2):  # two arrive for each one that is read
            queue.append(rig.valid_status())
            rig.check(queue[0])
        queue.pop(0)
    for _ in range(2 * round(LIMITS.settling_time / PERIOD)):
        queue.append(rig.valid_status())
        assert rig.check(queue.pop(0)) == Fault.STALE


def test_clocks_are_synchronized_again_after_a_timeout():
    rig = Rig().settle()
    last = rig.valid_status()
    for _ in range(round(3.0 * LIMITS.max_age / PERIOD)):
        rig.check(last)
    for _ in range(round(LIMITS.settling_time / PERIOD) + 3):
        status = rig.valid_status()
        rig.check(replace(status, time=status.time - 1.2 * LIMITS.max_age))
    assert rig.fault == Fault.NONE


def test_repeated_status_is_not_new_after_a_stray_one():
    rig = Rig().settle()
    known = rig.valid_status()
    rig.check(known)
    rig.check(replace(rig.valid_status(), time=rig.valid_status().time + 1.0))
    assert rig.check(known) == Fault.OUT_OF_ORDER
    assert rig.age > PERIOD
