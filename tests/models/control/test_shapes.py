import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.control.shapes import CLEARANCE, Box, Cylinder, Sphere, linearize
from guiderail.models.primitives import LinearConstraints

SHAPES = {
    "sphere": Sphere([0.1, -0.2, 0.3], 0.2),
    "disc": Sphere([0.1, -0.2], 0.2, 0.05),
    "box": Box([-0.1, -0.2, 0.0], [0.3, 0.1, 0.2]),
    "wall": Box([-np.inf, 0.1], [0.2, np.inf], 0.03),
    "cylinder": Cylinder([0.0, 0.1, -0.1], [0.2, 0.1, 0.3], 0.15),
    "rounded cylinder": Cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 0.3], 0.1, 0.04),
}
EACH = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)


def points(shape, count=300, seed=0):
    return np.random.default_rng(seed).uniform(-0.6, 0.6, (count, shape.num_dims))


def expected_distance(shape, p):
    """Return the distance from a point to a shape without its margin [m], zero inside."""
    if isinstance(shape, Sphere):
        return max(np.linalg.norm(p - shape.center) - shape.radius, 0.0)
    if isinstance(shape, Box):
        return np.linalg.norm(np.maximum(np.maximum(shape.lower - p, p - shape.upper), 0.0))
    along = np.dot(p - shape.start, shape.axis)
    radial = np.linalg.norm(np.cross(p - shape.start, shape.axis))
    return np.hypot(max(radial - shape.radius, 0.0), max(-along, along - shape.length, 0.0))


@EACH
def test_distance_equals_the_distance_to_the_nearest_point(shape):
    for p in points(shape):
        expected = expected_distance(shape, p)
        if expected > 0.0:
            assert shape.distance(p) == pytest.approx(expected - shape.margin, abs=1e-12)
        else:
            assert shape.distance(p) <= -shape.margin


@EACH
def test_linearization_error_is_not_negative_inside_and_outside(shape):
    inside = 0
    for p in 0.4 * points(shape, 150):
        distance, normal = shape.surface(p)
        inside += distance < 0.0
        assert np.linalg.norm(normal) == pytest.approx(1.0, abs=1e-12)
        for y in points(shape, 30, 1):
            assert shape.distance(y) >= distance + normal @ (y - p) - 1e-12
    assert inside > 0


def test_linearization_error_of_a_sphere_is_bounded():
    sphere = SHAPES["sphere"]
    largest = 0.0
    for p, y in zip(points(sphere), points(sphere, seed=1), strict=True):
        error = sphere.distance(y) - sphere.distance(p) - sphere.surface(p)[1] @ (y - p)
        bound = (y - p) @ (y - p) / (2.0 * np.linalg.norm(p - sphere.center))
        assert error <= bound + 1e-12
        largest = max(largest, error / bound)
    assert largest > 0.5


@EACH
def test_half_space_separates_a_point_from_the_shape(shape):
    inside = [y for y in points(shape, 2000, 1) if shape.distance(y) <= 0.0]
    for p in points(shape, 100):
        n, c = shape.half_space(p)
        assert (n @ p >= c - 1e-12) == (shape.distance(p) >= -1e-12)
        assert max(n @ y - c for y in inside) <= 1e-12


@EACH
def test_separating_half_space_contains_a_line_outside(shape):
    num_lines, num_excluded = 0, 0
    for p, q in zip(points(shape, 400), points(shape, 400, 1), strict=True):
        if min(shape.distance(p + t * (q - p)) for t in np.linspace(0.0, 1.0, 21)) < 0.03:
            continue
        num_lines += 1
        n, c = shape.separate(p, q)
        assert min(n @ p, n @ q) >= c - 1e-12
        n_p, c_p = shape.half_space(p)
        n_q, c_q = shape.half_space(q)
        num_excluded += n_p @ q < c_p and n_q @ p < c_q
    assert num_lines > 20
    assert num_excluded > 0 or isinstance(shape, Box)


def test_normals_at_the_center_are_unit_vectors():
    assert Sphere([0.0, 0.0], 0.1).surface(np.zeros(2))[0] == -0.1
    cylinder = Cylinder([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], 0.1)
    distance, normal = cylinder.surface(np.zeros(3))
    assert distance == -0.1
    np.testing.assert_allclose([normal @ normal, normal[2]], [1.0, 0.0], atol=1e-15)


def path(steps=60):
    t = np.linspace(0.0, 1.0, steps)
    return np.column_stack([t, 0.3 * np.sin(3.0 * t)])


def test_lines_between_linearized_commands_are_outside():
    disc = Sphere([0.5, 0.35], 0.12)
    constraints = linearize([disc], path(), LinearConstraints.box([-1.0, -1.0], [2.0, 1.0]))
    assert constraints.num_steps == 60
    assert constraints.num_constraints == 6
    rng, previous, clearance = np.random.default_rng(0), None, np.inf
    for n in range(60):
        command = constraints.nearest(disc.center + 0.1 * rng.standard_normal(2), n)
        if previous is not None:
            for share in np.linspace(0.0, 1.0, 11):
                clearance = min(clearance, disc.distance(previous + share * (command - previous)))
        previous = command
    assert 0.5 * CLEARANCE < clearance < 100 * CLEARANCE


def test_linearize_returns_the_constraints_without_shapes():
    assert linearize([], path()).num_constraints == 0
    box = LinearConstraints.box([-1.0, -1.0], [2.0, 1.0])
    np.testing.assert_array_equal(linearize([], path(), box).c[7], box.c)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda: Sphere([0.0, np.nan], 0.1), "center"),
        (lambda: Sphere([0.0, 0.0], 0.0), "the radius of a sphere must be finite and positive, not 0.0"),
        (lambda: Sphere([0.0, 0.0], 0.1, -1e-3), "a margin must be finite and not negative, not -0.001"),
        (lambda: Sphere([0.0, 0.0], "a"), "the radius of a sphere must be a number, not 'a'"),
        (lambda: Sphere([0.0, 0.0], 0.1, [0.1]), "a margin must be a number"),
        (lambda: Box([0.0, 0.0], [1.0, 0.0]), "lower corner"),
        (lambda: Box([0.0], [1.0, 1.0]), "lower corner"),
        (lambda: Box([], []), "lower corner"),
        (lambda: Cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], 0.1), "different points"),
        (lambda: Cylinder([0.0, 0.0], [0.0, 1.0], 0.1), "different points"),
        (lambda: Cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], np.inf), "radius"),
        (lambda: linearize([Sphere([0.5, 0.0], 2.0)], path(), LinearConstraints.box([0.0, -0.1], [1.0, 0.4])), "contr"),
    ],
)
def test_shape_raises_when_an_argument_is_out_of_range(make, match):
    with pytest.raises(InputError, match=match):
        make()
