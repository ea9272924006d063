"""Active constraints with random sizes, compared with an independent formulation of their geometry."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates import constraints as ac
from guiderail.models.templates.geometry import WORLD, angle_between, position_in

F = "object"
SEEDS = st.integers(0, 2**32 - 1)
EXACT = 1e-11


def scene(seed, spread=0.3):
    """Return a random generator, X_WE, the pose of an object by name, and the name of the object or of the world."""
    rng = np.random.default_rng(seed)

    def pose():
        return RigidTransform(RotationMatrix(Rotation.random(rng=rng).as_matrix()), spread * rng.standard_normal(3))

    X_WE, X_WF = pose(), pose()
    frame = F if seed % 4 else WORLD
    return rng, X_WE, {F: X_WF}, frame


def projected(constraint, X_WE, frames, frame):
    """Return p_FE and its projection p_FP after checks of the properties of every position constraint."""
    X_WP = constraint.project(X_WE, frames)
    assert angle_between(X_WP.rotation(), X_WE.rotation()) == 0.0
    p, q = position_in(frame, X_WE, frames), position_in(frame, X_WP, frames)
    assert constraint.violation(X_WE, frames) == pytest.approx(np.linalg.norm(q - p), abs=EXACT)
    second = constraint.project(X_WP, frames)
    assert np.abs(second.translation() - X_WP.translation()).max() < EXACT
    assert constraint.violation(X_WP, frames) < EXACT
    if X_WP is X_WE:
        assert constraint.violation(X_WE, frames) == 0.0
    assert constraint.frame_names == (() if frame == WORLD else (F,))
    return p, q


@given(SEEDS)
def test_half_space(seed):
    rng, X_WE, frames, frame = scene(seed)
    normal, offset = rng.standard_normal(3), 0.1 * rng.standard_normal()
    p, q = projected(ac.HalfSpace(tuple(normal), offset, frame), X_WE, frames, frame)
    n = normal / np.linalg.norm(normal)
    assert n @ q >= offset - EXACT
    np.testing.assert_allclose(q, p + max(0.0, offset - n @ p) * n, atol=EXACT)


@given(SEEDS)
def test_box(seed):
    rng, X_WE, frames, frame = scene(seed)
    lower = -0.3 * rng.uniform(size=3)
    upper = lower + rng.choice([0.0, 0.5], 3)
    p, q = projected(ac.Box(tuple(lower), tuple(upper), frame), X_WE, frames, frame)
    np.testing.assert_allclose(q, [min(max(x, a), b) for x, a, b in zip(p, lower, upper, strict=True)], atol=EXACT)


@given(SEEDS)
def test_cylinder(seed):
    rng, X_WE, frames, _ = scene(seed)
    least = rng.choice([0.0, 0.1, 0.3])
    most = least + rng.choice([0.0, 0.2, 1000.0])
    if seed % 5 == 0:
        X_WE = RigidTransform(X_WE.rotation(), frames[F] @ np.array([0.0, 0.0, 0.2]))  # on the axis
    p, q = projected(ac.Cylinder(F, least, most), X_WE, frames, F)
    radius, kept = math.hypot(*p[:2]), math.hypot(*q[:2])
    assert kept == pytest.approx(min(max(radius, least), most), abs=2e-12)
    assert least - EXACT <= kept <= most + EXACT
    assert q[2] == pytest.approx(p[2], abs=EXACT)
    if radius > 1e-6:
        assert (p[0] * q[1] - p[1] * q[0]) / radius == pytest.approx(0, abs=EXACT)
        assert p[:2] @ q[:2] >= -EXACT


def test_cylinder_projects_its_axis_along_minus_x():
    X_WP = ac.Cylinder(F, 0.1, 0.2).project(RigidTransform([0.0, 0.0, 0.5]), {F: RigidTransform()})
    np.testing.assert_allclose(X_WP.translation(), [-0.1, 0.0, 0.5], atol=1e-11)


@given(SEEDS)
def test_sector(seed):
    rng, X_WE, frames, _ = scene(seed)
    least = rng.uniform(-400, 300)
    most = least + rng.choice([0.0, 30.0, 200.0, 360.0])
    p, q = projected(ac.Sector(F, least, most), X_WE, frames, F)
    assert math.hypot(*q[:2]) == pytest.approx(math.hypot(*p[:2]), abs=EXACT)
    assert q[2] == pytest.approx(p[2], abs=EXACT)
    before, after = (math.degrees(math.atan2(x[1], x[0])) for x in (p, q))
    inside = (before - least) % 360 <= most - least
    off = (after - least) % 360
    assert off <= most - least + 1e-6 or off >= 360 - 1e-6
    if inside:
        np.testing.assert_allclose(q, p, atol=EXACT)
    else:
        # To the nearer end: no way round the axis is shorter.
        ends = [abs((before - end + 180) % 360 - 180) for end in (least, most)]
        moved = abs((after - before + 180) % 360 - 180)
        assert moved == pytest.approx(min(ends), abs=1e-6)


@given(SEEDS)
def test_keep_above(seed):
    rng, X_WE, frames, frame = scene(seed)
    height = 0.1 * rng.standard_normal()
    points = rng.uniform(-0.2, 0.2, (rng.integers(1, 4), 3))
    constraint = ac.KeepAbove(height, frame, tuple(map(tuple, points)))
    X_WP = constraint.project(X_WE, frames)
    X_WF = frames[F] if frame == F else RigidTransform()
    before = min((X_WF.inverse() @ (X_WE @ point))[2] for point in points)
    after = min((X_WF.inverse() @ (X_WP @ point))[2] for point in points)
    assert after == pytest.approx(max(before, height), abs=EXACT)
    lift = X_WF.rotation().inverse() @ (X_WP.translation() - X_WE.translation())
    np.testing.assert_allclose(lift, [0, 0, max(0.0, height - before)], atol=EXACT)
    assert angle_between(X_WP.rotation(), X_WE.rotation()) == 0.0
    assert (X_WP is X_WE) == (height - before <= 0) or abs(height - before) < EXACT
    own = ac.KeepAbove(height, frame).project(X_WE, frames)
    lowest = (X_WF.inverse() @ own.translation())[2]
    assert lowest == pytest.approx(max((X_WF.inverse() @ X_WE.translation())[2], height), abs=EXACT)


@given(SEEDS)
def test_funnel(seed):
    rng, X_WE, frames, _ = scene(seed)
    radius, height, slope = rng.uniform(0, 0.3), 0.1 * rng.standard_normal(), rng.choice([0.0, 0.9, 3.0])
    p, q = projected(ac.Funnel(F, radius, height, slope), X_WE, frames, F)
    ceiling = height + slope * max(0.0, math.hypot(p[0], p[1]) - radius)
    np.testing.assert_allclose(q, [p[0], p[1], min(p[2], ceiling)], atol=EXACT)


@given(SEEDS)
def test_fixed_orientation(seed):
    rng, X_WE, frames, frame = scene(seed)
    rpy = tuple(rng.uniform(-180, 180, 3))
    X_WP = ac.FixedOrientation(rpy, frame).project(X_WE, frames)
    R_WF = frames[F].rotation().matrix() if frame == F else np.eye(3)
    expected = R_WF @ Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
    np.testing.assert_allclose(X_WP.rotation().matrix(), expected, atol=1e-12)
    np.testing.assert_array_equal(X_WP.translation(), X_WE.translation())


def leaning(R_FE, p_FE, rest, turns_along):
    """Return the tilt towards F's axis, and the angle about other axes [rad], of an orientation relative to `rest`."""
    towards = -p_FE[:2] / np.linalg.norm(p_FE[:2])
    if turns_along:
        rest = Rotation.from_euler("z", math.atan2(towards[1], towards[0])) * rest
    lean = (Rotation.from_matrix(R_FE) * rest.inv()).as_rotvec()
    axis = np.array([-towards[1], towards[0], 0.0])
    return lean @ axis, np.linalg.norm(lean - (lean @ axis) * axis)


@given(SEEDS, st.booleans())
def test_tilt_limits(seed, turns_along):
    rng, X_WE, frames, frame = scene(seed)
    least = rng.uniform(-180, 170)
    most = rng.choice([least, rng.uniform(least, 180)])
    rpy = tuple(rng.uniform(-90, 90, 3))
    constraint = ac.TiltLimits(frame, least, most, rpy, turns_along)
    X_WP = constraint.project(X_WE, frames)
    np.testing.assert_array_equal(X_WP.translation(), X_WE.translation())
    X_WF = frames[F] if frame == F else RigidTransform()
    R_FP, R_FE = (X_WF.rotation().inverse() @ X.rotation() for X in (X_WP, X_WE))
    p_FE = X_WF.inverse() @ X_WE.translation()
    tilt, rest_of_it = leaning(R_FP.matrix(), p_FE, Rotation.from_euler("xyz", rpy, degrees=True), turns_along)
    assert rest_of_it < 1e-6
    off = (math.degrees(tilt) - least + 1e-6) % 360
    assert off <= most - least + 2e-6
    assert constraint.violation(X_WP, frames) < 1e-7
    # No allowed tilt is nearer to the requested one.
    towards = -p_FE[:2] / np.linalg.norm(p_FE[:2])
    axis = np.array([-towards[1], towards[0], 0.0])
    base = Rotation.from_rotvec(-tilt * axis) * Rotation.from_matrix(R_FP.matrix())
    expected = np.linalg.norm(R_FP.matrix() - R_FE.matrix())
    for other in np.radians(np.linspace(least, most, 60)):
        assert np.linalg.norm((Rotation.from_rotvec(other * axis) * base).as_matrix() - R_FE.matrix()) > expected - 1e-6


@given(SEEDS)
def test_tilt_by_distance(seed):
    rng, X_WE, frames, frame = scene(seed)
    distances = np.sort(rng.uniform(0, 1, rng.integers(1, 5)))
    tilts = rng.uniform(-180, 180, len(distances))
    if len(distances) > 1 and np.diff(distances).min() < 1e-6:
        return
    constraint = ac.TiltByDistance(frame, tuple(distances), tuple(tilts))
    X_WP = constraint.project(X_WE, frames)
    X_WF = frames[F] if frame == F else RigidTransform()
    p_FE = X_WF.inverse() @ X_WE.translation()
    far = np.linalg.norm(p_FE)
    expected = np.interp(far, distances, tilts)
    tilt, rest_of_it = leaning((X_WF.rotation().inverse() @ X_WP.rotation()).matrix(), p_FE, Rotation.identity(), False)
    assert rest_of_it < 1e-6
    assert (math.degrees(tilt) - expected + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)


@given(SEEDS)
def test_arc(seed):
    rng, X_WE, frames, frame = scene(seed)
    least = rng.uniform(-180, 170)
    most = rng.choice([least, rng.uniform(least, 180)])
    radius, height, rpy = rng.uniform(0.1, 1), rng.standard_normal(), tuple(rng.uniform(-90, 90, 3))
    constraint = ac.Arc(frame, radius, height, least, most, rpy)
    X_WF = frames[F] if frame == F else RigidTransform()
    X_FP = X_WF.inverse() @ constraint.project(X_WE, frames)
    q, p = X_FP.translation(), X_WF.inverse() @ X_WE.translation()
    assert math.hypot(q[0], q[1]) == pytest.approx(radius)
    assert q[2] == pytest.approx(height)
    angle = math.degrees(math.atan2(q[1], q[0]))
    assert (angle - least + 1e-6) % 360 <= most - least + 2e-6
    asked = math.degrees(math.atan2(p[1], p[0]))
    if (asked - least) % 360 <= most - least:
        assert (angle - asked + 180) % 360 - 180 == pytest.approx(0, abs=1e-6)
    else:
        ends = [abs((asked - end + 180) % 360 - 180) for end in (least, most)]
        assert abs((angle - asked + 180) % 360 - 180) == pytest.approx(min(ends), abs=1e-6)
    expected = Rotation.from_euler("z", angle, degrees=True) * Rotation.from_euler("xyz", rpy, degrees=True)
    np.testing.assert_allclose(X_FP.rotation().matrix(), expected.as_matrix(), atol=1e-9)


class Tilted(ac.ActiveConstraint):
    """Translates by 0.3 m and rotates by a given angle."""

    def __init__(self, angle):
        self.angle = angle

    def project(self, X_WE, frames):
        return RigidTransform(
            X_WE.rotation() @ RotationMatrix.MakeXRotation(self.angle), X_WE.translation() + [0.3, 0, 0]
        )


def test_violation_is_the_larger_of_meters_and_radians():
    X_WE = RigidTransform(RotationMatrix.MakeYRotation(0.7), [0.1, -0.2, 0.5])
    assert Tilted(0.1).violation(X_WE, {}) == pytest.approx(0.3)
    assert Tilted(0.5).violation(X_WE, {}) == pytest.approx(0.5)
    assert Tilted(0.0).frame_names == ()


@pytest.mark.parametrize("center", [-20.0, 0.0, 3.0, 100.0])
def test_nearest_turn_is_within_half_a_turn(center):
    for angle in (-9.0, 0.0, 0.5, 7.0):
        turned = ac.nearest_turn(angle, center)
        assert abs(turned - center) <= math.pi + 1e-12
        assert (turned - angle) / math.tau == pytest.approx(round((turned - angle) / math.tau))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ac.HalfSpace((0.0, 0.0, 1e-7), 0.0), "zero"),
        (lambda: ac.Box((0.0, 0.0, 0.0), (1.0, 1.0, -1e-9)), "exceed"),
        (lambda: ac.Cylinder(F, -0.1, 0.1), "radii"),
        (lambda: ac.Cylinder(F, 0.2, 0.1), "radii"),
        (lambda: ac.Sector(F, 10.0, 9.0), "360"),
        (lambda: ac.Sector(F, 0.0, 361.0), "360"),
        (lambda: ac.KeepAbove(0.0, points_m=()), "points_m"),
        (lambda: ac.KeepAbove(0.0, points_m=((0.0, 0.0),)), "points_m"),
        (lambda: ac.Funnel(F, -0.1, 0.0, 1.0), "negative"),
        (lambda: ac.Funnel(F, 0.1, 0.0, -1.0), "negative"),
        (lambda: ac.TiltLimits(F, -181.0, 0.0), "angles"),
        (lambda: ac.TiltLimits(F, 0.0, 181.0), "angles"),
        (lambda: ac.TiltByDistance(F, (0.1, 0.1), (0.0, 1.0)), "increase"),
        (lambda: ac.TiltByDistance(F, (), ()), "increase"),
        (lambda: ac.TiltByDistance(F, (0.1,), (0.0, 1.0)), "increase"),
        (lambda: ac.TiltByDistance(F, (0.1,), (181.0,)), "between"),
        (lambda: ac.TiltByDistance(F, (0.1,), (-181.0,)), "between"),
        (lambda: ac.Arc(F, 0.0), "positive"),
        (lambda: ac.Arc(F, 1.0, min_deg=-181.0), "angles"),
        (lambda: ac.Arc(F, 1.0, min_deg=10.0, max_deg=9.0), "angles"),
        (lambda: ac.Arc(F, 1.0, max_deg=181.0), "angles"),
        (lambda: ac.Arc(F, 1.0, math.nan), "height_m must be finite, not nan"),
        (lambda: ac.Arc(F, math.inf), "radius_m must be finite"),
        (lambda: ac.HalfSpace((0.0, 0.0, 1.0), math.nan), "offset_m must be finite, not nan"),
        (lambda: ac.HalfSpace((0.0, 0.0, 1.0), "a"), "offset_m must be finite, not 'a'"),
        (lambda: ac.KeepAbove(math.nan), "height_m must be finite"),
        (lambda: ac.KeepAbove(0.0, points_m=((0.0, math.nan, 0.0),)), "points_m must be finite"),
        (lambda: ac.Funnel(F, 0.1, math.nan, 1.0), "height_m must be finite"),
        (lambda: ac.Funnel(F, 0.1, 0.0, math.inf), "slope must be finite"),
    ],
)
def test_constraint_refuses_an_empty_set(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_constraint_accepts_limits_at_their_bounds():
    ac.Box((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    ac.Cylinder(F, 0.1, 0.1)
    ac.Cylinder(F)
    ac.Sector(F, 10.0, 370.0)
    ac.Sector(F, 10.0, 10.0)
    ac.Funnel(F, 0.0, 0.0, 0.0)
    ac.TiltLimits(F, -180.0, 180.0)
    ac.TiltByDistance(F, (0.1,), (180.0,))
    ac.TiltByDistance(F, (0.1,), (-180.0,))
    ac.Arc(F, 0.1, min_deg=-180.0, max_deg=180.0)
    assert ac.Arc(F, 0.1).min_deg == -180.0
    assert ac.Cylinder(F).max_radius_m >= 1e3


@given(SEEDS)
def test_constraint_group_equals_its_constraints_one_by_one(seed):
    rng, X_WE, frames, frame = scene(seed)
    box = ac.Box((-0.1, -0.2, -0.3), (0.3, 0.2, 0.1), frame)
    constraints = [
        box,
        ac.Cylinder(frame, 0.05, 0.2),
        ac.TiltLimits(frame, -20.0, 30.0, turns_along=True),
        Tilted(rng.uniform(0.0, 1.0)),
        ac.KeepAbove(0.02, WORLD, ((0.0, 0.0, -0.1), (0.0, 0.1, 0.0))),
    ]
    together = ac.group_constraints(constraints)
    assert [len(g.constraints) if isinstance(g, ac.ConstraintGroup) else 0 for g in together] == [3, 0, 1]
    X_WP = X_WQ = X_WE
    for constraint in constraints:
        X_WP = constraint.project(X_WP, frames)
    for group in together:
        X_WQ = group.project(X_WQ, frames)
    np.testing.assert_allclose(X_WP.GetAsMatrix4(), X_WQ.GetAsMatrix4(), atol=1e-12)
    worst = max(constraint.violation(X_WE, frames) for constraint in constraints)
    assert max(group.violation(X_WE, frames) for group in together) == pytest.approx(worst, abs=1e-12)
