"""Checks of a status against its predecessor, on both sides of each limit."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail_hardware.models.joint_status import (
    MALFORMED_STATUS,
    MAX_MISSED_MESSAGES,
    MAX_SENDERS,
    STATUS_FAULTS,
    Fault,
    Heartbeat,
    JointStatus,
    LastStatus,
    StatusLimits,
    check_status,
    damping_torque,
    is_hold_ineffective,
    parse_status,
)

# Dyadic numbers, so that rounding does not decide on a value exactly at a limit.
LIMITS = StatusLimits(
    velocity=(1.0, 2.0), max_age=0.03125, max_lead=0.0625, position_jump=0.015625, velocity_jump=1.5, settling_time=0.25
)
LAST = LastStatus(16.0, 100.0, np.array([0.5, -0.5, 0.25, -0.25, 3.0, 4.0]))
ELAPSED = 0.0078125
EPSILON = 2.0**-30


def status(time=16.0 + ELAPSED, positions=(0.5, -0.5), velocities=(0.25, -0.25), external=(3.0, 4.0)):
    return JointStatus(time, np.array(positions), np.array(velocities), np.array(external))


def check(now=116.0 + ELAPSED, last=LAST, **changed):
    return check_status(status(**changed), last, now, LIMITS)


def test_valid_status_is_no_fault():
    assert check() == Fault.NONE


def test_missing_and_malformed_statuses_are_faults():
    assert check_status(None, LAST, 116.0, LIMITS) == Fault.NO_STATUS
    assert check_status(MALFORMED_STATUS, LAST, 116.0, LIMITS) == Fault.MALFORMED
    assert not MALFORMED_STATUS.is_readable
    assert not MALFORMED_STATUS.values().size
    assert status().is_readable
    assert not status(time=np.inf).is_readable


class Unreadable:
    def __repr__(self):
        return "unreadable"  # test ids must not depend on the address of the object

    def __array__(self, *arguments, **keywords):
        raise OSError("cable unplugged")


FIELDS = ("positions", "velocities", "external_torque")
INVALID_VALUES = [["a", "b"], "text", None, [None, 0.0], [0.5j, 0.0], [True, False], [[0.0], [0.0, 0.0]], Unreadable()]
INVALID_VALUES += [b"ab", {}, [10**400, 0.0], np.array(["NaT", "NaT"], dtype="datetime64[s]")]


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", INVALID_VALUES, ids=str)
def test_field_of_wrong_type_is_malformed(field, value):
    assert parse_status(replace(status(), **{field: value})) is MALFORMED_STATUS


@pytest.mark.parametrize("field", ["time", "conflicts", "foreign_commands"])
@pytest.mark.parametrize("value", ["now", None, 1j, True, [16.0], np.zeros(2), Unreadable()], ids=str)
def test_scalar_of_wrong_type_is_malformed(field, value):
    assert parse_status(replace(status(), **{field: value})) is MALFORMED_STATUS


@pytest.mark.parametrize("field", ["conflicts", "foreign_commands"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_counter_that_is_not_finite_is_malformed(field, value):
    assert parse_status(replace(status(), **{field: value})) is MALFORMED_STATUS


@pytest.mark.parametrize(
    "value",
    [{"time": 1.0}, "status", 0, False, Unreadable(), SimpleNamespace(**vars(status()))],
    ids=lambda v: repr(v)[:9],
)
def test_object_of_another_type_is_malformed(value):
    assert parse_status(value) is MALFORMED_STATUS


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("value", [np.zeros(n) for n in ((), 0, 1, 3, (2, 1), (1, 2), (2, 2))], ids=np.shape)
def test_field_of_wrong_shape_is_a_fault(field, value):
    assert check_status(replace(status(), **{field: value}), LAST, 116.0, LIMITS) == Fault.WRONG_SIZE


def test_parsed_status_has_the_same_numbers_in_its_own_arrays():
    original = replace(status(), conflicts=2, foreign_commands=3, round_trip=0.25)
    parsed = parse_status(original)
    assert (parsed.time, parsed.conflicts, parsed.foreign_commands, parsed.round_trip) == (original.time, 2, 3, 0.25)
    np.testing.assert_array_equal(parsed.values(), original.values())
    original.positions[0] = 7.0
    assert parsed.positions[0] == 0.5
    np.testing.assert_array_equal(parse_status(replace(status(), positions=[0, -1])).positions, [0.0, -1.0])
    assert parse_status(None) is None


@pytest.mark.parametrize("field", ["positions", "velocities", "external"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_value_that_is_not_finite_is_a_fault(field, value):
    assert check(**{field: (0.25, value)}) == Fault.NOT_FINITE


@pytest.mark.parametrize("time", [np.nan, np.inf])
def test_first_status_is_not_compared(time):
    first = replace(LAST, time=time)
    assert check(now=0.0, last=first, positions=(9.0, 9.0), velocities=(9.0, 9.0)) == Fault.NONE
    assert check(now=0.0, last=first, positions=(9.0, np.nan)) == Fault.NOT_FINITE


@pytest.mark.parametrize(
    ("time", "now", "fault"),
    [
        (16.0 - 0.03125, 116.0 - 0.03125, Fault.NONE),
        (16.0 - 0.03125 - EPSILON, 116.0 - 0.03125, Fault.OUT_OF_ORDER),
        (16.0 + ELAPSED, 116.0 + ELAPSED - 0.0625, Fault.NONE),
        (16.0 + ELAPSED, 116.0 + ELAPSED - 0.0625 - EPSILON, Fault.FUTURE),
        (16.0 + ELAPSED, 116.0 + ELAPSED + 0.03125, Fault.NONE),
        (16.0 + ELAPSED, 116.0 + ELAPSED + 0.03125 + EPSILON, Fault.STALE),
        (16.0, 116.0 + 0.03125 + EPSILON, Fault.STALE),
    ],
)
def test_time_is_checked_at_its_limits(time, now, fault):
    assert check(now, time=time) == fault


def test_repeated_status_is_not_compared():
    assert check(now=116.0, time=16.0, positions=(9.0, 9.0)) == Fault.NONE


# Maximum change of each position [rad]: position_jump plus the maximum velocity times ELAPSED.
MAX_CHANGE = (0.015625 + ELAPSED, 0.015625 + 2.0 * ELAPSED)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("joint", [0, 1])
def test_jumps_are_checked_at_their_limits(joint, sign):
    def changed(start, by):
        values = np.array(start)
        values[joint] += sign * by
        return values

    assert check(positions=changed((0.5, -0.5), MAX_CHANGE[joint])) == Fault.NONE
    assert check(positions=changed((0.5, -0.5), MAX_CHANGE[joint] + EPSILON)) == Fault.POSITION_JUMP
    assert check(velocities=changed((0.25, -0.25), 1.5)) == Fault.NONE
    assert check(velocities=changed((0.25, -0.25), 1.5 + EPSILON)) == Fault.VELOCITY_JUMP
    assert check(external=changed((3.0, 4.0), 1000.0)) == Fault.NONE


def test_position_is_checked_against_the_position_jump():
    limits = replace(LIMITS, position_jump=4.0)
    assert check_status(status(positions=(3.5, -0.5)), LAST, 116.0 + ELAPSED, limits) == Fault.NONE


def test_message_counters_are_zero_by_default():
    assert (status().conflicts, status().foreign_commands, Heartbeat(1, False).sender) == (0, 0, 0)
    assert MAX_SENDERS == 8


def test_values_are_positions_velocities_and_external_torques():
    np.testing.assert_array_equal(status().values(), [0.5, -0.5, 0.25, -0.25, 3.0, 4.0])


POSITIVE = ("max_age", "max_lead", "position_jump", "velocity_jump", "position_tolerance", "velocity_noise")


@pytest.mark.parametrize(
    "changes",
    [
        {"velocity": ()},
        *({name: value} for name in (*POSITIVE, "max_check_interval") for value in (0.0, np.nan, np.inf)),
        *({"velocity": (1.0, value)} for value in (0.0, -1.0, np.nan, np.inf)),
        *({name: value} for name in ("settling_time", "clock_drift") for value in (-1.0, np.nan, np.inf)),
        *({"max_round_trip": value} for value in (0.0, -1.0, np.nan)),
    ],
    ids=str,
)
def test_limits_refuse_values_out_of_range(changes):
    with pytest.raises(InputError):
        StatusLimits(**({"velocity": (1.0,)} | changes))


def test_limits_accept_the_ends_of_their_ranges():
    limits = StatusLimits((1e-9,), settling_time=0.0, clock_drift=0.0, max_round_trip=1e-9)
    assert (limits.settling_time, limits.clock_drift, limits.max_round_trip) == (0.0, 0.0, 1e-9)


def test_limits_have_their_documented_values():
    limits = StatusLimits((1.0,))
    assert (limits.max_age, limits.max_lead, limits.max_check_interval) == (0.03, 0.03, 0.03)
    assert (limits.position_jump, limits.velocity_jump) == (0.02, 1.5)
    assert (limits.position_tolerance, limits.velocity_noise) == (1e-3, 0.02)
    assert (limits.settling_time, limits.clock_drift) == (0.25, 1e-3)


def test_limits_follow_from_the_rate():
    assert MAX_MISSED_MESSAGES == 6
    limits = StatusLimits.at_rate([1.0, 2.0], 0.0078125, settling_time=0.5)
    assert limits.velocity == (1.0, 2.0)
    assert (limits.max_age, limits.max_lead, limits.max_check_interval) == (0.046875,) * 3
    assert limits.settling_time == 0.5


def test_faults_have_distinct_codes_and_descriptions():
    assert [fault.value for fault in Fault] == list(range(len(Fault)))
    assert len({fault.description for fault in Fault}) == len(Fault)
    assert all(fault.description for fault in Fault)
    assert list(STATUS_FAULTS) == [fault for fault in Fault if 1 <= fault <= 14 or fault == Fault.ROUND_TRIP]
    assert (Fault.NO_STATUS, Fault.CLOCK_RATE) == (1, 14)


def test_damping_torque_multiplies_the_velocity_by_its_decay():
    M, v = np.array([[2.0, 0.5], [0.5, 1.0]]), np.array([0.3, -0.4])
    torque = damping_torque(M, v, 0.02, period=0.005)
    np.testing.assert_allclose(v + 0.005 * np.linalg.solve(M, torque), np.exp(-0.25) * v, rtol=1e-12)


@pytest.mark.parametrize(
    ("speed", "initial", "elapsed", "expected"),
    [
        (0.25, 0.4, 0.05, True),
        (0.25, 0.4, 0.0499, False),
        (0.2, 0.4, 0.05, False),
        (0.2001, 0.4, 1.0, True),
        (0.0499, 0.06, 1.0, False),  # slow enough, although more than half of the initial speed
        (0.05002, 0.06, 1.0, True),
        (0.05, 0.06, 1.0, False),
        (np.nan, 0.4, 1.0, False),
    ],
)
def test_hold_is_ineffective_unless_the_speed_halves_in_time(speed, initial, elapsed, expected):
    assert is_hold_ineffective(speed, initial, elapsed) == expected


def test_heartbeat_knows_no_command_by_default():
    assert Heartbeat(1, False) == Heartbeat(1, False, sender=0, command=-1)
