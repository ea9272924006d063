import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints


def test_box_equals_its_half_spaces():
    box = LinearConstraints.box([-1, -np.inf], [2, 3])
    assert box.num_constraints == 3
    assert box.violation(np.array([0.0, 0.0])) == pytest.approx(-1)
    assert box.violation(np.array([2.5, 0.0])) == pytest.approx(0.5)
    assert box.violation(np.array([0.0, 3.25])) == pytest.approx(0.25)


def test_none_is_never_violated():
    assert LinearConstraints.none(3).violation(np.full(3, 1e9)) == -np.inf
    assert LinearConstraints.box([-np.inf] * 2, [np.inf] * 2).num_constraints == 0


def test_window_repeats_the_last_step_past_the_end():
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
def test_constructor_refuses_contradictions(G, c):
    with pytest.raises(InputError, match="contradict"):
        LinearConstraints(G, c)


def test_contradiction_at_one_step_names_the_step():
    lower, upper = np.zeros((4, 1)), np.ones((4, 1))
    upper[2] = -1
    with pytest.raises(InputError, match="at step 2"):
        LinearConstraints.box(lower, upper)


def test_box_accepts_equal_bounds():
    assert LinearConstraints.box([1.0], [1.0]).violation(np.array([1.0])) == 0


@pytest.mark.parametrize(("G", "c"), [([[1.0]], [1.0, 2.0]), ([1.0], [1.0]), ([[np.nan]], [0.0]), ([[1.0]], [np.inf])])
def test_constructor_refuses_shapes_and_numbers(G, c):
    with pytest.raises(InputError):
        LinearConstraints(G, c)


SEEDS = st.integers(0, 2**32 - 1)


def polytope(seed, steps=None):
    """Draw half spaces around a point, with rows of any length, and return the point."""
    rng = np.random.default_rng(seed)
    outputs, rows = rng.integers(1, 5), rng.integers(1, 7)
    shape = (rows, outputs) if steps is None else (steps, rows, outputs)
    G = rng.standard_normal(shape) * 10 ** rng.uniform(-3, 3, (*shape[:-1], 1))
    inside = rng.standard_normal(outputs)
    size = np.linalg.norm(G, axis=-1)
    return rng, G, G @ inside - size * rng.uniform(0.01, 1, shape[:-1]), inside


@given(SEEDS)
def test_nearest_is_allowed_and_no_allowed_point_is_nearer(seed):
    rng, G, c, inside = polytope(seed)
    constraints = LinearConstraints(G, c)
    wanted = inside + 3 * rng.standard_normal(len(inside))
    found = constraints.nearest(wanted)
    size = np.linalg.norm(G, axis=1)
    assert ((c - G @ found) / size).max() <= 1e-9
    # A projection's angle to every allowed point is obtuse.
    for allowed in inside + rng.uniform(0, 1, (50, 1)) * rng.standard_normal((50, len(inside))):
        if (G @ allowed >= c).all():
            assert (wanted - found) @ (allowed - found) <= 1e-7
    if (G @ wanted >= c).all():
        np.testing.assert_array_equal(found, wanted)
        assert found is not wanted


@given(SEEDS)
def test_violation_is_the_largest_of_the_rows_of_a_step(seed):
    rng, G, c, inside = polytope(seed, steps=4)
    constraints = LinearConstraints(G, c)
    assert (constraints.num_steps, constraints.num_constraints, constraints.num_outputs) == G.shape
    output = inside + rng.standard_normal(len(inside))
    for step in (0, 1, 3, 4, 100):
        n = min(step, 3)
        assert constraints.violation(output, step) == max(c[n] - G[n] @ output)
    alone = LinearConstraints(G[2], c[2])
    assert alone.num_steps is None
    assert constraints.violation(output, 2) == alone.violation(output) == alone.violation(output, 99)
    np.testing.assert_allclose(constraints.nearest(output, 2), alone.nearest(output), atol=1e-12)
    windowed = constraints.window(np.array([1, 3, 7]))
    np.testing.assert_array_equal(windowed[0], G[[1, 3, 3]])
    np.testing.assert_array_equal(windowed[1], c[[1, 3, 3]])
    repeated = alone.window(np.array([0, 5]))
    np.testing.assert_array_equal(repeated[0], [G[2]] * 2)
    np.testing.assert_array_equal(repeated[1], [c[2]] * 2)


@given(SEEDS)
def test_constructor_refuses_exactly_the_contradictions(seed):
    """Refuse planes around a point exactly if one more plane excludes every point."""
    rng, G, c, inside = polytope(seed)
    LinearConstraints(G, c)
    row = int(rng.integers(len(G)))
    size = np.linalg.norm(G[row])
    # The opposite of a row: a slab of some width, or none.
    for width, fine in ((1e-3 * size, True), (-1e-3 * size, False)):
        lower = G[row] @ inside
        slab = [*G, -G[row], G[row]], [*c, -(lower + width), lower]
        if fine:
            assert LinearConstraints(*slab).violation(inside) <= 1e-9 * size
        else:
            with pytest.raises(InputError, match="contradict"):
                LinearConstraints(*slab)


def test_box_keeps_the_order_of_bounds_per_step():
    lower = np.array([[0.0, -np.inf, 1.0], [0.1, -np.inf, 1.1]])
    upper = np.array([[2.0, 3.0, np.inf], [2.1, 3.1, np.inf]])
    box = LinearConstraints.box(lower, upper)
    assert (box.num_steps, box.num_constraints) == (2, 4)
    np.testing.assert_array_equal(box.G[1], [[1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(box.c, [[0, -2, -3, 1], [0.1, -2.1, -3.1, 1.1]])
    one = LinearConstraints.box(0.0, [1.0, 2.0])
    np.testing.assert_array_equal(one.c, [0, -1, 0, -2])


@pytest.mark.parametrize(
    ("lower", "upper"),
    [
        ([np.nan], [1.0]),
        ([0.0], [np.nan]),
        (0.0, 1.0),
        (np.zeros((2, 2, 2)), np.ones((2, 2, 2))),
        ([[0.0], [-np.inf]], [[1.0], [1.0]]),
        ([1.0], [0.0]),
        ([0.0, 0.0], [1.0, 1.0, 1.0]),
        (["a"], [1.0]),
        ([1j], [2.0]),
    ],
)
def test_box_refuses_invalid_bounds(lower, upper):
    with pytest.raises(InputError):
        LinearConstraints.box(lower, upper)


def test_constructor_checks_every_distinct_step():
    G, c = np.ones((50, 1, 1)), np.zeros((50, 1))
    LinearConstraints(G, c)
    G, c = np.tile([[[1.0], [-1.0]]], (50, 1, 1)), np.tile([0.0, -1.0], (50, 1))
    LinearConstraints(G, c)
    c[49] = [1.0, 0.0]
    with pytest.raises(InputError, match="at step 49 contradict"):
        LinearConstraints(G, c)
    c[7] = [1.0, 0.0]
    with pytest.raises(InputError, match="at step 7 contradict"):
        LinearConstraints(G, c)


def test_nearest_uses_the_first_step_by_default():
    box = LinearConstraints.box([[0.0], [5.0]], [[1.0], [6.0]])
    np.testing.assert_allclose(box.nearest(np.array([9.0])), [1.0])
    np.testing.assert_allclose(box.nearest([9], 1), [6.0])
    inside = [0.25]
    assert box.nearest(inside) is not inside


@pytest.mark.parametrize("gap", [0.0, 1e-7, 1e-12])
def test_constructor_refuses_contradictions_of_fixed_outputs(gap):
    fixed = LinearConstraints.box([0.2, 0.0], [0.2 + gap, 1.0])
    nearest = fixed.nearest(np.array([5.0, 0.5]))
    assert fixed.violation(nearest) <= 1e-9
    np.testing.assert_allclose(nearest, [0.2 + gap, 0.5], atol=1e-9)
    if gap:
        with pytest.raises(InputError, match="contradict each other"):
            LinearConstraints.box([0.2 + gap, 0.0], [0.2, 1.0])


def test_constructor_refuses_small_contradictions_of_rows():
    with pytest.raises(InputError, match="contradict each other"):
        LinearConstraints(np.array([[1.0, 1.0], [-1.0, -1.0]]), np.array([1.0, -1.0 + 5e-8]))
