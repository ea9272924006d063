"""Round trip of commands: its measurement, and the bound that gains tolerate, against a simulated delayed loop."""

import numpy as np
import pytest

from guiderail_hardware.models.round_trip import (
    EXPIRY,
    MAX_PENDING,
    WINDOW,
    RoundTrip,
    max_round_trip,
    to_microseconds,
)

PERIOD = 0.005


def run(latency, steps, round_trip=None, lost=()):
    """Send a command in each step, which is reported after `latency` steps; return the measurement."""
    round_trip = round_trip or RoundTrip()
    for step in range(steps):
        now = step * PERIOD
        newest = max((k for k in range(step - latency + 1) if k not in lost), default=None)
        round_trip.update(() if newest is None else (to_microseconds(newest * PERIOD),), now)
        round_trip.add_command(now, now)
    return round_trip


@pytest.mark.parametrize("latency", [1, 2, 3, 12])
def test_round_trip_is_the_time_from_command_to_report(latency):
    assert run(latency, latency + 30).seconds == pytest.approx(latency * PERIOD)


def test_constants_have_their_documented_values():
    assert (EXPIRY, MAX_PENDING, WINDOW) == (0.1, 400, 4)


@pytest.mark.parametrize(("number", "is_known"), [(0, False), (1, True)])
def test_only_the_newest_commands_are_awaited(number, is_known):
    """The arrival of the command with this number is reported after one more than `MAX_PENDING` commands."""
    round_trip, spacing = RoundTrip(), 1e-4
    for step in range(401):
        round_trip.add_command(step * spacing, step * spacing)
    round_trip.update({to_microseconds(number * spacing)}, 401 * spacing)
    assert np.isfinite(round_trip.seconds) == is_known


def test_round_trip_is_unknown_without_a_report():
    assert np.isnan(run(100, 50).seconds)
    round_trip = RoundTrip()
    round_trip.add_command(0.0, 0.0)
    round_trip.update((-1,), 0.005)
    assert np.isnan(round_trip.seconds)


@pytest.mark.parametrize("reported", [{-1}, {-1, 12}])
def test_unreported_first_commands_increase_the_round_trip(reported):
    """The messages report the same time stamps as before the first command."""
    round_trip = RoundTrip()
    round_trip.update(reported, -PERIOD)
    for step in range(10):
        round_trip.update({-1}, step * PERIOD)
        round_trip.add_command(step * PERIOD, step * PERIOD)
    assert round_trip.seconds == pytest.approx((10 - WINDOW) * PERIOD)


def test_round_trip_is_unknown_when_another_program_commands():
    round_trip = RoundTrip()
    round_trip.update({-1}, -PERIOD)
    for step in range(10):
        round_trip.update({1_000_000 + step}, step * PERIOD)
        round_trip.add_command(step * PERIOD, step * PERIOD)
    assert np.isnan(round_trip.seconds)


def test_lost_commands_are_no_latency():
    assert run(1, 40, lost={20, 21}).seconds == pytest.approx(PERIOD)
    assert run(1, 23, lost={20, 21}).seconds == pytest.approx(PERIOD)


@pytest.mark.parametrize("steps", [10, 25])
def test_commands_that_stay_unreported_increase_the_round_trip(steps):
    round_trip = run(1, 20)
    for step in range(20, 20 + steps):
        round_trip.update((to_microseconds(18 * PERIOD),), step * PERIOD)
        round_trip.add_command(step * PERIOD, step * PERIOD)
    assert round_trip.seconds == pytest.approx((steps - WINDOW + 1) * PERIOD)


@pytest.mark.parametrize(("elapsed", "is_known"), [(0.1, True), (np.nextafter(0.1, 1.0), False)])
def test_round_trip_is_unknown_after_the_last_command(elapsed, is_known):
    round_trip = RoundTrip()
    for stamp in (0.0, 1.0):
        round_trip.add_command(stamp, 0.0)
    round_trip.update({0}, 0.005)
    round_trip.update({0}, elapsed)
    assert np.isfinite(round_trip.seconds) == is_known
    assert round_trip.longest == 0.005


def test_measurement_begins_again_after_the_last_command():
    round_trip, start = run(1, 20), 20 * PERIOD + 2.0 * EXPIRY
    for step in range(WINDOW + 1):
        round_trip.update((), start + step * PERIOD)
        assert np.isnan(round_trip.seconds) == (step < WINDOW)
        round_trip.add_command(start + step * PERIOD, start + step * PERIOD)
    assert round_trip.seconds == pytest.approx(PERIOD)


def test_time_stamp_that_is_not_finite_is_unknown():
    assert to_microseconds(1.0) == 1_000_000
    assert (to_microseconds(np.nan), to_microseconds(np.inf), to_microseconds(1.5e-6)) == (-1, -1, 2)


def is_stable(frequency, damping_ratio, latency):
    """Return True if a mode decays whose spring and damper act after `latency` [s], held for `PERIOD`."""
    step = PERIOD / 50
    x, v = 1.0, 0.0
    states = [(x, v)]
    force = 0.0
    for k in range(round(3.0 / step)):
        if k % 50 == 0:
            old_x, old_v = states[max(len(states) - 1 - round(latency / step), 0)]
            force = -(frequency**2) * old_x - 2.0 * damping_ratio * frequency * old_v
        v += step * force
        x += step * v
        states.append((x, v))
    return max(abs(x) for x, _ in states[-1000:]) < 0.1


@pytest.mark.parametrize(("frequency", "damping_ratio"), [(35.0, 1.0), (35.0, 0.6), (20.0, 1.0)])
def test_loop_is_stable_at_the_bound_and_unstable_well_above(frequency, damping_ratio):
    longest = max_round_trip(np.array([3.0, frequency]), damping_ratio, 1.0, period=PERIOD)
    assert is_stable(frequency, damping_ratio, longest)
    assert not is_stable(frequency, damping_ratio, 1.5 * longest + 0.01)


def test_bound_keeps_the_margin_of_the_damping_of_a_stop():
    slow = np.array([0.1])
    assert max_round_trip(slow, 1.0, 0.02, period=PERIOD) == pytest.approx(0.02 * np.deg2rad(75.0) - 0.5 * PERIOD)


@pytest.mark.parametrize("damping_ratio", [0.5, 0.6, 1.4])
def test_bound_keeps_the_phase_margin_of_the_impedance(damping_ratio):
    """The loop's phase at its crossover frequency, found by bisection, with the delay of the bound."""
    natural, low, high = 20.0, 1.0, 1000.0
    delay = max_round_trip(np.array([natural]), damping_ratio, 1.0, period=PERIOD) + 0.5 * PERIOD

    def loop(frequency):
        s = 1j * frequency
        return (natural**2 + 2.0 * damping_ratio * natural * s) / s**2 * np.exp(-s * delay)

    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if abs(loop(middle)) > 1.0 else (low, middle)
    assert np.pi + np.angle(loop(low)) == pytest.approx(np.deg2rad(15.0), rel=1e-6)


def test_bound_decreases_with_stiffness():
    bounds = [max_round_trip(np.array([w]), 1.0, 1.0, period=PERIOD) for w in (10.0, 20.0, 40.0)]
    assert bounds == sorted(bounds, reverse=True)
    assert bounds[2] == pytest.approx(
        (np.arctan(2 * np.sqrt(2 + 5**0.5)) - np.deg2rad(15)) / (40 * 4.2361**0.5) - 0.0025, rel=1e-4
    )
