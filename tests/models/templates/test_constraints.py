"""Projections of all active constraints: idempotence, independence of the world frame, refusals and NaN."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from guiderail.models.common.transforms import RigidTransform, RotationMatrix, pose_to_transform
from guiderail.models.templates import active_constraints as ac
from guiderail.models.templates.parts import angle_between, largest

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
    ac.OutsideSphere(frame=F, radius_m=0.4, center_m=(0.1, 0.0, -0.1)),
    ac.OutsideCylinder(frame=F, radius_m=0.3, min_m=-0.2, max_m=0.4, margin_m=0.01),
    ac.OutsideBox(frame=F, lower_m=(-0.3, -0.25, -0.4), upper_m=(0.3, 0.4, 0.2), margin_m=0.02),
    ac.InsideSphere(frame=F, radius_m=0.2, center_m=(0.1, 0.0, -0.1)),
]
IDS = [f"{type(c).__name__}_{i}" for i, c in enumerate(CONSTRAINTS)]


def random_pose(rng, spread=0.3):
    return RigidTransform(RotationMatrix(Rotation.random(rng=rng).as_matrix()), spread * rng.normal(size=3))


def scenes(seed=0, count=100):
    """Yield random poses of the end effector and of the object, by the object's name."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        yield random_pose(rng), {F: random_pose(rng)}


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_project_returns_a_pose_of_the_set(constraint):
    num_outside = 0
    for X_WE, frames in scenes():
        X_WP = constraint.project(X_WE, frames)
        assert constraint.violation(X_WP, frames) < 1e-12
        again = constraint.project(X_WP, frames)
        assert np.abs(again.GetAsMatrix34() - X_WP.GetAsMatrix34()).max() < 1e-12
        num_outside += constraint.violation(X_WE, frames) > 1e-3
    assert num_outside > 10  # otherwise the projection would not be tested


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_project_is_independent_of_the_world_frame(constraint):
    X_VW = random_pose(np.random.default_rng(1))
    for X_WE, frames in scenes(2, 20):
        X_VP = constraint.project(X_VW @ X_WE, {F: X_VW @ frames[F]})
        expected = X_VW @ constraint.project(X_WE, frames)
        np.testing.assert_allclose(X_VP.GetAsMatrix34(), expected.GetAsMatrix34(), atol=1e-12)


@pytest.mark.parametrize("constraint", [c for c in CONSTRAINTS if isinstance(c, ac.PositionConstraint | ac.KeepAbove)])
def test_position_constraint_does_not_change_the_orientation(constraint):
    for X_WE, frames in scenes(3, 20):
        R = constraint.project(X_WE, frames).rotation()
        assert angle_between(R, X_WE.rotation()) == 0.0


def test_turns_along_tilts_about_a_constant_axis_of_the_tool():
    constraint = ac.TiltByDistance(
        frame=F, distance_m=(1.0,), tilt_deg=(40.0,), rpy_deg=(0.0, 0.0, -90.0), turns_along=True
    )
    for angle in (0.0, 1.0, -2.5):
        p_FE = 0.2 * np.array([np.cos(angle), np.sin(angle), 0.0])
        R = constraint.project(RigidTransform(p_FE), {F: RigidTransform()}).rotation().matrix()
        # The tool's x axis is level and perpendicular to the bearing; its z axis is tilted along the bearing.
        assert R[2, 0] == pytest.approx(0.0, abs=1e-12)
        assert R[:, 0] @ p_FE == pytest.approx(0.0, abs=1e-12)
        assert R[:, 2] @ (-p_FE / 0.2) == pytest.approx(np.sin(np.deg2rad(40.0)))


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_violation_of_a_nan_pose_is_never_small(constraint):
    for missing in (np.s_[:], np.s_[:3]):
        pose = np.array([0.1, 0.0, 0.1, 0.3, 0.2, 0.1])
        pose[missing] = np.nan
        X_WE = pose_to_transform(pose)
        frames = {F: RigidTransform()}
        group = ac.ConstraintGroup((ac.FixedOrientation(frame=F), constraint, ac.Box((-1.0,) * 3, (1.0,) * 3, F)))
        assert not group.violation(X_WE, frames) <= 1e-9
        if missing != np.s_[:3] or not isinstance(constraint, ac.FixedOrientation):
            assert not constraint.violation(X_WE, frames) <= 1e-9


def test_half_space_of_a_shape_is_nan_when_the_last_pose_is_nan():
    X_WE, frames = RigidTransform([0.0, np.nan, 0.0]), {F: RigidTransform()}
    for outside in (ac.OutsideSphere(0.1), ac.OutsideCylinder(F, 0.1, 0.0, 1.0), ac.OutsideBox((0.0,) * 3, (1.0,) * 3)):
        assert np.isnan(outside.at(X_WE, frames).project(X_WE, frames).translation()).any()


def test_largest_is_nan_when_a_violation_is_nan():
    assert np.isnan(largest([0.1, np.nan, 0.2]))
    assert np.isnan(largest([np.nan, 0.2]))
    assert largest([]) == 0.0
    assert largest([0.1, 0.3, 0.2]) == 0.3


@pytest.mark.parametrize("constraint", CONSTRAINTS, ids=IDS)
def test_group_projects_like_its_constraints_in_order(constraint):
    box = ac.Box((-0.02,) * 3, (0.02,) * 3, F)
    for X_WE, frames in scenes(3, 5):
        X_WGroup = ac.ConstraintGroup((constraint, box, constraint)).project(X_WE, frames)
        X_WP = constraint.project(box.project(constraint.project(X_WE, frames), frames), frames)
        np.testing.assert_allclose(X_WGroup.GetAsMatrix34(), X_WP.GetAsMatrix34(), atol=1e-12)
