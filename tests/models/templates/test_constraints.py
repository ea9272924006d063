"""Every active constraint is a projection and leaves other coordinates unchanged."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform, RotationMatrix, pose_to_transform
from guiderail.models.templates import constraints as ac
from guiderail.models.templates import shape_constraints as sc
from guiderail.models.templates.geometry import angle_between, largest, position_in

F = "object"
CONSTRAINTS = [
    ac.HalfSpace(normal=(0.0, 1.0, 2.0), offset_m=0.1, frame=F),
    ac.Box(lower_m=(-0.1, -0.2, 0.0), upper_m=(0.1, 0.3, 0.2), frame=F),
    ac.Cylinder(frame=F, min_radius_m=0.05, max_radius_m=0.2),
    ac.Sector(frame=F, min_deg=-150.0, max_deg=-60.0),
    ac.KeepAbove(height_m=0.05, frame=F),
    ac.KeepAbove(height_m=0.05, frame=F, points_m=((0.03, 0.0, 0.0), (-0.03, 0.0, -0.12))),
    ac.Funnel(frame=F, radius_m=0.05, height_m=0.06, slope=0.9),
    ac.FixedOrientation(rpy_deg=(10.0, -20.0, 30.0), frame=F),
    ac.TiltLimits(frame=F, min_deg=60.0, max_deg=122.0),
    ac.TiltByDistance(frame=F, distance_m=(0.07, 0.25), tilt_deg=(65.0, 0.0), rpy_deg=(0.0, 0.0, 15.0)),
    ac.TiltLimits(frame=F, min_deg=0.0, max_deg=90.0, rpy_deg=(5.0, 0.0, -90.0), turns_along=True),
    sc.OutsideSphere(frame=F, radius_m=0.4, center_m=(0.1, 0.0, -0.1)),
    sc.OutsideCylinder(frame=F, radius_m=0.3, min_m=-0.2, max_m=0.4, margin_m=0.01),
    sc.OutsideBox(frame=F, lower_m=(-0.3, -0.25, -0.4), upper_m=(0.3, 0.4, 0.2), margin_m=0.02),
    sc.InsideSphere(frame=F, radius_m=0.2, center_m=(0.1, 0.0, -0.1)),
    ac.Arc(frame=F, radius_m=0.3, height_m=0.1, min_deg=0.0, max_deg=80.0, rpy_deg=(90.0, 0.0, 0.0)),
]
IDS = [f"{type(c).__name__}_{i}" for i, c in enumerate(CONSTRAINTS)]


def random_pose(rng, spread=0.3):
    return RigidTransform(RotationMatrix(Rotation.random(rng=rng).as_matrix()), spread * rng.normal(size=3))


def scenes(seed=0, count=100):
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield random_pose(rng), {F: random_pose(rng)}


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_constraint_projects_into_its_set(constraint):
    moved = 0
    for X_WE, frames in scenes():
        X_WP = constraint.project(X_WE, frames)
        assert constraint.violation(X_WP, frames) < 1e-12
        second = constraint.project(X_WP, frames)
        assert np.abs(second.GetAsMatrix34() - X_WP.GetAsMatrix34()).max() < 1e-12
        moved += constraint.violation(X_WE, frames) > 1e-3
    assert moved > 10  # or the test would show nothing


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_constraint_is_independent_of_the_world_frame(constraint):
    X_VW = random_pose(np.random.default_rng(1))
    for X_WE, frames in scenes(2, 20):
        X_VP = constraint.project(X_VW @ X_WE, {F: X_VW @ frames[F]})
        expected = X_VW @ constraint.project(X_WE, frames)
        np.testing.assert_allclose(X_VP.GetAsMatrix34(), expected.GetAsMatrix34(), atol=1e-12)


@pytest.mark.parametrize("constraint", [c for c in CONSTRAINTS if isinstance(c, ac.PositionConstraint | ac.KeepAbove)])
def test_position_constraint_keeps_the_orientation(constraint):
    for X_WE, frames in scenes(3, 20):
        R = constraint.project(X_WE, frames).rotation()
        assert angle_between(R, X_WE.rotation()) == 0.0


def test_half_space_projects_to_the_nearest_point():
    constraint = CONSTRAINTS[0]
    for X_WE, frames in scenes(4, 20):
        p, q = (position_in(F, X, frames) for X in (X_WE, constraint.project(X_WE, frames)))
        normal = np.array([0.0, 1.0, 2.0]) / np.sqrt(5.0)
        short = max(0.0, 0.1 - normal @ p)
        np.testing.assert_allclose(q, p + short * normal, atol=1e-12)


def test_tilt_by_distance_tilts_towards_the_object():
    constraint = ac.TiltByDistance(frame=F, distance_m=(0.0, 1.0), tilt_deg=(90.0, 0.0))
    frames = {F: RigidTransform([0.2, 0.0, 0.0])}
    R = constraint.project(RigidTransform([-0.3, 0.0, 0.0]), frames).rotation().matrix()
    # Half way, so 45 degrees; the object is in +x, so the tool's z axis leans to +x and nothing else turns.
    np.testing.assert_allclose(R[:, 2], [np.sqrt(0.5), 0.0, np.sqrt(0.5)], atol=1e-12)
    np.testing.assert_allclose(R[:, 1], [0.0, 1.0, 0.0], atol=1e-12)


def test_tilt_limits_keep_an_allowed_tilt():
    constraint = ac.TiltLimits(frame=F, min_deg=20.0, max_deg=50.0)
    frames = {F: RigidTransform([0.0, 1.0, 0.0])}
    X_WE = RigidTransform(RotationMatrix.MakeXRotation(-np.deg2rad(35.0)), np.zeros(3))
    assert constraint.violation(X_WE, frames) < 1e-12
    X_WP = constraint.project(RigidTransform(), frames)
    assert angle_between(X_WP.rotation(), RotationMatrix.MakeXRotation(-np.deg2rad(20.0))) < 1e-12


def test_turns_along_tilts_about_a_constant_axis_of_the_tool():
    constraint = ac.TiltByDistance(
        frame=F, distance_m=(1.0,), tilt_deg=(40.0,), rpy_deg=(0.0, 0.0, -90.0), turns_along=True
    )
    for angle in (0.0, 1.0, -2.5):
        p_FE = 0.2 * np.array([np.cos(angle), np.sin(angle), 0.0])
        R = constraint.project(RigidTransform(p_FE), {F: RigidTransform()}).rotation().matrix()
        # The tool's x axis stays level and across the bearing; its z axis tilts along the bearing.
        assert R[2, 0] == pytest.approx(0.0, abs=1e-12)
        assert R[:, 0] @ p_FE == pytest.approx(0.0, abs=1e-12)
        assert R[:, 2] @ (-p_FE / 0.2) == pytest.approx(np.sin(np.deg2rad(40.0)))


def test_arc_turns_the_end_effector():
    constraint = ac.Arc(frame=F, radius_m=0.3)
    frames = {F: RigidTransform()}
    X_WP = constraint.project(RigidTransform([0.0, 0.5, 0.2]), frames)
    np.testing.assert_allclose(X_WP.translation(), [0.0, 0.3, 0.0], atol=1e-12)
    np.testing.assert_allclose(X_WP.rotation().matrix()[:, 0], [0.0, 1.0, 0.0], atol=1e-12)


def test_keep_above_lifts_the_lowest_point():
    constraint = ac.KeepAbove(height_m=0.0, points_m=((0.0, 0.0, -0.1), (0.0, 0.0, 0.1)))
    upside_down = RotationMatrix.MakeXRotation(np.pi)
    X_WP = constraint.project(RigidTransform(upside_down, [0.0, 0.0, 0.03]), {})
    assert X_WP.translation()[2] == pytest.approx(0.1)


@pytest.mark.parametrize(
    "make",
    [
        lambda: ac.Box(lower_m=(0.0, 0.0, 1.0), upper_m=(1.0, 1.0, 0.0)),
        lambda: ac.Cylinder(frame=F, min_radius_m=0.2, max_radius_m=0.1),
        lambda: ac.HalfSpace(normal=(0.0, 0.0, 0.0), offset_m=0.0),
        lambda: ac.TiltByDistance(frame=F, distance_m=(0.2, 0.1), tilt_deg=(0.0, 1.0)),
        lambda: ac.TiltLimits(frame=F, min_deg=10.0, max_deg=-10.0),
        lambda: ac.Arc(frame=F, radius_m=0.0),
        lambda: sc.OutsideSphere(radius_m=0.0),
        lambda: sc.OutsideSphere(radius_m=0.1, center_m=(0.0, 0.0)),
        lambda: sc.OutsideCylinder(frame=F, radius_m=0.0, min_m=0.0, max_m=1.0),
        lambda: sc.OutsideCylinder(frame=F, radius_m=0.1, min_m=1.0, max_m=1.0),
        lambda: sc.OutsideCylinder(frame=F, radius_m=0.1, min_m=0.0, max_m=1.0, margin_m=-0.1),
        lambda: sc.OutsideBox(lower_m=(0.0, 0.0, 0.0), upper_m=(1.0, 0.0, 1.0)),
        lambda: sc.OutsideBox(lower_m=(0.0, 0.0, 0.0), upper_m=(1.0, 1.0, 1.0), margin_m=-0.1),
        lambda: sc.InsideSphere(radius_m=-0.1),
    ],
)
def test_constraint_refuses_an_empty_set(make):
    with pytest.raises(InputError):
        make()


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_nan_pose_is_never_inside(constraint):
    for lost in (np.s_[:], np.s_[:3]):
        pose = np.array([0.1, 0.0, 0.1, 0.3, 0.2, 0.1])
        pose[lost] = np.nan
        X_WE = pose_to_transform(pose)
        frames = {F: RigidTransform()}
        group = ac.ConstraintGroup((ac.FixedOrientation(frame=F), constraint, ac.Box((-1.0,) * 3, (1.0,) * 3, F)))
        assert not group.violation(X_WE, frames) <= 1e-9
        if lost != np.s_[:3] or not isinstance(constraint, ac.FixedOrientation):
            assert not constraint.violation(X_WE, frames) <= 1e-9


def test_half_space_at_a_shape_of_unknown_pose_is_not_finite():
    lost = RigidTransform([0.0, np.nan, 0.0])
    for outside in (sc.OutsideSphere(0.1), sc.OutsideCylinder(F, 0.1, 0.0, 1.0), sc.OutsideBox((0.0,) * 3, (1.0,) * 3)):
        assert np.isnan(
            outside.at(lost, {F: RigidTransform()}).project(lost, {F: RigidTransform()}).translation()
        ).any()


def test_largest_is_nan_when_a_violation_is_nan():
    assert np.isnan(largest([0.1, np.nan, 0.2]))
    assert np.isnan(largest([np.nan, 0.2]))
    assert largest([]) == 0.0
    assert largest([0.1, 0.3, 0.2]) == 0.3


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_group_may_follow_other_constraints(constraint):
    box = ac.Box((-0.02,) * 3, (0.02,) * 3, F)
    for X_WE, frames in scenes(3, 5):
        together = ac.ConstraintGroup((constraint, box, constraint)).project(X_WE, frames)
        X_WP = constraint.project(box.project(constraint.project(X_WE, frames), frames), frames)
        np.testing.assert_allclose(together.GetAsMatrix34(), X_WP.GetAsMatrix34(), atol=1e-12)
