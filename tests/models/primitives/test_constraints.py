import numpy as np
import pytest

from guiderail.models.errors import InputError
from guiderail.models.primitives import LinearConstraints


def test_box_is_its_half_spaces():
    box = LinearConstraints.box([-1, -np.inf], [2, 3])
    assert box.num_constraints == 3
    assert box.violation(np.array([0.0, 0.0])) == pytest.approx(-1)
    assert box.violation(np.array([2.5, 0.0])) == pytest.approx(0.5)
    assert box.violation(np.array([0.0, 3.25])) == pytest.approx(0.25)


def test_no_constraint_is_never_violated():
    assert LinearConstraints.none(3).violation(np.full(3, 1e9)) == -np.inf
    assert LinearConstraints.box([-np.inf] * 2, [np.inf] * 2).num_constraints == 0


def test_steps_past_the_end_keep_the_last():
    box = LinearConstraints.box(np.zeros((3, 1)), np.array([[1.0], [2.0], [3.0]]))
    _, c = box.window(np.array([1, 2, 5]))
    np.testing.assert_array_equal(c, [[0, -2], [0, -3], [0, -3]])
    assert box.violation(np.array([2.5]), 9) < 0


def test_nearest_is_a_projection():
    constraints = LinearConstraints([[-1.0, -1.0], [0.0, 1.0]], [-1.0, 0.0])
    np.testing.assert_allclose(constraints.nearest([1.0, 1.0]), [0.5, 0.5], atol=1e-12)
    np.testing.assert_array_equal(constraints.nearest([0.2, 0.1]), [0.2, 0.1])


@pytest.mark.parametrize(
    ("G", "c"),
    [
        ([[1.0], [-1.0]], [1.0, 0.0]),
        ([[1.0, 0.0], [-1.0, 1.0], [0.0, -1.0]], [1.0, 1.0, -1.0]),
        ([[0.0]], [1.0]),
        ([[1e-3], [-1e-3]], [1e-3, 0.0]),
    ],
)
def test_refuses_contradictions(G, c):
    with pytest.raises(InputError, match="contradict"):
        LinearConstraints(G, c)


def test_refuses_a_contradiction_at_one_step_and_says_which():
    lower, upper = np.zeros((4, 1)), np.ones((4, 1))
    upper[2] = -1
    with pytest.raises(InputError, match="at step 2"):
        LinearConstraints.box(lower, upper)


def test_equal_bounds_are_no_contradiction():
    assert LinearConstraints.box([1.0], [1.0]).violation(np.array([1.0])) == 0


@pytest.mark.parametrize(("G", "c"), [([[1.0]], [1.0, 2.0]), ([1.0], [1.0]), ([[np.nan]], [0.0]), ([[1.0]], [np.inf])])
def test_refuses_shapes_and_numbers(G, c):
    with pytest.raises(InputError):
        LinearConstraints(G, c)
