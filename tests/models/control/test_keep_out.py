import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.control.command_filters import KeepOut
from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.models.primitives import LinearConstraints, UnsolvableError

MARGIN = 0.02


@pytest.fixture
def keep_out():
    return PassageGeometry().keep_out(MARGIN)


def clearance(point):
    """Return the Chebyshev distance from a point to the nearest wall [m], negative inside the wall."""
    return clearances(*PassageGeometry().walls, point).min()


@pytest.mark.parametrize(
    ("start", "target", "reached", "is_blocked"),
    [
        ([0.3, 0.2], [0.45, 0.3], [0.45, 0.3], False),  # free motion
        ([0.5, 0.2], [0.8, 0.25], [0.58, 0.25], False),  # beyond the constraints, where no box is
        ([0.2, 0.3], [0.2, 0.9], [0.2, 0.48], True),  # through a wall
        ([0.2, 0.4], [0.25, 0.49], [0.25, 0.48], True),  # into a wall, along its nearest face
        ([0.35, 0.45], [0.35, 0.65], [0.35, 0.65], False),  # through the gap
    ],
)
def test_motion_ends_before_the_margin(keep_out, start, target, reached, is_blocked):
    safe, blocked = keep_out.project(np.array(start), np.array(target))
    np.testing.assert_allclose(safe, reached, rtol=0.0, atol=1e-5 if is_blocked else 1e-12)
    assert blocked == is_blocked


def test_motion_stops_before_the_margin_for_any_length():
    wall = KeepOut([[0.5, -9.0]], [[0.6, 9.0]], LinearConstraints.none(2), MARGIN)
    for start, end in (([0.0, 0.0], [1.0, 0.0]), ([-3.0, 1.0], [3.0, 1.0]), ([0.4, 2.0], [4.0, 2.0])):
        safe, _ = wall.project(np.array(start), np.array(end))
        np.testing.assert_allclose(safe, [0.48 - 1e-6, start[1]], rtol=0, atol=1e-12)


@pytest.mark.parametrize("start", [[0.2, 0.505], [0.2, 0.59]])
def test_robot_in_a_wall_leaves_on_the_nearer_side(keep_out, start):
    start = np.array(start)
    through = np.array([0.2, 0.9 if start[1] < 0.55 else 0.2])
    safe, blocked = keep_out.project(start, through)
    assert blocked
    np.testing.assert_allclose(safe, start, atol=2e-6)
    retreat = np.array([0.2, 0.3 if start[1] < 0.55 else 0.8])
    np.testing.assert_array_equal(keep_out.project(start, retreat)[0], retreat)


def test_random_commands_stay_outside_the_margin(keep_out):
    rng = np.random.default_rng(0)
    position = np.array([0.3, 0.05])
    for _ in range(3000):
        desired = position + rng.normal(scale=0.2, size=2) if rng.random() < 0.7 else rng.uniform(-1, 2, 2)
        safe, _ = keep_out.project(position, desired)
        # The whole path to the command is outside the margin, not only the end.
        for point in np.linspace(position, safe, 20):
            assert clearance(point) >= MARGIN - 1e-9
            assert point[0] <= 0.58 + 1e-9
        position = safe


def test_target_beyond_two_constraints_moves_to_the_corner():
    corner = KeepOut([[5, 5]], [[6, 6]], LinearConstraints([[-1.0, 0.0], [0.0, -1.0]], [-1.0, -1.0]), margin=0.0)
    safe, _ = corner.project(np.zeros(2), np.array([3.0, 2.0]))
    np.testing.assert_allclose(safe, [1.0, 1.0], atol=1e-9)


SEEDS = st.integers(0, 2**32 - 1)
DISTANCE = 0.05  # margin of the boxes [m]
GAP = 1e-6  # distance of a blocked command from the margin [m]


def clearances(lower, upper, points):
    """Return Chebyshev distances (n, B) from points to boxes [m], negative inside."""
    points = np.atleast_2d(points)[:, None]
    return np.maximum(lower - points, points - upper).max(axis=2)


def scene(seed, dimensions=2, boxes=2, planes=0):
    """Return a random keep-out region, the corners of its disjoint boxes, a start outside, and a desired point."""
    rng = np.random.default_rng(seed)
    while True:
        center, half = rng.uniform(-1, 1, (boxes, dimensions)), rng.uniform(0.05, 0.3, (boxes, dimensions))
        lower, upper = center - half, center + half
        apart = clearances(lower[None, 0], upper[None, 0], center[1:]).min(initial=1.0) - half[1:].max(initial=0.0)
        start = rng.uniform(-1.5, 1.5, dimensions)
        if apart > 3 * DISTANCE and clearances(lower, upper, start).min() > DISTANCE + 1e-3:
            break
    G = rng.standard_normal((planes, dimensions))
    c = G @ start - rng.uniform(0.2, 1.0, planes) - DISTANCE * np.linalg.norm(G, axis=1)
    constraints = LinearConstraints(G, c) if planes else LinearConstraints.none(dimensions)
    return KeepOut(lower, upper, constraints, DISTANCE), lower, upper, start, rng.uniform(-1.5, 1.5, dimensions)


@given(SEEDS, st.integers(1, 3), st.integers(1, 2))
def test_path_stays_outside_the_margin(seed, dimensions, boxes):
    keep_out, lower, upper, start, desired = scene(seed, dimensions, boxes)
    assert keep_out.num_outputs == dimensions
    safe, blocked = keep_out.project(start, desired)
    path = np.linspace(start, safe, 200)
    assert clearances(lower, upper, path).min() >= DISTANCE - 1e-9
    straight = clearances(lower, upper, np.linspace(start, desired, 4000)).min()
    if straight > DISTANCE + 1e-3:
        assert not blocked
        np.testing.assert_array_equal(safe, desired)
    if straight < DISTANCE - 1e-3:
        assert blocked


@given(SEEDS)
def test_blocked_path_ends_at_the_margin(seed):
    """The motion towards a target behind a box ends at the margin of the box."""
    keep_out, lower, upper, start, desired = scene(seed)
    if clearances(lower, upper, desired).min() < DISTANCE + 1e-3:
        return
    safe, blocked = keep_out.project(start, desired)
    path, motion = desired - start, safe - start
    assert abs(path[0] * motion[1] - path[1] * motion[0]) < 1e-12
    assert 0 <= motion @ path <= path @ path + 1e-12
    if blocked:
        assert clearances(lower, upper, safe).min() == pytest.approx(DISTANCE, abs=1e-3)
        beyond = safe + 2e-3 * path / np.linalg.norm(path)
        nearest = clearances(lower, upper, np.linspace(safe, beyond, 50)).min()
        assert nearest <= clearances(lower, upper, safe).min()


@given(SEEDS)
def test_target_in_a_box_is_projected_to_its_nearest_face(seed):
    rng = np.random.default_rng(seed)
    lower, upper = np.zeros((1, 2)), np.array([[0.5, 0.7]])
    keep_out = KeepOut(lower, upper, LinearConstraints.none(2), DISTANCE)
    desired = rng.uniform(lower[0] - 0.9 * DISTANCE, upper[0] + 0.9 * DISTANCE)
    faces = {(0, 0): desired[0] + DISTANCE, (0, 1): 0.5 + DISTANCE - desired[0]}
    faces |= {(1, 0): desired[1] + DISTANCE, (1, 1): 0.7 + DISTANCE - desired[1]}
    (axis, side), _ = min(faces.items(), key=lambda face: face[1])
    expected = desired.copy()
    expected[axis] = (-DISTANCE - GAP, (0.5, 0.7)[axis] + DISTANCE + GAP)[side]
    # The start is straight in front of the face, so that the box does not block the path.
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
    keep_out = KeepOut(np.array([[90.0, 90]]), np.array([[91.0, 91]]), constraints, DISTANCE)
    if (c + DISTANCE * norms > -1e-3).any():
        return  # the start is inside the margin of a constraint
    desired = rng.uniform(-3, 3, 2)
    safe, blocked = keep_out.project(np.zeros(2), desired)
    assert not blocked
    distances = (G @ safe - c) / norms
    assert distances.min() >= DISTANCE - 1e-9
    tightened = LinearConstraints(G, c + DISTANCE * norms)
    np.testing.assert_allclose(safe, tightened.nearest(desired), rtol=0, atol=1e-8)
    if ((G @ desired - c) / norms).min() >= DISTANCE:
        np.testing.assert_array_equal(safe, desired)


@given(SEEDS)
def test_robot_within_the_margin_comes_no_closer(seed):
    """From within the margin or a box, the clearance never decreases, and the robot may leave."""
    rng = np.random.default_rng(seed)
    lower, upper = np.array([[0.0, 0.0]]), np.array([[0.4, 0.6]])
    keep_out = KeepOut(lower, upper, LinearConstraints.none(2), DISTANCE)
    start = rng.uniform(lower[0] - DISTANCE, upper[0] + DISTANCE)
    clearance = clearances(lower, upper, start).item()
    desired = rng.uniform(-1, 1.5, 2)
    safe, _ = keep_out.project(start, desired)
    path = np.linspace(start, safe, 100)
    assert clearances(lower, upper, path).min() >= min(clearance, DISTANCE) - 2 * GAP
    # A motion straight away from the nearest face is not limited.
    gaps = np.concatenate([lower[0] - start, start - upper[0]])
    face = int(np.argmax(gaps))
    direction = np.eye(2)[face % 2] * (-1.0 if face < 2 else 1.0)
    away = start + direction
    free, blocked = keep_out.project(start, away)
    np.testing.assert_array_equal(free, away)
    assert not blocked


def test_box_may_extend_to_infinity():
    wall = KeepOut([[0.3, -np.inf]], [[0.5, np.inf]], LinearConstraints.none(2), DISTANCE)
    for y in (-100.0, 0.0, 1e6):
        safe, blocked = wall.project(np.array([0.0, y]), np.array([1.0, y]))
        np.testing.assert_allclose(safe, [0.25, y], atol=1e-5)
        assert blocked
        free, blocked = wall.project(np.array([0.0, y]), np.array([0.1, y + 5]))
        np.testing.assert_array_equal(free, [0.1, y + 5])
        assert not blocked


def test_motion_along_a_face_is_not_blocked():
    box = KeepOut([[0.0, 0.0]], [[1.0, 1.0]], LinearConstraints.none(2), DISTANCE)
    start = np.array([-0.5, 1.0 + DISTANCE])
    for desired in (np.array([1.5, 1.0 + DISTANCE]), start):
        safe, blocked = box.project(start, desired)
        np.testing.assert_array_equal(safe, desired)
        assert not blocked
    safe, blocked = box.project(np.array([-0.5, 0.5]), np.array([1.5, 0.5]))
    assert blocked
    assert safe[0] == pytest.approx(-DISTANCE, abs=1e-5)


def test_first_of_two_walls_stops_the_motion():
    walls = KeepOut([[0.5, -1.0], [0.2, -1.0]], [[0.6, 1.0], [0.3, 1.0]], LinearConstraints.none(2), 0.0)
    for start, end, wall in ((0.0, 1.0, 0.2), (1.0, 0.0, 0.6), (0.4, 1.0, 0.5), (0.4, 0.0, 0.3)):
        safe, blocked = walls.project(np.array([start, 0.0]), np.array([end, 0.0]))
        assert blocked
        assert safe[0] == pytest.approx(wall, abs=1e-5)


NONE = LinearConstraints.none(2)
UNIT = [[0.0, 0.0]], [[1.0, 1.0]]


@pytest.mark.parametrize(
    ("lower", "upper", "constraints", "margin"),
    [
        (*UNIT, LinearConstraints.none(3), 0.1),
        (*UNIT, LinearConstraints(np.zeros((3, 1, 2)), -np.ones((3, 1))), 0.1),
        ([[0, 0], [0, 0]], [[1, 1]], NONE, 0.1),
        ([[0, 0]], [[1]], NONE, 0.1),
        ([[0, 1]], [[2, 1]], NONE, 0.0),
        ([[0, 1]], [[2, 0.9995]], NONE, 0.0),
        *((*UNIT, NONE, margin) for margin in (-1e-9, np.inf, np.nan)),
    ],
)
def test_constructor_refuses_invalid_arguments(lower, upper, constraints, margin):
    with pytest.raises(InputError):
        KeepOut(lower, upper, constraints, margin)
    KeepOut([[0.0, 1.0]], [[2.0, np.nextafter(1.0, 2.0)]], NONE, 0.0)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_position_that_is_not_finite_is_refused(value):
    wall = KeepOut([[0.4, -9.0]], [[0.6, 9.0]], LinearConstraints.none(2), 0.02)
    positions = np.array([0.2, 0.2]), np.array([value, 0.2])
    for position, desired in (positions, positions[::-1]):
        with pytest.raises(UnsolvableError, match="finite"):
            wall.project(position, desired)


@pytest.mark.parametrize(
    ("position", "face", "bound"),
    [
        # Faces of the box from (1, 2, 5) to (2, 4, 9): unit normal, bound without the margin.
        ([0.0, 3.0, 6.0], [-1.0, 0.0, 0.0], -1.0),
        ([3.0, 3.0, 6.0], [1.0, 0.0, 0.0], 2.0),
        ([1.5, -1.0, 4.0], [0.0, -1.0, 0.0], -2.0),
        ([0.5, 7.0, 6.0], [0.0, 1.0, 0.0], 4.0),
        ([1.5, 3.0, 1.0], [0.0, 0.0, -1.0], -5.0),
        ([1.5, 5.0, 11.0], [0.0, 0.0, 1.0], 9.0),
    ],
)
def test_half_space_of_a_box_is_at_the_face_of_most_clearance(position, face, bound):
    constraints = LinearConstraints(np.array([[3.0, 4.0, 0.0]]), np.array([-70.0]))
    lower, upper = [[1.0, 2.0, 5.0], [-9.0, -9.0, -9.0]], [[2.0, 4.0, 9.0], [-8.0, -8.0, -8.0]]
    G, c = KeepOut(lower, upper, constraints, 0.25).half_spaces(np.array(position))
    np.testing.assert_allclose(G[:2], [[0.6, 0.8, 0.0], face], rtol=1e-15)
    np.testing.assert_allclose(c[:2], [-14.0 + 0.25, bound + 0.25], rtol=1e-15)
    axis = int(np.argmax(position))
    np.testing.assert_array_equal(G[2], np.eye(3)[axis])
    assert c[2] == -8.0 + 0.25


def test_projection_satisfies_a_second_violated_constraint():
    constraints = LinearConstraints(np.array([[-1.0, 0.0], [-2.0, -2.0]]), np.array([-1.0, -2.0]))
    no_boxes = np.empty((0, 2))
    keep_out = KeepOut(no_boxes, no_boxes, constraints, 0.0)
    safe, is_changed = keep_out.project(np.zeros(2), np.array([0.5, 1.5]))  # only x + y <= 1 is violated
    np.testing.assert_allclose(safe, [0.0, 1.0], rtol=0.0, atol=1e-12)
    assert not is_changed
    safe, _ = keep_out.project(np.zeros(2), np.array([5.0, 1.0]))  # both are violated; their boundaries meet at (1, 0)
    np.testing.assert_allclose(safe, [1.0, 0.0], rtol=0.0, atol=1e-6)


SQUARE = ([[1.0, 1.0]], [[2.0, 2.0]])


def test_target_moved_out_of_a_box_satisfies_constraints():
    """The nearest face of the box is at y = 2, which violates the constraint y <= 1.9."""
    keep_out = KeepOut(*SQUARE, LinearConstraints.box([-np.inf, -np.inf], [np.inf, 1.9]), 0.0)
    safe, is_blocked = keep_out.project(np.array([0.5, 1.85]), np.array([1.5, 1.9]))
    assert is_blocked
    assert safe[0] <= 1.0
    assert safe[1] <= 1.9


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("start", "target", "expected"), [(4.0, 1.95, 2.25 + 1e-6), (-1.0, 1.05, 0.75 - 1e-6)])
def test_target_in_a_box_is_moved_to_the_nearest_margin(axis, start, target, expected):
    keep_out = KeepOut(*SQUARE, LinearConstraints.none(2), 0.25)
    begin, desired, reached = ([1.4, 1.4], [1.6, 1.6], [1.6, 1.6])
    begin[axis], desired[axis], reached[axis] = start, target, expected
    safe, is_blocked = keep_out.project(np.array(begin), np.array(desired))
    np.testing.assert_allclose(safe, reached, rtol=0.0, atol=1e-9)
    assert is_blocked


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("face", [1.0, 2.0])
def test_motion_along_every_face_is_free_without_a_margin(axis, face):
    keep_out = KeepOut(*SQUARE, LinearConstraints.none(2), 0.0)
    start, desired = np.array([0.5, 0.5]), np.array([1.5, 1.5])
    start[axis] = desired[axis] = face
    safe, is_blocked = keep_out.project(start, desired)
    np.testing.assert_array_equal(safe, desired)
    assert not is_blocked


@pytest.mark.parametrize(("shift", "is_blocked"), [(-4e-4, True), (0.0, False), (4e-4, False)])
def test_motion_is_blocked_when_the_path_cuts_a_corner(shift, is_blocked):
    keep_out = KeepOut(*SQUARE, LinearConstraints.none(2), 0.0)
    start = np.array([0.0, 1.0 + shift])
    desired = start + 2.0  # passes the corner (1, 2)
    safe, blocked = keep_out.project(start, desired)
    assert blocked == is_blocked
    expected = [1.0, 2.0 + shift] if is_blocked else desired
    np.testing.assert_allclose(safe, expected, rtol=0.0, atol=2e-6)
