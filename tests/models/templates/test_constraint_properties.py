"""Active constraints of random sizes, compared with an independent formulation of their geometry."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, RotationMatrix
from guiderail.models.templates import active_constraints as ac
from guiderail.models.templates.parts import WORLD, angle_between, position_in

F = "object"
SEEDS = st.integers(0, 2**32 - 1)
TOLERANCE = 1e-11


def scene(seed, spread=0.3):
    """Return a random generator, X_WE, the pose of the object by its name, and the name of the object or the world."""
    rng = np.random.default_rng(seed)

    def pose():
        return RigidTransform(RotationMatrix(Rotation.random(rng=rng).as_matrix()), spread * rng.standard_normal(3))

    X_WE, X_WF = pose(), pose()
    frame = F if seed % 4 else WORLD
    return rng, X_WE, {F: X_WF}, frame


def project_position(constraint, X_WE, frames, frame):
    """Check the properties of every position constraint; return p_FE and its projection p_FP."""
    X_WP = constraint.project(X_WE, frames)
    assert angle_between(X_WP.rotation(), X_WE.rotation()) == 0.0
    p, q = position_in(frame, X_WE, frames), position_in(frame, X_WP, frames)
    assert constraint.violation(X_WE, frames) == pytest.approx(np.linalg.norm(q - p), abs=TOLERANCE)
    again = constraint.project(X_WP, frames)
    assert np.abs(again.translation() - X_WP.translation()).max() < TOLERANCE
    assert constraint.violation(X_WP, frames) < TOLERANCE
    if X_WP is X_WE:
        assert constraint.violation(X_WE, frames) == 0.0
    assert constraint.frame_names == (() if frame == WORLD else (F,))
    return p, q


@given(SEEDS)
def test_half_space_projects_along_its_normal(seed):
    rng, X_WE, frames, frame = scene(seed)
    normal, offset = rng.standard_normal(3), 0.1 * rng.standard_normal()
    p, q = project_position(ac.HalfSpace(tuple(normal), offset, frame), X_WE, frames, frame)
    n = normal / np.linalg.norm(normal)
    assert n @ q >= offset - TOLERANCE
    np.testing.assert_allclose(q, p + max(0.0, offset - n @ p) * n, atol=TOLERANCE)


@given(SEEDS)
def test_box_clips_each_coordinate(seed):
    rng, X_WE, frames, frame = scene(seed)
    lower = -0.3 * rng.uniform(size=3)
    upper = lower + rng.choice([0.0, 0.5], 3)
    p, q = project_position(ac.Box(tuple(lower), tuple(upper), frame), X_WE, frames, frame)
    np.testing.assert_allclose(q, [min(max(x, a), b) for x, a, b in zip(p, lower, upper, strict=True)], atol=TOLERANCE)


@given(SEEDS)
def test_cylinder_clips_the_radius(seed):
    rng, X_WE, frames, _ = scene(seed)
    lower = rng.choice([0.0, 0.1, 0.3])
    upper = lower + rng.choice([0.0, 0.2, 1000.0])
    if seed % 5 == 0:
        X_WE = RigidTransform(X_WE.rotation(), frames[F] @ np.array([0.0, 0.0, 0.2]))  # on the axis
    p, q = project_position(ac.Cylinder(F, lower, upper), X_WE, frames, F)
    radius, projected_radius = math.hypot(*p[:2]), math.hypot(*q[:2])
    assert projected_radius == pytest.approx(min(max(radius, lower), upper), abs=2e-12)
    assert lower - TOLERANCE <= projected_radius <= upper + TOLERANCE
    assert q[2] == pytest.approx(p[2], abs=TOLERANCE)
    if radius > 1e-6:
        assert (p[0] * q[1] - p[1] * q[0]) / radius == pytest.approx(0, abs=TOLERANCE)
        assert p[:2] @ q[:2] >= -TOLERANCE


def test_cylinder_projects_points_on_the_axis_along_minus_x():
    X_WP = ac.Cylinder(F, 0.1, 0.2).project(RigidTransform([0.0, 0.0, 0.5]), {F: RigidTransform()})
    np.testing.assert_allclose(X_WP.translation(), [-0.1, 0.0, 0.5], atol=1e-11)


@given(SEEDS)
def test_sector_rotates_to_the_nearer_limit(seed):
    rng, X_WE, frames, _ = scene(seed)
    lower = rng.uniform(-400, 300)
    upper = lower + rng.choice([0.0, 30.0, 200.0, 360.0])
    p, q = project_position(ac.Sector(F, lower, upper), X_WE, frames, F)
    assert math.hypot(*q[:2]) == pytest.approx(math.hypot(*p[:2]), abs=TOLERANCE)
    assert q[2] == pytest.approx(p[2], abs=TOLERANCE)
    before, after = (math.degrees(math.atan2(x[1], x[0])) for x in (p, q))
    excess = (after - lower) % 360
    assert excess <= upper - lower + 1e-6 or excess >= 360 - 1e-6
    if (before - lower) % 360 <= upper - lower:
        np.testing.assert_allclose(q, p, atol=TOLERANCE)
    else:
        distances = [abs((before - limit + 180) % 360 - 180) for limit in (lower, upper)]
        rotation = abs((after - before + 180) % 360 - 180)
        assert rotation == pytest.approx(min(distances), abs=1e-6)


@given(SEEDS)
def test_keep_above_lifts_the_lowest_point(seed):
    rng, X_WE, frames, frame = scene(seed)
    height = 0.1 * rng.standard_normal()
    points = rng.uniform(-0.2, 0.2, (rng.integers(1, 4), 3))
    constraint = ac.KeepAbove(height, frame, tuple(map(tuple, points)))
    X_WP = constraint.project(X_WE, frames)
    X_WF = frames[F] if frame == F else RigidTransform()
    before = min((X_WF.inverse() @ (X_WE @ point))[2] for point in points)
    after = min((X_WF.inverse() @ (X_WP @ point))[2] for point in points)
    assert after == pytest.approx(max(before, height), abs=TOLERANCE)
    lift = X_WF.rotation().inverse() @ (X_WP.translation() - X_WE.translation())
    np.testing.assert_allclose(lift, [0, 0, max(0.0, height - before)], atol=TOLERANCE)
    assert angle_between(X_WP.rotation(), X_WE.rotation()) == 0.0
    assert (X_WP is X_WE) == (height - before <= 0) or abs(height - before) < TOLERANCE
    X_WP = ac.KeepAbove(height, frame).project(X_WE, frames)  # without points, the origin of E
    before, after = ((X_WF.inverse() @ X.translation())[2] for X in (X_WE, X_WP))
    assert after == pytest.approx(max(before, height), abs=TOLERANCE)


@given(SEEDS)
def test_funnel_lowers_a_position_to_its_surface(seed):
    rng, X_WE, frames, _ = scene(seed)
    radius, height, slope = rng.uniform(0, 0.3), 0.1 * rng.standard_normal(), rng.choice([0.0, 0.9, 3.0])
    p, q = project_position(ac.Funnel(F, radius, height, slope), X_WE, frames, F)
    ceiling = height + slope * max(0.0, math.hypot(p[0], p[1]) - radius)
    np.testing.assert_allclose(q, [p[0], p[1], min(p[2], ceiling)], atol=TOLERANCE)


@given(SEEDS)
def test_fixed_orientation_changes_only_the_orientation(seed):
    rng, X_WE, frames, frame = scene(seed)
    rpy = tuple(rng.uniform(-180, 180, 3))
    X_WP = ac.FixedOrientation(rpy, frame).project(X_WE, frames)
    R_WF = frames[F].rotation().matrix() if frame == F else np.eye(3)
    expected = R_WF @ Rotation.from_euler("xyz", rpy, degrees=True).as_matrix()
    np.testing.assert_allclose(X_WP.rotation().matrix(), expected, atol=1e-12)
    np.testing.assert_array_equal(X_WP.translation(), X_WE.translation())


def tilt_axis(p_FE):
    """Return the horizontal axis of a tilt from p_FE towards the z axis of F."""
    towards = -p_FE[:2] / np.linalg.norm(p_FE[:2])
    return np.array([-towards[1], towards[0], 0.0])


def measure_tilt(R_FE, p_FE, R_FRest, turns_along):
    """Return the tilt towards the z axis of F, and the angle about other axes [rad], relative to R_FRest."""
    axis = tilt_axis(p_FE)
    if turns_along:
        R_FRest = Rotation.from_euler("z", math.atan2(-axis[0], axis[1])) * R_FRest
    rotation = (Rotation.from_matrix(R_FE) * R_FRest.inv()).as_rotvec()
    return rotation @ axis, np.linalg.norm(rotation - (rotation @ axis) * axis)


@given(SEEDS, st.booleans())
def test_tilt_limits_project_to_the_nearest_allowed_tilt(seed, turns_along):
    rng, X_WE, frames, frame = scene(seed)
    lower = rng.uniform(-180, 170)
    upper = rng.choice([lower, rng.uniform(lower, 180)])
    rpy = tuple(rng.uniform(-90, 90, 3))
    constraint = ac.TiltLimits(frame, lower, upper, rpy, turns_along)
    X_WP = constraint.project(X_WE, frames)
    np.testing.assert_array_equal(X_WP.translation(), X_WE.translation())
    X_WF = frames[F] if frame == F else RigidTransform()
    R_FP, R_FE = (X_WF.rotation().inverse() @ X.rotation() for X in (X_WP, X_WE))
    p_FE = X_WF.inverse() @ X_WE.translation()
    tilt, other_angle = measure_tilt(R_FP.matrix(), p_FE, Rotation.from_euler("xyz", rpy, degrees=True), turns_along)
    assert other_angle < 1e-6
    assert (math.degrees(tilt) - lower + 1e-6) % 360 <= upper - lower + 2e-6
    assert constraint.violation(X_WP, frames) < 1e-7
    # No allowed tilt is nearer to the requested one.
    axis = tilt_axis(p_FE)
    upright = Rotation.from_rotvec(-tilt * axis) * Rotation.from_matrix(R_FP.matrix())
    nearest = np.linalg.norm(R_FP.matrix() - R_FE.matrix())
    for angle in np.radians(np.linspace(lower, upper, 60)):
        R = (Rotation.from_rotvec(angle * axis) * upright).as_matrix()
        assert np.linalg.norm(R - R_FE.matrix()) > nearest - 1e-6


@given(SEEDS)
def test_tilt_by_distance_interpolates_the_tilt(seed):
    rng, X_WE, frames, frame = scene(seed)
    distances = np.sort(rng.uniform(0, 1, rng.integers(1, 5)))
    tilts = rng.uniform(-180, 180, len(distances))
    if len(distances) > 1 and np.diff(distances).min() < 1e-6:
        return
    constraint = ac.TiltByDistance(frame, tuple(distances), tuple(tilts))
    X_WP = constraint.project(X_WE, frames)
    X_WF = frames[F] if frame == F else RigidTransform()
    p_FE = X_WF.inverse() @ X_WE.translation()
    distance = np.linalg.norm(p_FE)
    expected = np.interp(distance, distances, tilts)
    R_FP = X_WF.rotation().inverse() @ X_WP.rotation()
    tilt, other_angle = measure_tilt(R_FP.matrix(), p_FE, Rotation.identity(), False)
    assert other_angle < 1e-6
    assert (math.degrees(tilt) - expected + 180) % 360 - 180 == pytest.approx(0, abs=1e-5)


class ShiftAndRotate(ac.ActiveConstraint):
    """Translates by 0.3 m along x and rotates by a given angle [rad] about x."""

    def __init__(self, angle):
        self.angle = angle

    def project(self, X_WE, frames):
        return RigidTransform(
            X_WE.rotation() @ RotationMatrix.MakeXRotation(self.angle), X_WE.translation() + [0.3, 0, 0]
        )


def test_violation_is_the_larger_of_meters_and_radians():
    X_WE = RigidTransform(RotationMatrix.MakeYRotation(0.7), [0.1, -0.2, 0.5])
    assert ShiftAndRotate(0.1).violation(X_WE, {}) == pytest.approx(0.3)
    assert ShiftAndRotate(0.5).violation(X_WE, {}) == pytest.approx(0.5)
    assert ShiftAndRotate(0.0).frame_names == ()


@pytest.mark.parametrize("center", [-20.0, 0.0, 3.0, 100.0])
def test_nearest_turn_is_within_half_a_turn_of_the_center(center):
    for angle in (-9.0, 0.0, 0.5, 7.0):
        equivalent = ac.nearest_turn(angle, center)
        assert abs(equivalent - center) <= math.pi + 1e-12
        assert (equivalent - angle) / math.tau == pytest.approx(round((equivalent - angle) / math.tau))


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
        (lambda: ac.TiltLimits(F, 10.0, -10.0), "angles"),
        (lambda: ac.TiltByDistance(F, (0.1, 0.1), (0.0, 1.0)), "increase"),
        (lambda: ac.TiltByDistance(F, (), ()), "increase"),
        (lambda: ac.TiltByDistance(F, (0.1,), (0.0, 1.0)), "increase"),
        (lambda: ac.TiltByDistance(F, (0.1,), (181.0,)), "between"),
        (lambda: ac.TiltByDistance(F, (0.1,), (-181.0,)), "between"),
        (lambda: ac.HalfSpace((0.0, 0.0, 1.0), math.nan), "offset_m must be finite, not nan"),
        (lambda: ac.HalfSpace((0.0, 0.0, 1.0), "a"), "offset_m must be finite, not 'a'"),
        (lambda: ac.KeepAbove(math.nan), "height_m must be finite"),
        (lambda: ac.KeepAbove(0.0, points_m=((0.0, math.nan, 0.0),)), "points_m must be finite"),
        (lambda: ac.Funnel(F, 0.1, math.nan, 1.0), "height_m must be finite"),
        (lambda: ac.Funnel(F, 0.1, 0.0, math.inf), "slope must be finite"),
        (lambda: ac.OutsideSphere(radius_m=0.0), "radius_m must be positive"),
        (lambda: ac.OutsideSphere(radius_m=0.1, center_m=(0.0, 0.0)), "center_m must be three"),
        (lambda: ac.OutsideCylinder(frame=F, radius_m=0.0, min_m=0.0, max_m=1.0), "radius_m must be positive"),
        (lambda: ac.OutsideCylinder(frame=F, radius_m=0.1, min_m=1.0, max_m=1.0), "min_m must be less"),
        (lambda: ac.OutsideCylinder(frame=F, radius_m=0.1, min_m=0.0, max_m=1.0, margin_m=-0.1), "margin_m must not"),
        (lambda: ac.OutsideBox(lower_m=(0.0, 0.0, 0.0), upper_m=(1.0, 0.0, 1.0)), "lower_m must be less"),
        (lambda: ac.OutsideBox(lower_m=(0.0, 0.0, 0.0), upper_m=(1.0, 1.0, 1.0), margin_m=-0.1), "margin_m must not"),
        (lambda: ac.InsideSphere(radius_m=-0.1), "radius_m must be positive"),
    ],
)
def test_constraint_refuses_invalid_arguments(make, message):
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
    assert ac.Cylinder(F).max_radius_m >= 1e3


@given(SEEDS)
def test_group_constraints_groups_neighbors_in_one_frame(seed):
    rng, X_WE, frames, frame = scene(seed)
    box = ac.Box((-0.1, -0.2, -0.3), (0.3, 0.2, 0.1), frame)
    constraints = [
        box,
        ac.Cylinder(frame, 0.05, 0.2),
        ac.TiltLimits(frame, -20.0, 30.0, turns_along=True),
        ShiftAndRotate(rng.uniform(0.0, 1.0)),
        ac.KeepAbove(0.02, WORLD, ((0.0, 0.0, -0.1), (0.0, 0.1, 0.0))),
    ]
    groups = ac.group_constraints(constraints)
    assert [len(group.constraints) if isinstance(group, ac.ConstraintGroup) else 0 for group in groups] == [3, 0, 1]
    X_WP = X_WQ = X_WE
    for constraint in constraints:
        X_WP = constraint.project(X_WP, frames)
    for group in groups:
        X_WQ = group.project(X_WQ, frames)
    np.testing.assert_allclose(X_WP.GetAsMatrix4(), X_WQ.GetAsMatrix4(), atol=1e-12)
    expected = max(constraint.violation(X_WE, frames) for constraint in constraints)
    assert max(group.violation(X_WE, frames) for group in groups) == pytest.approx(expected, abs=1e-12)
