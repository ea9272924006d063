import numpy as np
import pytest
from motion_adversary import KINDS, attack, is_violated

from guiderail.models.common.errors import InputError
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.control.shapes import Box, Sphere
from guiderail.models.primitives import LinearConstraints

PERIOD = 0.02
LINEAR = LinearConstraints.box([0.0, 0.0], [0.6, 1.0])
OUTSIDE = (Sphere([0.5, 0.3], 0.08), Box([0.1, 0.5], [0.3, 0.6], 0.01))
SPEED, ACCELERATION = np.array([0.5, 0.4]), np.array([2.0, 3.0])
LIMITS = {
    "no limits": (None, None),
    "speed": (SPEED, None),
    "acceleration": (None, ACCELERATION),
    "both": (SPEED, ACCELERATION),
}


def test_no_command_and_no_path_enters_a_spherical_obstacle():
    results = attack(600, seed=5)
    for kind in KINDS:
        assert not is_violated(kind, results[kind]), (kind, results[kind])
    assert sum(result.touching for result in results.values()) > 10  # the adversary reaches the obstacles


@pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
def test_constraints_are_satisfied_for_any_desired_command(limits):
    motion = MotionConstraints(LINEAR, OUTSIDE, *limits)
    law, rng = MotionConstraintFilter(motion, PERIOD), np.random.default_rng(0)
    state, desired = law.start(np.array([0.3, 0.1])), np.zeros(2)
    worst, clearance, displacements = -np.inf, np.inf, [np.zeros(2)]
    for k in range(700):
        last = state[:2]
        if rng.uniform() < 0.1:
            desired = rng.uniform(-0.5, 1.5, 2)
        if k % 11 == 0:
            desired = OUTSIDE[0].center
        state, _ = law.apply(state, desired)
        worst = max(worst, motion.violation(state[:2]))
        shares = np.linspace(0.0, 1.0, 5)
        clearance = min(clearance, *(s.distance(last + t * (state[:2] - last)) for s in OUTSIDE for t in shares))
        displacements.append(state[:2] - last)
    assert -1e-4 < worst <= 1e-9  # constraints are reached and satisfied
    assert clearance >= 0.0
    moves = np.array(displacements)
    for limit, actual in ((limits[0], moves / PERIOD), (limits[1], np.diff(moves, axis=0) / PERIOD**2)):
        if limit is not None:
            np.testing.assert_allclose(np.abs(actual).max(axis=0), limit, rtol=1e-6)  # limits are reached and satisfied


@pytest.mark.parametrize("size", [1e8, 1e20, 1e150, 1e300])
def test_constraints_are_satisfied_for_huge_desired_commands(size):
    motion = MotionConstraints(LinearConstraints.none(2), OUTSIDE, SPEED, ACCELERATION)
    law, rng = MotionConstraintFilter(motion, PERIOD), np.random.default_rng(0)
    state, desired = law.start(np.array([0.3, 0.1])), np.zeros(2)
    for k in range(200):
        desired = rng.choice([size, -size, 1e9, 0.3], 2) if k % 8 == 0 else desired
        last, (state, _) = state, law.apply(state, desired)
        assert motion.violation(state[:2]) <= 1e-9
        assert (np.abs(state[2:]) <= SPEED * PERIOD * (1 + 1e-6)).all()
        assert (np.abs(state[2:] - last[2:]) <= ACCELERATION * PERIOD**2 * (1 + 1e-6)).all()


def test_command_is_projected_when_constraints_are_violated():
    law = MotionConstraintFilter(MotionConstraints(LINEAR, OUTSIDE), PERIOD)
    state = law.start(np.array([0.3, 0.3]))
    allowed = np.array([0.41, 0.31])
    after, is_braking = law.apply(state, allowed)
    np.testing.assert_array_equal(after, [*allowed, *(allowed - state[:2])])
    assert not is_braking
    # The half space of the sphere at the last command ends at x = 0.42.
    np.testing.assert_allclose(law.apply(state, np.array([0.5, 0.35]))[0][:2], [0.42, 0.35], atol=2e-8)
    np.testing.assert_allclose(law.apply(state, np.array([0.3, -0.2]))[0][:2], [0.3, 0.0], atol=1e-9)


@pytest.mark.parametrize("linear", [LINEAR, LinearConstraints.none(2)])
def test_violation_by_a_command_with_nan_is_nan(linear):
    constraints = MotionConstraints(linear, OUTSIDE)
    assert np.isnan(constraints.violation(np.full(2, np.nan)))
    assert np.isnan(constraints.violations(np.full(2, np.nan)).shapes)


@pytest.mark.parametrize("desired", [[np.nan, 0.0], [np.inf, 0.0]])
def test_command_that_is_not_finite_brakes(desired):
    law = MotionConstraintFilter(MotionConstraints(LINEAR, OUTSIDE, SPEED, ACCELERATION), PERIOD)
    state = np.array([0.3, 0.3, 0.004, -0.002])
    speeds = []
    for _ in range(10):
        state, is_braking = law.apply(state, np.array(desired))
        assert is_braking
        speeds.append(np.abs(state[2:]).max())
    assert speeds[0] == pytest.approx(0.004 - 0.02**2 * 2.0)
    assert speeds[-1] == 0.0


def test_filter_brakes_when_the_wall_is_at_braking_distance():
    motion = MotionConstraints(LinearConstraints.box([0.0, 0.0], [0.6, 1.0]), (), SPEED, ACCELERATION)
    law = MotionConstraintFilter(motion, PERIOD)
    displacement, change = 0.005, PERIOD**2 * 2.0
    braking = sum(displacement - k * change for k in range(1, 7))
    for room, is_braking in ((braking, True), (braking + 1e-5, False)):
        state = np.array([0.6 - room, 0.3, displacement, 0.0])
        after, flag = law.apply(state, np.array([0.7, 0.3]))
        assert flag == is_braking
        assert after[2] == pytest.approx(displacement - change, abs=2e-5)
        for _ in range(30):
            after, _ = law.apply(after, np.array([0.7, 0.3]))
            assert after[0] <= 0.6 + 1e-9
        assert after[0] == pytest.approx(0.6, abs=1e-6)


@pytest.mark.parametrize("dims", [1, 2, 3, 6])
@pytest.mark.parametrize("kind", ["linear", "outside", "state"])
def test_start_too_fast_to_brake_exceeds_only_acceleration(dims, kind):
    """One output moves at 1 m/s, 5 cm before its limit; its braking distance at 2 m/s² is 25 cm."""
    limit = LinearConstraints(-np.eye(dims)[:1], np.array([-0.05]))
    shapes = {"outside": [Sphere(np.eye(dims)[0] * 0.15, 0.1)]}
    shapes["state"] = [FirstOutputLimit(limit)]
    linear = limit if kind == "linear" else LinearConstraints.none(dims)
    motion = MotionConstraints(linear, max_acceleration=[2.0] * dims, **{kind: shapes[kind]} if kind in shapes else {})
    law, goal = MotionConstraintFilter(motion, PERIOD), np.eye(dims)[0]
    slow, fast = 0.006 * goal, 0.02 * goal
    np.testing.assert_array_equal(law.start(np.zeros(dims), slow), [*np.zeros(dims), *slow])
    state, positions = law.start(np.zeros(dims), fast), []
    for _ in range(40):
        state, _ = law.apply(state, goal)
        positions.append(state[0])
        assert motion.violation(state[:dims]) <= 1e-9
    assert 0.0 < positions[0] < 0.02 - 2.0 * PERIOD**2  # brakes by more than the maximum acceleration
    assert max(positions) == pytest.approx(0.05, abs=1e-4)
    assert np.abs(np.diff(positions, 2)).max() <= 2.0 * PERIOD**2 * (1 + 1e-6)
    displacement = law.start(goal, fast)[dims]  # from a start beyond the limit, or behind the obstacle
    assert displacement == 0.02 if kind == "outside" else displacement < 2.0 * PERIOD**2


def test_motion_along_a_gap_without_width_is_possible():
    """The half spaces of both walls contain the last command, so that a next command exists."""
    walls = Box([-np.inf, -np.inf], [0.2, np.inf]), Box([0.2 + 1e-9, -np.inf], [np.inf, np.inf])
    law = MotionConstraintFilter(MotionConstraints(LinearConstraints.none(2), walls), PERIOD)
    state, is_braking = law.apply(law.start(np.array([0.2 + 5e-10, 0.1])), np.array([0.4, 0.3]))
    assert not is_braking
    np.testing.assert_allclose(state[:2], [0.2 + 5e-10, 0.3], atol=1e-12)


@pytest.mark.parametrize("start", [[0.52, 0.31], [0.2, 0.55], [0.7, 0.3], [-0.3, 0.5]])
@pytest.mark.parametrize("limits", [(None, None), (SPEED, None), (SPEED, ACCELERATION)])
def test_start_outside_the_constraints_converges_inside(start, limits):
    motion = MotionConstraints(LINEAR, OUTSIDE, *limits)
    law = MotionConstraintFilter(motion, PERIOD)
    state, violations = law.start(np.array(start)), [motion.violation(np.array(start))]
    assert violations[0] > 1e-3
    for _ in range(100):
        state, _ = law.apply(state, np.array(start))
        violations.append(motion.violation(state[:2]))
    assert violations[-1] <= 1e-9
    assert (np.diff(np.maximum(violations, 0.0)) <= 1e-9).all()


def test_limits_apply_to_outputs_without_a_position():
    motion = MotionConstraints(LinearConstraints.none(3), OUTSIDE, [np.inf, np.inf, 0.1])
    law = MotionConstraintFilter(motion, PERIOD)
    state, _ = law.apply(law.start(np.array([0.3, 0.3, 0.0])), np.array([0.32, 0.3, 1.0]))
    np.testing.assert_allclose(state[:3], [0.32, 0.3, 0.002], atol=1e-12)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        ({"linear": LinearConstraints.box(np.zeros((3, 2)), np.ones((3, 2)))}, "do not change"),
        ({"outside": [Sphere([0.0, 0.0, 0.0], 0.1)]}, "dimensions"),
        ({"max_speed": [0.1]}, "max_speed"),
        ({"max_speed": [0.1, 0.0]}, "max_speed"),
        ({"max_acceleration": [0.1, np.nan]}, "max_acceleration"),
    ],
)
def test_constraints_raise_when_an_argument_is_out_of_range(arguments, match):
    with pytest.raises(InputError, match=match):
        MotionConstraints(**{"linear": LINEAR, **arguments})


class FirstOutputLimit:
    """State constraint with the linear constraints of its argument."""

    def __init__(self, linear):
        self.linear = linear

    def linearize(self, output):
        return self.linear.G, self.linear.c

    def violation(self, output):
        return self.linear.violation(output)


class AngleLimit:
    """State constraint that the last output is at most 0.1 rad."""

    def linearize(self, output):
        return -np.eye(2)[1:], np.array([-0.1])

    def violation(self, output):
        return float(output[1] - 0.1)


@pytest.mark.parametrize(
    ("output", "expected", "largest"),
    [
        ([0.3, 0.5], (0.2, 0.1, 0.4), 0.2),
        ([0.0, 0.5], (-0.1, -0.2, 0.4), 0.1),
        ([0.0, 0.0], (-0.1, -0.2, -0.1), -0.025),
    ],
)
def test_lengths_and_angles_have_separate_violations(output, expected, largest):
    """The violation as one number is the largest violation, with an angle as the arc at a radius of 0.25 m."""
    linear = LinearConstraints(np.array([[-1.0, 0.0]]), np.array([-0.1]))
    constraints = MotionConstraints(linear, outside=[Box([0.2], [np.inf])], state=[AngleLimit()])
    np.testing.assert_allclose(constraints.violations(np.array(output)), expected, atol=1e-12)
    assert constraints.violation(np.array(output)) == pytest.approx(largest, abs=1e-12)
