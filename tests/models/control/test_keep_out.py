import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.objects.narrow_passage.geometry import PassageGeometry
from guiderail.models.primitives import LinearConstraints

MARGIN = 0.02


@pytest.fixture
def keep_out():
    return PassageGeometry().keep_out(MARGIN)


def clearance(point):
    """Return the Chebyshev distance from a point to the nearest wall [m], negative inside it."""
    lower, upper = PassageGeometry().walls
    return np.maximum(lower - point, point - upper).max(axis=1).min()


def test_free_motion_is_not_changed(keep_out):
    safe, blocked = keep_out.project(np.array([0.3, 0.2]), np.array([0.45, 0.3]))
    np.testing.assert_array_equal(safe, [0.45, 0.3])
    assert not blocked


def test_motion_stops_before_constraints_without_a_box(keep_out):
    safe, blocked = keep_out.project(np.array([0.5, 0.2]), np.array([0.8, 0.25]))
    np.testing.assert_allclose(safe, [0.58, 0.25], atol=1e-12)
    assert not blocked


def test_step_through_a_wall_stops_before_it(keep_out):
    safe, blocked = keep_out.project(np.array([0.2, 0.3]), np.array([0.2, 0.9]))
    np.testing.assert_allclose(safe, [0.2, 0.48], atol=1e-5)
    assert blocked


def test_target_inside_a_wall_slides_along_the_nearest_face(keep_out):
    safe, blocked = keep_out.project(np.array([0.2, 0.4]), np.array([0.25, 0.49]))
    np.testing.assert_allclose(safe, [0.25, 0.48], atol=1e-5)
    assert blocked


def test_motion_passes_the_gap(keep_out):
    safe, blocked = keep_out.project(np.array([0.35, 0.45]), np.array([0.35, 0.65]))
    np.testing.assert_array_equal(safe, [0.35, 0.65])
    assert not blocked


def test_motion_stops_before_the_margin_for_any_length():
    wall = KeepOut([[0.5, -9.0]], [[0.6, 9.0]], LinearConstraints.none(2), MARGIN)
    for start, end in (([0.0, 0.0], [1.0, 0.0]), ([-3.0, 1.0], [3.0, 1.0]), ([0.4, 2.0], [4.0, 2.0])):
        safe, _ = wall.project(np.array(start), np.array(end))
        np.testing.assert_allclose(safe, [0.48 - 1e-6, start[1]], rtol=0, atol=1e-12)


def test_robot_in_the_margin_may_leave_but_not_come_closer(keep_out):
    start = np.array([0.2, 0.495])
    nearer, _ = keep_out.project(start, np.array([0.2, 0.7]))
    assert clearance(nearer) >= clearance(start) - 1e-6
    away, blocked = keep_out.project(start, np.array([0.2, 0.4]))
    np.testing.assert_array_equal(away, [0.2, 0.4])
    assert not blocked


@pytest.mark.parametrize("start", [[0.2, 0.505], [0.2, 0.59]])
def test_robot_in_a_wall_leaves_on_its_side(keep_out, start):
    start = np.array(start)
    through = np.array([0.2, 0.9 if start[1] < 0.55 else 0.2])
    safe, blocked = keep_out.project(start, through)
    assert blocked
    np.testing.assert_allclose(safe, start, atol=2e-6)
    retreat = np.array([0.2, 0.3 if start[1] < 0.55 else 0.8])
    np.testing.assert_array_equal(keep_out.project(start, retreat)[0], retreat)


def test_random_commands_keep_the_margin(keep_out):
    rng = np.random.default_rng(0)
    position = np.array([0.3, 0.05])
    for _ in range(3000):
        desired = position + rng.normal(scale=0.2, size=2) if rng.random() < 0.7 else rng.uniform(-1, 2, 2)
        safe, _ = keep_out.project(position, desired)
        # The margin must hold on the whole path to the command, not only at its end.
        for point in np.linspace(position, safe, 20):
            assert clearance(point) >= MARGIN - 1e-9
            assert point[0] <= 0.58 + 1e-9
        position = safe


def test_two_active_constraints_give_the_nearest_corner():
    corner = KeepOut([[5, 5]], [[6, 6]], LinearConstraints([[-1.0, 0.0], [0.0, -1.0]], [-1.0, -1.0]), margin=0.0)
    safe, _ = corner.project(np.zeros(2), np.array([3.0, 2.0]))
    np.testing.assert_allclose(safe, [1.0, 1.0], atol=1e-9)


@pytest.mark.parametrize(
    ("lower", "upper", "margin"), [([[0, 0]], [[0, 1]], 0.1), ([[0, 0]], [[1]], 0.1), ([[0, 0]], [[1, 1]], -0.1)]
)
def test_constructor_refuses_empty_boxes_and_invalid_margins(lower, upper, margin):
    with pytest.raises(InputError):
        KeepOut(lower, upper, LinearConstraints.none(2), margin)
