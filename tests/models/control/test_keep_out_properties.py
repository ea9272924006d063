"""Geometric properties of KeepOut for random boxes and constraints."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.primitives import LinearConstraints, UnsolvableError

SEEDS = st.integers(0, 2**32 - 1)
MARGIN = 0.05
GAP = 1e-6


def clearances(lower, upper, points):
    """Return distances (n, B) of points from boxes, along the largest axis; negative inside."""
    points = np.atleast_2d(points)[:, None]
    return np.maximum(lower - points, points - upper).max(axis=2)


def scene(seed, dimensions=2, boxes=2, planes=0):
    """Draw disjoint boxes and a start outside all of them."""
    rng = np.random.default_rng(seed)
    while True:
        center, half = rng.uniform(-1, 1, (boxes, dimensions)), rng.uniform(0.05, 0.3, (boxes, dimensions))
        lower, upper = center - half, center + half
        apart = clearances(lower[None, 0], upper[None, 0], center[1:]).min(initial=1.0) - half[1:].max(initial=0.0)
        start = rng.uniform(-1.5, 1.5, dimensions)
        if apart > 3 * MARGIN and clearances(lower, upper, start).min() > MARGIN + 1e-3:
            break
    G = rng.standard_normal((planes, dimensions))
    c = G @ start - rng.uniform(0.2, 1.0, planes) - MARGIN * np.linalg.norm(G, axis=1)
    constraints = LinearConstraints(G, c) if planes else LinearConstraints.none(dimensions)
    return KeepOut(lower, upper, constraints, MARGIN), lower, upper, start, rng.uniform(-1.5, 1.5, dimensions)


@given(SEEDS, st.integers(1, 3), st.integers(1, 2))
def test_path_keeps_the_margin(seed, dimensions, boxes):
    keep_out, lower, upper, start, desired = scene(seed, dimensions, boxes)
    assert keep_out.num_outputs == dimensions
    safe, blocked = keep_out.project(start, desired)
    way = np.linspace(start, safe, 200)
    assert clearances(lower, upper, way).min() >= MARGIN - 1e-9
    straight = clearances(lower, upper, np.linspace(start, desired, 4000)).min()
    if straight > MARGIN + 1e-3:
        assert not blocked
        np.testing.assert_array_equal(safe, desired)
    if straight < MARGIN - 1e-3:
        assert blocked


@given(SEEDS)
def test_blocked_path_ends_at_the_margin(seed):
    """The motion towards a target behind a box ends at the margin of the box."""
    keep_out, lower, upper, start, desired = scene(seed)
    if clearances(lower, upper, desired).min() < MARGIN + 1e-3:
        return
    safe, blocked = keep_out.project(start, desired)
    way, done = desired - start, safe - start
    assert abs(way[0] * done[1] - way[1] * done[0]) < 1e-12
    assert 0 <= done @ way <= way @ way + 1e-12
    if blocked:
        assert clearances(lower, upper, safe).min() == pytest.approx(MARGIN, abs=1e-3)
        beyond = safe + 2e-3 * way / np.linalg.norm(way)
        nearest = clearances(lower, upper, np.linspace(safe, beyond, 50)).min()
        assert nearest <= clearances(lower, upper, safe).min()


@given(SEEDS)
def test_target_in_a_box_is_projected_to_its_nearest_face(seed):
    rng = np.random.default_rng(seed)
    lower, upper = np.zeros((1, 2)), np.array([[0.5, 0.7]])
    keep_out = KeepOut(lower, upper, LinearConstraints.none(2), MARGIN)
    desired = rng.uniform(lower[0] - 0.9 * MARGIN, upper[0] + 0.9 * MARGIN)
    faces = {(0, 0): desired[0] + MARGIN, (0, 1): 0.5 + MARGIN - desired[0]}
    faces |= {(1, 0): desired[1] + MARGIN, (1, 1): 0.7 + MARGIN - desired[1]}
    (axis, side), _ = min(faces.items(), key=lambda face: face[1])
    expected = desired.copy()
    expected[axis] = (-MARGIN - GAP, (0.5, 0.7)[axis] + MARGIN + GAP)[side]
    # From right outside of that face, so that nothing is in the way.
    start = expected.copy()
    start[axis] += 0.3 if side else -0.3
    safe, pushed = keep_out.project(start, desired)
    np.testing.assert_allclose(safe, expected, rtol=0, atol=1e-12)
    assert pushed


@given(SEEDS, st.integers(1, 3))
def test_projection_to_constraints_is_the_nearest_point(seed, planes):
    rng = np.random.default_rng(seed)
    G = rng.standard_normal((planes, 2))
    c = -rng.uniform(0.2, 1, planes)
    constraints = LinearConstraints(G, c)
    norms = np.linalg.norm(G, axis=1)
    keep_out = KeepOut(np.array([[90.0, 90]]), np.array([[91.0, 91]]), constraints, MARGIN)
    if (c + MARGIN * norms > -1e-3).any():
        return  # the start itself would be nearer than the margin
    desired = rng.uniform(-3, 3, 2)
    safe, blocked = keep_out.project(np.zeros(2), desired)
    assert not blocked
    distances = (G @ safe - c) / norms
    assert distances.min() >= MARGIN - 1e-9
    # No allowed point is nearer: moving towards the desired point would violate an active constraint.
    tightened = LinearConstraints(G, c + MARGIN * norms)
    np.testing.assert_allclose(safe, tightened.nearest(desired), rtol=0, atol=1e-8)
    if ((G @ desired - c) / norms).min() >= MARGIN:
        np.testing.assert_array_equal(safe, desired)


@given(SEEDS)
def test_robot_within_the_margin_comes_no_closer(seed):
    """From within the margin or a box, the clearance never decreases, and the robot may leave."""
    rng = np.random.default_rng(seed)
    lower, upper = np.array([[0.0, 0.0]]), np.array([[0.4, 0.6]])
    keep_out = KeepOut(lower, upper, LinearConstraints.none(2), MARGIN)
    start = rng.uniform(lower[0] - MARGIN, upper[0] + MARGIN)
    clearance = clearances(lower, upper, start).item()
    desired = rng.uniform(-1, 1.5, 2)
    safe, _ = keep_out.project(start, desired)
    way = np.linspace(start, safe, 100)
    assert clearances(lower, upper, way).min() >= min(clearance, MARGIN) - 2 * GAP
    # A motion straight away from the nearest face is not limited.
    gaps = np.concatenate([lower[0] - start, start - upper[0]])
    out = int(np.argmax(gaps))
    direction = np.eye(2)[out % 2] * (-1.0 if out < 2 else 1.0)
    away = start + direction
    free, blocked = keep_out.project(start, away)
    np.testing.assert_array_equal(free, away)
    assert not blocked


def test_box_may_extend_to_infinity():
    wall = KeepOut([[0.3, -np.inf]], [[0.5, np.inf]], LinearConstraints.none(2), MARGIN)
    for y in (-100.0, 0.0, 1e6):
        safe, blocked = wall.project(np.array([0.0, y]), np.array([1.0, y]))
        np.testing.assert_allclose(safe, [0.25, y], atol=1e-5)
        assert blocked
        free, blocked = wall.project(np.array([0.0, y]), np.array([0.1, y + 5]))
        np.testing.assert_array_equal(free, [0.1, y + 5])
        assert not blocked


def test_motion_along_a_face_is_not_blocked():
    box = KeepOut([[0.0, 0.0]], [[1.0, 1.0]], LinearConstraints.none(2), MARGIN)
    beside = np.array([-0.5, 1.0 + MARGIN])
    for desired in (np.array([1.5, 1.0 + MARGIN]), beside):
        safe, blocked = box.project(beside, desired)
        np.testing.assert_array_equal(safe, desired)
        assert not blocked
    low, blocked = box.project(np.array([-0.5, 0.5]), np.array([1.5, 0.5]))
    assert blocked
    assert low[0] == pytest.approx(-MARGIN, abs=1e-5)


def test_first_of_two_walls_stops_the_motion():
    walls = KeepOut([[0.5, -1.0], [0.2, -1.0]], [[0.6, 1.0], [0.3, 1.0]], LinearConstraints.none(2), 0.0)
    for start, end, wall in ((0.0, 1.0, 0.2), (1.0, 0.0, 0.6), (0.4, 1.0, 0.5), (0.4, 0.0, 0.3)):
        safe, blocked = walls.project(np.array([start, 0.0]), np.array([end, 0.0]))
        assert blocked
        assert safe[0] == pytest.approx(wall, abs=1e-5)


def test_constructor_refuses_invalid_arguments():
    none = LinearConstraints.none(2)
    stepwise = LinearConstraints(np.zeros((3, 1, 2)), -np.ones((3, 1)))
    for lower, upper, constraints in (
        ([[0, 0]], [[1, 1]], LinearConstraints.none(3)),
        ([[0, 0]], [[1, 1]], stepwise),
        ([[0, 0], [0, 0]], [[1, 1]], none),
        ([[0, 0]], [[1, 0]], none),
    ):
        with pytest.raises(InputError):
            KeepOut(lower, upper, constraints, 0.1)
    for margin in (np.nan, np.inf, -0.1):
        with pytest.raises(InputError, match="margin"):
            KeepOut([[0, 0]], [[1, 1]], none, margin)
    assert KeepOut([[0, 0]], [[1, 1]], none, 0.0).margin == 0.0


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf])
def test_position_that_is_not_finite_is_refused(wrong):
    wall = KeepOut([[0.4, -9.0]], [[0.6, 9.0]], LinearConstraints.none(2), 0.02)
    positions = np.array([0.2, 0.2]), np.array([wrong, 0.2])
    for position, desired in (positions, positions[::-1]):
        with pytest.raises(UnsolvableError, match="finite"):
            wall.project(position, desired)
