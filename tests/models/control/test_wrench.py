"""Bounded wrench of an impedance law: inside its bound for any input, passive, with a limited approach speed."""

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.control.wrench import (
    MovingInertia,
    WrenchBound,
    admissible_change,
    approach_bound,
    approach_impedance,
    bounded_wrench,
    check_spring_damper,
    clip_wrench,
    damping_share,
    governed_error,
    impact_ratio,
    norm_limits,
    slow_down,
    spring_energy,
)

AXES = np.array([9.0, 9.0, 15.0, 3.0, 3.0, 3.0])
BOUND = WrenchBound(AXES, 18.0, 4.0, 2.5e4, 0.03)
K, D, INERTIA = 1500.0, 95.0, MovingInertia(1.5, 2e-3)


def is_inside(wrench, bound=BOUND, tolerance=1e-9):
    force, torque = np.linalg.norm(wrench[:3]), np.linalg.norm(wrench[3:])
    within_axes = (np.abs(wrench) <= bound.axes + tolerance).all()
    return within_axes and force <= bound.force + tolerance and torque <= bound.torque + tolerance


def test_wrench_is_inside_the_bound_for_any_input():
    rng = np.random.default_rng(0)
    for _ in range(3000):
        spring, damping, velocity = (10.0 ** rng.uniform(-2, 3) * rng.normal(size=6) for _ in range(3))
        inertia = MovingInertia(rng.uniform(0.5, 20.0), rng.uniform(0.001, 0.1))
        assert is_inside(bounded_wrench(spring, damping, velocity, inertia, BOUND))


def test_law_is_spring_and_damper_at_small_wrenches():
    spring, velocity = np.array([2.0, -1.0, 3.0, 0.1, 0.2, -0.1]), np.array([0.004, 0.0, -0.003, 0.02, 0.0, 0.0])
    damping = np.r_[D * velocity[:3], 0.0, 0.0, 0.0]
    np.testing.assert_allclose(bounded_wrench(spring, damping, velocity, INERTIA, BOUND), spring - damping, atol=1e-12)


def test_damping_share_is_the_largest_inside_the_bound():
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(500):
        spring = clip_wrench(10.0 * rng.normal(size=6), AXES, 18.0, 4.0)
        damping = 10.0 ** rng.uniform(-2, 2) * rng.normal(size=6)
        share = damping_share(spring, damping, BOUND)
        assert is_inside(spring - share * damping)
        if share < 1.0 and np.abs(damping).min() > 0.1:
            assert not is_inside(spring - (share + 1e-5) * damping, tolerance=1e-7)
        shares.append(share)
    assert min(shares) < 0.2
    assert 0.1 < np.mean(np.array(shares) < 1.0) < 0.9


@pytest.mark.parametrize("mass", [1.5, 8.0])
@pytest.mark.parametrize("axis", [9.0, 18.0])
def test_impact_stays_inside_the_bound(axis, mass):
    """A mass that is pulled to a distant reference hits a stiff stop; the contact force is at most the force bound."""
    bound = replace(BOUND, axes=np.full(6, axis))
    damping, impedance = 2.0 * np.sqrt(K * mass), approach_impedance(bound.contact_stiffness, mass)

    def accelerated(speed, contact, step):
        velocity = np.r_[speed, np.zeros(5)]
        inertia = MovingInertia(mass, 2e-3)
        wrench = bounded_wrench(np.r_[100.0, np.zeros(5)], damping * velocity, velocity, inertia, bound)
        return speed + step * (wrench[0] - contact) / mass

    speed, depth, depths = 0.0, 0.0, []
    for _ in range(10_000):
        speed = accelerated(speed, 0.0, 1e-4)
    assert 0.4 * bound.force < speed * impedance <= bound.force * (1.0 + 1e-3)
    for _ in range(4_000):
        speed = accelerated(speed, bound.contact_stiffness * depth, 5e-5)
        depth += 5e-5 * speed
        depths.append(depth)
    assert 0.9 * axis < bound.contact_stiffness * max(depths) <= bound.force
    unlimited = WrenchBound(AXES, 18.0, 4.0)
    free = bounded_wrench(np.full(6, 100.0), np.zeros(6), np.ones(6), INERTIA, unlimited)
    np.testing.assert_allclose(free, clip_wrench(np.full(6, 100.0), AXES, 18.0, 4.0))  # without a contact stiffness


def turning_tool(bound, inertia, rng, distance, lever=0.03, steps=4_000, step=1e-4):
    """Simulate a plane tool on a distant reference that switches; return its speeds and the forces of a contact.

    The tool moves along y and turns about x. A point at the distance l on its side touches a wall of the bound's
    stiffness `distance` ahead. The result has a row for each step: the largest speed |v| + l |ω| of a point, and the
    contact's force.
    """
    damping, D_turn = 2.0 * np.sqrt(K * inertia.mass), 2.0 * np.sqrt(30.0 * inertia.moment)
    y, turn, v, w, rows = 0.0, 0.0, 0.0, 0.0, []
    for number in range(steps):
        if number % 400 == 0:
            push, torque = rng.choice([-100.0, 0.0, 100.0, 100.0]), rng.choice([-10.0, 10.0])
        depth = max(0.0, y + lever * turn - distance)
        velocity = np.array([0.0, v, 0.0, w, 0.0, 0.0])
        damper = np.array([0.0, damping * v, 0.0, D_turn * w, 0.0, 0.0])
        wrench = bounded_wrench(np.array([0.0, push, 0.0, torque, 0.0, 0.0]), damper, velocity, inertia, bound)
        contact = bound.contact_stiffness * depth
        v += step * (wrench[1] - contact) / inertia.mass
        w += step * (wrench[3] - contact * lever) / inertia.moment
        y, turn = y + step * v, turn + step * w
        rows.append((abs(v) + lever * abs(w), contact))
    return np.array(rows)


@pytest.mark.parametrize("inertia", [INERTIA, MovingInertia(8.0, 0.08)])
def test_contact_of_a_turning_tool_stays_inside_the_bound(inertia):
    """At the limit of the speed of its contacts, a tool that pushes and turns hits a wall with at most the force F."""
    bound, rng = replace(BOUND, axes=np.full(6, 18.0), torque=0.3), np.random.default_rng(4)
    fastest = bound.force / approach_impedance(bound.contact_stiffness, inertia.mass)
    speeds, forces = [], []
    for _ in range(4):
        speeds.append(turning_tool(bound, inertia, rng, np.inf)[:, 0].max())
        forces.append(turning_tool(bound, inertia, rng, rng.uniform(0.0, 5e-4))[:, 1].max())
    assert 0.9 * fastest < max(speeds) <= 1.02 * fastest
    assert 0.6 * bound.force < max(forces) <= 1.02 * bound.force
    center_only = turning_tool(replace(bound, contact_lever=0.0), inertia, rng, np.inf)
    assert center_only[:, 0].max() > 1.1 * fastest


@pytest.mark.parametrize("inertia", [INERTIA, MovingInertia(8.0, 0.08)])
def test_contact_of_a_tool_that_turns_with_all_its_torque_stays_inside_the_impact_ratio(inertia):
    bound, rng = replace(BOUND, axes=np.r_[np.full(3, 18.0), np.full(3, 3.0)]), np.random.default_rng(4)
    share = 1.0 / (1.0 + bound.contact_lever**2 * inertia.mass / inertia.moment)
    forces = [turning_tool(bound, inertia, rng, rng.uniform(0.0, 5e-4))[:, 1].max() for _ in range(6)]
    assert bound.force < max(forces) <= 1.02 * impact_ratio(1.0, share) * bound.force


@pytest.mark.parametrize("share", [1.0, 0.87, 0.5])
@pytest.mark.parametrize("ratio", [1.0, 2.0, 4.0, 8.0, 40.0])
def test_impact_ratio_bounds_a_contact_that_a_tool_presses_on_while_it_turns(ratio, share):
    """The equations of both impacts in `impact_ratio` are integrated, with m = k = F = 1 and c = 2."""

    def peak(drive, mass):
        depth, speed, step, depths = 0.0, 0.5, 2e-4, []
        for _ in range(40_000):
            speed += step * (drive * (1.0 - 2.0 * speed) - ratio * depth) / mass
            depth += step * speed
            depths.append(ratio * depth)
        return max(depths)

    pressed = peak(1.0, 1.0)
    assert impact_ratio(ratio, 1e-6) == pytest.approx(pressed, abs=2e-3)
    largest = max(pressed, peak(1.5 * share, share))
    assert largest <= 1.001 * impact_ratio(ratio, share)
    if ratio >= 8.0:
        assert largest >= 0.999 * impact_ratio(ratio, share)


def test_impact_ratio_has_its_closed_form():
    assert approach_impedance(2.5e4, 1.5) ** 2 == pytest.approx(4.0 * 2.5e4 * 1.5, rel=1e-12)
    assert impact_ratio(2.0, 1e-6) == pytest.approx(1.0 + np.sqrt(0.5) * np.exp(-0.75 * np.pi), rel=1e-12)
    assert impact_ratio(1.0) == 1.5
    assert impact_ratio(8.0) == impact_ratio(8.0, 1.0) != impact_ratio(8.0, 0.999)


def test_shares_of_a_moving_tool_are_those_of_the_two_inequalities():
    """The inequalities in `slow_down`, with the shares of force and torque for which they are equations."""
    rng, reduced = np.random.default_rng(6), []
    for _ in range(400):
        spring, velocity = rng.normal(size=6) * np.repeat([8.0, 0.5], 3), rng.normal(size=6) * np.repeat([0.01, 0.5], 3)
        D, push, turn = 10.0 ** rng.uniform(0.0, 4.0) * np.repeat([1.0, 1e-3], 3), spring[:3], spring[3:]
        damping = D * velocity
        c, F = 2.0 * np.sqrt(BOUND.contact_stiffness * INERTIA.mass), BOUND.force
        speed, spin = np.linalg.norm(velocity[:3]), BOUND.contact_lever * np.linalg.norm(velocity[3:])
        lever = BOUND.contact_lever * INERTIA.mass / INERTIA.moment
        shares = np.ones(2)
        if push @ velocity[:3] > 0.0:
            limit = F - max(0.0, c * speed - damping[:3] @ velocity[:3] / speed) - c * spin
            shares[0] = np.clip(limit / np.linalg.norm(push), 0.0, 1.0)
        if turn @ velocity[3:] > 0.0:
            damped = lever * damping[3:] @ velocity[3:] / np.linalg.norm(velocity[3:])
            limit = F - 0.5 * shares[0] * np.linalg.norm(push) - c * speed - max(0.0, c * spin - damped)
            shares[1] = np.clip(limit / (lever * np.linalg.norm(turn)), 0.0, 1.0)
        expected = spring * np.repeat(shares, 3)
        np.testing.assert_allclose(slow_down(spring, damping, velocity, INERTIA, BOUND), expected, rtol=1e-12)
        reduced.append((shares > 0.0) & (shares < 1.0))
    assert np.sum(reduced, axis=0).min() > 40


def test_tool_can_be_turned_while_it_presses_with_all_its_force():
    velocity = np.array([0.0, 0.0, -1e-4, 0.0, 0.0, 0.1])  # a bayonet that is drawn in while it turns
    pressing = bounded_wrench(np.r_[6.0, 6.0, -15.0, 0.0, 0.0, 3.0], np.zeros(6), velocity, INERTIA, BOUND)
    lever = BOUND.contact_lever * INERTIA.mass / INERTIA.moment
    speed = approach_impedance(BOUND.contact_stiffness, INERTIA.mass) * (1e-4 + 0.1 * BOUND.contact_lever)
    assert np.linalg.norm(pressing[:3]) == pytest.approx(BOUND.force - speed, rel=1e-9)
    assert pressing[5] == pytest.approx((BOUND.force - 0.5 * np.linalg.norm(pressing[:3]) - speed) / lever, rel=1e-9)


def test_torque_that_brakes_is_not_reduced():
    velocity = np.array([0.0, 0.0, 0.0, 2.0, 0.0, 0.0])
    braking = bounded_wrench(np.r_[0.0, 0.0, 0.0, -3.0, 0.0, 0.0], np.zeros(6), velocity, INERTIA, BOUND)
    assert braking[3] == -3.0
    turning = bounded_wrench(np.r_[0.0, 0.0, 0.0, 3.0, 0.0, 0.0], np.zeros(6), velocity, INERTIA, BOUND)
    assert turning[3] == 0.0  # 60 mm/s at the lever are too fast


def test_closed_paths_gain_no_energy_at_a_fixed_reference():
    """The tool moves along random closed paths; the force bound follows from the bounds per axis, as in `Impedance`."""
    rng = np.random.default_rng(2)
    bound = WrenchBound(AXES, float(np.linalg.norm(AXES[:3])), 10.0, 2.5e4)
    for _ in range(40):
        corners = np.vstack([np.zeros(3), rng.normal(scale=0.02, size=(4, 3)), np.zeros(3)])
        energy = 0.0
        for start, end in itertools.pairwise(corners):
            velocity = np.r_[(end - start) / np.linalg.norm(end - start) * 10.0 ** rng.uniform(-3, 0), np.zeros(3)]
            points = np.linspace(start, end, 400)
            for point in 0.5 * (points[1:] + points[:-1]):
                spring = np.r_[-K * point, 0.0, 0.0, 0.0]
                wrench = bounded_wrench(spring, D * velocity, velocity, INERTIA, bound)
                energy += float(wrench[:3] @ (end - start)) / 399.0
        assert energy <= 1e-5


def test_torque_within_its_limits_is_unchanged_by_a_force():
    wrench = np.array([0.0, 0.0, 10.0, 0.1, 0.0, 0.0])
    np.testing.assert_array_equal(clip_wrench(wrench, AXES, 18.0, 4.0), wrench)


def test_pose_order_reverses_the_limits_of_the_torque():
    bound = WrenchBound(np.arange(1.0, 7.0), 18.0, 4.0)
    np.testing.assert_array_equal(bound.in_pose_order.axes, [1.0, 2.0, 3.0, 6.0, 5.0, 4.0])


def test_clipped_force_and_torque_do_not_depend_on_each_other():
    np.testing.assert_allclose(
        clip_wrench(np.r_[8.0, 6.0, 0.0, 0.3, 0.4, 0.0], AXES, 5.0, 0.25), [4.0, 3.0, 0.0, 0.15, 0.2, 0.0], rtol=1e-12
    )
    np.testing.assert_array_equal(clip_wrench(np.zeros(6), AXES, 0.0, 0.0), 0.0)


def test_damping_share_ignores_axes_without_damping():
    """An axis may have neither damping nor a limit above zero; numbers of freed memory do not count."""
    bound, damping = WrenchBound(np.r_[0.5, np.zeros(5)], np.inf, np.inf), np.r_[1.0, np.zeros(5)]
    for _ in range(20):
        freed = [np.full(6, -1.0) for _ in range(50)]
        del freed
        assert damping_share(np.zeros(6), damping, bound) == 0.5


def test_governed_error_leaves_room_for_the_force_of_moving():
    """Force and torque have limits of their own, each reduced by (K h + D) |v| of its coordinates."""
    bound, step = WrenchBound(np.full(6, 100.0), 10.0, 2.0), 0.005
    stiffness, damping = np.r_[np.full(3, 800.0), np.full(3, 30.0)], np.r_[np.full(3, 50.0), np.full(3, 1.5)]
    velocity = np.array([0.03, 0.0, 0.04, 0.4, 0.2, 0.4])
    error = governed_error(stiffness, damping, np.array([0, 0.1, 0, 0.5, 0, 0]), velocity, INERTIA, step, bound)
    expected = [10.0 - (800.0 * step + 50.0) * 0.05, 2.0 - (30.0 * step + 1.5) * 0.6]
    np.testing.assert_allclose((stiffness * error)[[1, 3]], expected, rtol=1e-12)


def test_governed_error_is_zero_while_moving_takes_the_whole_bound():
    bound, velocity = WrenchBound(np.full(6, 100.0), 1.5, 0.5), np.array([0.03, 0.0, 0.04, 0.0, 0.3, 0.4])
    stiffness, damping = np.r_[np.full(3, 800.0), np.full(3, 30.0)], np.r_[np.full(3, 50.0), np.full(3, 1.5)]
    error = governed_error(stiffness, damping, np.array([0, 0.1, 0, 0.5, 0, 0]), velocity, INERTIA, 0.005, bound)
    np.testing.assert_array_equal(error, 0.0)


@pytest.mark.parametrize("block", [slice(0, 3), slice(3, 6)])
def test_damper_is_scaled_to_limits_below_one(block):
    """A norm is compared with its limit, not with its square or twice the limit."""
    bound, damping = WrenchBound(AXES, 0.5, 0.5), np.zeros(6)
    damping[block] = 0.6, 0.0, 0.0
    assert damping_share(np.zeros(6), damping, bound) == pytest.approx(0.5 / 0.6, rel=1e-12)


def test_lowered_bound_is_never_above_the_original():
    lower = BOUND.lowered_to(np.array([20.0, 5.0, np.nan, -1.0, 1.0, np.inf, 8.0, 0.5]))
    np.testing.assert_array_equal(lower.numbers, [9.0, 5.0, 0.0, 0.0, 1.0, 3.0, 8.0, 0.5])
    assert (lower.contact_stiffness, lower.contact_lever) == (BOUND.contact_stiffness, BOUND.contact_lever)
    np.testing.assert_array_equal(BOUND.lowered_to(np.full(8, np.inf)).numbers, BOUND.numbers)
    np.testing.assert_array_equal(BOUND.lowered_to(np.full(8, 2)).numbers, np.full(8, 2.0))  # whole numbers
    assert BOUND.numbers.shape == (8,)
    assert not lower.axes.flags.writeable  # it is cached


@pytest.mark.parametrize(("force", "torque"), [(12.0, 1.5), (12.0, np.inf), (np.inf, 1.5), (np.inf, np.inf)])
def test_norm_limits_bound_every_wrench_within_the_axes(force, torque):
    bound = norm_limits(force, torque)
    for block, norm, limit in ((bound[:3], bound[6], force), (bound[3:6], bound[7], torque)):
        np.testing.assert_array_equal(np.linalg.norm(block), norm)
        assert 0.98 * limit <= norm <= limit * (1 + 1e-15)
    if np.isfinite(force):
        np.testing.assert_allclose(bound[:3], [0.45 * force, 0.45 * force, 0.75 * force])
    assert norm_limits(force=force)[7] == np.inf
    np.testing.assert_allclose(
        norm_limits(0.3, 0.9).reshape(8)[3:], [0.27**0.5] * 3 + [0.3 * 0.9675**0.5, 0.9], rtol=1e-12
    )
    with pytest.raises(InputError, match="must be positive"):
        norm_limits(force, 0.0)
    with pytest.raises(InputError, match="must be positive"):
        norm_limits(0.0, torque)
    with pytest.raises(InputError, match="must be positive"):
        norm_limits(force, np.nan)


@pytest.mark.parametrize(("excess", "share"), [(0.5, 1.0), (1.0005, 1.0 / 1.0005), (4.0, 0.25)])
def test_bound_approaches_on_a_straight_line(excess, share):
    bound, change = np.arange(1.0, 9.0), np.array([2.0, -0.5, 0.0, 0.1, 1.0, -3.0, 0.2, 4.0])
    max_change = 10.0 * np.abs(change) + 1.0
    max_change[1] = 0.5 / excess  # the number that changes fastest
    target = bound + change
    moved = approach_bound(bound, target, max_change)
    np.testing.assert_allclose(moved, bound + share * change, rtol=1e-12)
    assert moved is not target


@pytest.mark.parametrize("value", [np.inf, np.nan])
def test_approach_refuses_bounds_that_are_not_finite(value):
    finite, infinite = np.ones(8), np.r_[np.ones(7), value]
    for bounds in ((infinite, infinite), (finite, infinite), (infinite, finite)):
        with pytest.raises(InputError, match="the bounds of an approach must be finite"):
            approach_bound(*bounds, np.ones(8))


@pytest.mark.parametrize("numbers", [(AXES[:5], 1.0, 1.0), (-AXES, 1.0, 1.0), (AXES, np.nan, 1.0), (AXES, 1.0, -1.0)])
def test_bound_raises_when_a_number_is_invalid(numbers):
    with pytest.raises(InputError, match="six limits, two norms, a stiffness and a lever"):
        WrenchBound(*numbers)


def test_governed_error_leaves_room_for_an_implicit_damper():
    """K e − (K h + D) v₁ is inside the bound for every velocity v₁ that is not faster than v₀ in any coordinate."""
    rng, step = np.random.default_rng(3), 0.01
    stiffness, damping = np.r_[np.full(3, K), np.full(3, 30.0)], np.r_[np.full(3, D), np.full(3, 0.5)]
    for _ in range(2000):
        error, velocity = rng.normal(size=6) * 10.0 ** rng.uniform(-4, 0), rng.normal(size=6) * 0.03
        governed = governed_error(stiffness, damping, error, velocity, INERTIA, step, BOUND)
        implicit = (stiffness * step + damping) * velocity
        spring = stiffness * governed
        for after in (implicit, -implicit, 0.0 * implicit, rng.uniform(-1, 1, 6) * implicit):
            bounds = np.maximum(BOUND.axes, np.abs(implicit))
            force = max(BOUND.force, np.linalg.norm(implicit[:3]))
            torque = max(BOUND.torque, np.linalg.norm(implicit[3:]))
            assert is_inside(spring - after, WrenchBound(bounds, force, torque))
    np.testing.assert_allclose(
        governed_error(stiffness, damping, np.full(6, 1e-3), np.zeros(6), INERTIA, step, BOUND), 1e-3, atol=1e-15
    )


def test_governed_torque_makes_no_contact_too_fast_within_a_step_from_rest():
    stiffness, step = np.r_[np.full(3, K), np.full(3, 30.0)], 0.005
    error = governed_error(stiffness, np.ones(6), np.full(6, 1.0), np.zeros(6), INERTIA, step, BOUND)
    speed = BOUND.contact_lever * step * np.linalg.norm(stiffness[3:] * error[3:]) / INERTIA.moment
    assert speed == pytest.approx(BOUND.force / approach_impedance(BOUND.contact_stiffness, INERTIA.mass))


STIFFNESS, SPRING_LIMITS = np.array([1500.0, 30.0]), np.array([15.0, 3.0])


def test_force_is_the_gradient_of_the_energy():
    for error in np.random.default_rng(0).normal(scale=0.05, size=(50, 2)):
        step = 1e-7 * np.eye(2)
        gradient = [
            (spring_energy(STIFFNESS, SPRING_LIMITS, error + d) - spring_energy(STIFFNESS, SPRING_LIMITS, error - d))
            / 2e-7
            for d in step
        ]
        np.testing.assert_allclose(gradient, np.clip(STIFFNESS * error, -SPRING_LIMITS, SPRING_LIMITS), atol=1e-5)


def test_energy_of_springs_has_its_closed_form():
    energy = 0.5 * 1500.0 * 0.004**2 + (3.0 * 0.2 - 3.0**2 / (2 * 30.0))
    assert spring_energy(STIFFNESS, SPRING_LIMITS, np.array([0.004, -0.2])) == pytest.approx(energy, rel=1e-12)
    assert spring_energy(STIFFNESS, SPRING_LIMITS, np.zeros(2)) == 0.0


def test_share_of_a_change_has_its_closed_form():
    """The energy of one spring without a limit, ½ K (s e)², is the largest one at s = √(2 E / K) / e."""
    stiffness, limits, errors = np.array([200.0]), (np.array([1e9]),) * 2, (np.zeros(1), np.ones(1))
    for energy in (100.0, 100.0 * (1.0 - 5e-4), 30.0, 1e-3):
        share, stored = admissible_change(stiffness, limits, errors, energy)
        assert 0.0 <= math.sqrt(energy / 100.0) - share < 2.0**-39
        assert stored <= energy
    assert admissible_change(stiffness, limits, errors, 100.0) == (1.0, 100.0)


@pytest.mark.parametrize("name", ["stiffness", "damping"])
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_spring_and_damper_are_refused_when_a_single_number_is_wrong(name, value):
    K, D = np.ones(6), np.zeros(6)
    np.testing.assert_array_equal(check_spring_damper(K, D, "the robot"), (K, D))  # no damping is allowed
    (K if name == "stiffness" else D)[4] = value
    with pytest.raises(InputError, match="the robot needs six positive stiffnesses and six dampings"):
        check_spring_damper(K, D, "the robot")


def test_change_stores_no_more_than_the_available_energy():
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(300):
        errors = tuple(rng.normal(scale=0.05, size=(2, 2)))
        limits = SPRING_LIMITS * rng.uniform(0.2, 1.0), SPRING_LIMITS
        before = spring_energy(STIFFNESS, limits[0], errors[0])
        energy = before + 10.0 ** rng.uniform(-4, 0)
        share, stored = admissible_change(STIFFNESS, limits, errors, energy)
        after = [first + share * (second - first) for first, second in (limits, errors)]
        assert stored == pytest.approx(spring_energy(STIFFNESS, *after), rel=1e-12)
        assert stored <= energy
        if share < 1.0:
            assert stored - before == pytest.approx(energy - before, rel=1e-6)
        shares.append(share)
    assert 0.2 < np.mean(np.array(shares) == 1.0) < 0.95
