import numpy as np
import pytest
from constraint_scaling import attack
from hypothesis import given
from hypothesis import strategies as st

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints, UnsolvableError


def test_box_equals_its_half_spaces():
    box = LinearConstraints.box([-1, -np.inf], [2, 3])
    assert box.num_constraints == 3
    assert box.violation(np.array([0.0, 0.0])) == pytest.approx(-1)
    assert box.violation(np.array([2.5, 0.0])) == pytest.approx(0.5)
    assert box.violation(np.array([0.0, 3.25])) == pytest.approx(0.25)


def test_empty_constraints_are_never_violated():
    assert LinearConstraints.none(3).violation(np.full(3, 1e9)) == -np.inf
    assert LinearConstraints.box([-np.inf] * 2, [np.inf] * 2).num_constraints == 0


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
        ([[1.0, 1.0], [-1.0, -1.0]], [1.0, -1.0 + 5e-8]),
    ],
)
def test_constructor_refuses_contradictions(G, c):
    with pytest.raises(InputError, match="contradict each other"):
        LinearConstraints(G, c)


@pytest.mark.parametrize(("G", "c"), [([[1.0]], [1.0, 2.0]), ([1.0], [1.0]), ([[np.nan]], [0.0]), ([[1.0]], [np.inf])])
def test_constructor_refuses_invalid_shapes_and_values(G, c):
    with pytest.raises(InputError):
        LinearConstraints(G, c)


SEEDS = st.integers(0, 2**32 - 1)


def polytope(seed, steps=None):
    """Return a generator, half spaces G x ≥ c with rows of any norm, and a point inside all of them."""
    rng = np.random.default_rng(seed)
    outputs, rows = rng.integers(1, 5), rng.integers(1, 7)
    shape = (rows, outputs) if steps is None else (steps, rows, outputs)
    G = rng.standard_normal(shape) * 10 ** rng.uniform(-3, 3, (*shape[:-1], 1))
    inside = rng.standard_normal(outputs)
    size = np.linalg.norm(G, axis=-1)
    return rng, G, G @ inside - size * rng.uniform(0.01, 1, shape[:-1]), inside


@given(SEEDS, st.integers(-9, 9))
def test_rows_are_normalized(seed, exponent):
    rng, G, c, _ = polytope(seed, steps=3)
    factor = 10.0 ** (exponent * rng.uniform(0, 1, c.shape))
    size = np.linalg.norm(G, axis=2)
    scaled = LinearConstraints(factor[..., None] * G, factor * c)
    np.testing.assert_allclose(scaled.G, G / size[..., None], rtol=0, atol=1e-15)
    np.testing.assert_allclose(scaled.c, c / size, rtol=1e-14)
    second = LinearConstraints(scaled.G, scaled.c)
    np.testing.assert_array_equal(second.G, scaled.G)
    np.testing.assert_array_equal(second.c, scaled.c)


def test_normalization_preserves_unit_and_zero_rows():
    G = np.array([[0.6, 0.8], [0.0, -1.0], [0.0, 0.0], [np.cos(0.1), np.sin(0.1)]])
    c = np.array([-0.1, -0.3, -7.0, -0.7])
    constraints = LinearConstraints(G, c)
    np.testing.assert_array_equal(constraints.G, G)
    np.testing.assert_array_equal(constraints.c, c)
    assert constraints.violation(np.zeros(2)) == -0.1


@pytest.mark.parametrize("size", [1e-300, 1e-160, 1e160, 1e300, 5e-324])
def test_rows_of_any_size_are_normalized(size):
    constraints = LinearConstraints([[3 * size, 4 * size]] if size > 1e-300 else [[size, 0.0]], [0.0])
    np.testing.assert_allclose(np.linalg.norm(constraints.G), 1.0, rtol=1e-15)


def test_constructor_refuses_a_bound_that_overflows():
    with pytest.raises(InputError, match="norm of its row is not finite"):
        LinearConstraints([[1e-300]], [-1e10])


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize("oblique", [False, True])
@pytest.mark.parametrize(("gap", "is_refused"), [(0.0, False), (1e-16, False), (1e-12, True), (1e-10, True)])
def test_constructor_refuses_contradictions_beyond_rounding(scale, oblique, gap, is_refused):
    row = np.array([0.6, 0.8]) if oblique else np.array([1.0, 0.0])
    G, c = np.array([scale * row, -row, [0.0, 1.0]]), np.array([scale * 0.5, -0.5 + gap, -3.0])
    if is_refused:
        with pytest.raises(InputError, match="contradict each other"):
            LinearConstraints(G, c)
    else:
        constraints = LinearConstraints(G, c)
        assert constraints.violation(constraints.nearest([9.0, 9.0])) <= 1e-9


def test_constructor_accepts_three_lines_through_one_point():
    """Rounding can leave the lines without a common point."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        angles, point = rng.uniform(0, 2 * np.pi) + np.array([0, 2, 4]) * np.pi / 3, 100 * rng.standard_normal(2)
        G = np.column_stack([np.cos(angles), np.sin(angles)])
        constraints = LinearConstraints(G, G @ point)
        np.testing.assert_allclose(constraints.nearest(point + 1.0), point, atol=1e-9)
        with pytest.raises(InputError, match="contradict each other"):
            LinearConstraints(G, G @ point + 1e-10)


@given(SEEDS)
def test_nearest_is_allowed_if_the_solver_fails(seed):
    def unsolvable(*arguments):
        raise UnsolvableError("no solution")

    rng, G, c, inside = polytope(seed, steps=3)
    G[..., -1] = 0.0 if G.shape[2] > 1 else G[..., -1]  # an output without a constraint, which must not change
    c = G @ inside - 0.1 * np.linalg.norm(G, axis=2)
    constraints = LinearConstraints(G, c)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("guiderail.models.primitives.constraints.solve_least_norm", unsolvable)
        for distance in (1e-6, 1.0, 1e9):
            desired = inside + distance * rng.standard_normal(len(inside))
            for step in (0, 2, 7):
                result = constraints.nearest(desired, step)
                n = min(step, 2)
                size = np.linalg.norm(G[n], axis=1)
                assert ((c[n] - G[n] @ result) / np.where(size > 0, size, 1)).max() <= 1e-9
                assert len(result) == 1 or result[-1] == desired[-1]
        nearest = LinearConstraints.box([0.0, -1.0], [2.0, 1.0]).nearest(np.array([3.0, 2.0]))
        np.testing.assert_allclose(nearest, [2.0, 1.0])
        nearest = LinearConstraints.box([0.0, -1.0], [2.0, 1.0]).nearest(np.array([5.0, 1.0]))
        np.testing.assert_allclose(nearest, [2.0, 0.25])


@pytest.mark.parametrize("upper", [1.0, np.inf])
@pytest.mark.parametrize("output", [np.nan, np.inf])
def test_nearest_refuses_an_output_that_is_not_finite(upper, output):
    for constraints in (LinearConstraints.box([0.0], [upper]), LinearConstraints.none(1)):
        with pytest.raises(UnsolvableError, match="finite"):
            constraints.nearest([output])


def test_attack_on_scaled_constraints_finds_no_violation():
    for result in attack(6000).values():
        assert result.worst <= 1e-9
        assert result.corrected + result.fallbacks > 100


@given(SEEDS)
def test_nearest_is_the_closest_allowed_point(seed):
    rng, G, c, inside = polytope(seed)
    constraints = LinearConstraints(G, c)
    desired = inside + 3 * rng.standard_normal(len(inside))
    result = constraints.nearest(desired)
    size = np.linalg.norm(G, axis=1)
    assert ((c - G @ result) / size).max() <= 1e-9
    # The vectors from a projection to the desired point and to an allowed point are at an angle of at least 90°.
    for allowed in inside + rng.uniform(0, 1, (50, 1)) * rng.standard_normal((50, len(inside))):
        if (G @ allowed >= c).all():
            assert (desired - result) @ (allowed - result) <= 1e-7
    if (G @ desired >= c).all():
        np.testing.assert_array_equal(result, desired)
        assert result is not desired


@given(SEEDS)
def test_violation_is_the_largest_row_violation_of_a_step(seed):
    rng, G, c, inside = polytope(seed, steps=4)
    constraints = LinearConstraints(G, c)
    G, c = constraints.G, constraints.c
    assert (constraints.num_steps, constraints.num_constraints, constraints.num_outputs) == G.shape
    output = inside + rng.standard_normal(len(inside))
    for step in (0, 1, 3, 4, 100):
        n = min(step, 3)
        assert constraints.violation(output, step) == max(c[n] - G[n] @ output)
    constant = LinearConstraints(G[2], c[2])
    assert constant.num_steps is None
    assert constraints.violation(output, 2) == constant.violation(output) == constant.violation(output, 99)
    np.testing.assert_allclose(constraints.nearest(output, 2), constant.nearest(output), atol=1e-12)
    window = constraints.window(np.array([1, 3, 7]))
    np.testing.assert_array_equal(window[0], G[[1, 3, 3]])
    np.testing.assert_array_equal(window[1], c[[1, 3, 3]])
    repeated = constant.window(np.array([0, 5]))
    np.testing.assert_array_equal(repeated[0], [G[2]] * 2)
    np.testing.assert_array_equal(repeated[1], [c[2]] * 2)


@given(SEEDS)
def test_constructor_refuses_a_slab_of_negative_width(seed):
    """A row and its opposite form a slab: a positive width is accepted, and a negative width is refused."""
    rng, G, c, inside = polytope(seed)
    LinearConstraints(G, c)
    row = int(rng.integers(len(G)))
    size = np.linalg.norm(G[row])
    for width, is_feasible in ((1e-3 * size, True), (-1e-3 * size, False)):
        lower = G[row] @ inside
        slab = [*G, -G[row], G[row]], [*c, -(lower + width), lower]
        if is_feasible:
            assert LinearConstraints(*slab).violation(inside) <= 1e-9 * size
        else:
            with pytest.raises(InputError, match="contradict"):
                LinearConstraints(*slab)


def test_box_rows_are_ordered_by_output_lower_bound_first():
    lower = np.array([[0.0, -np.inf, 1.0], [0.1, -np.inf, 1.1]])
    upper = np.array([[2.0, 3.0, np.inf], [2.1, 3.1, np.inf]])
    box = LinearConstraints.box(lower, upper)
    assert (box.num_steps, box.num_constraints) == (2, 4)
    np.testing.assert_array_equal(box.G[1], [[1, 0, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1]])
    np.testing.assert_array_equal(box.c, [[0, -2, -3, 1], [0.1, -2.1, -3.1, 1.1]])
    scalar_lower = LinearConstraints.box(0.0, [1.0, 2.0])
    np.testing.assert_array_equal(scalar_lower.c, [0, -1, 0, -2])


@pytest.mark.parametrize(
    ("lower", "upper"), [([np.nan], [1.0]), ([0.0], [np.nan]), ([[0.0], [-np.inf]], [[1.0], [1.0]]), ([1.0], [0.0])]
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


def test_fallback_uses_the_first_step_before_the_motion(monkeypatch):
    box = LinearConstraints.box([[0.0, 0.0], [0.0, 8.0]], [[2.0, 1.0], [2.0, 9.0]])

    def fail(*_):
        raise UnsolvableError

    monkeypatch.setattr("guiderail.models.primitives.constraints.solve_least_norm", fail)
    np.testing.assert_array_equal(box.nearest([5.0, 0.0], -1), box.nearest([5.0, 0.0], 0))


@pytest.mark.parametrize("gap", [0.0, 1e-7, 1e-12])
def test_constructor_refuses_contradictions_of_fixed_outputs(gap):
    fixed = LinearConstraints.box([0.2, 0.0], [0.2 + gap, 1.0])
    nearest = fixed.nearest(np.array([5.0, 0.5]))
    assert fixed.violation(nearest) <= 1e-9
    np.testing.assert_allclose(nearest, [0.2 + gap, 0.5], atol=1e-9)
    if gap:
        with pytest.raises(InputError, match="contradict each other"):
            LinearConstraints.box([0.2 + gap, 0.0], [0.2, 1.0])


def test_constraints_of_the_end_steps_apply_beyond_the_motion():
    box = LinearConstraints.box(np.full((3, 1), -np.inf), np.array([[0.0], [1.0], [2.0]]))
    assert [box.violation(np.array([0.0]), step) for step in (-2, 0, 2, 5)] == [0.0, 0.0, -2.0, -2.0]
    _, c = box.window(np.array([-1, 0, 1, 3]))
    np.testing.assert_array_equal(c[:, 0], [0.0, 0.0, -1.0, -2.0])
