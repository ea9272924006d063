"""Joint range: joint positions of a commanded pose, and linearized limits."""

import numpy as np
import pytest
from pydrake.multibody.tree import JacobianWrtVariable

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.primitives import LinearConstraints
from guiderail.models.robots.joint_range import JointRange
from guiderail.systems.support.drake_multibody import pose_to_transform

POSE = np.array([0.02, 0.03, 0.1, 0.7, 0.1, -0.2])
MARGIN = 0.1  # [rad]


@pytest.fixture(scope="module")
def model():
    return ArmControllerPlant(BncWorkcell())


def make_joint_range(model, **arguments):
    return JointRange(model.plant, model.target, model.tool_center, model.posture, **arguments)


def test_solve_returns_the_solution_nearest_to_the_posture(model):
    joints = make_joint_range(model)
    q = joints.solve(POSE)
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    X = model.tool_center.CalcPose(context, model.target)
    np.testing.assert_allclose(X.GetAsMatrix4(), pose_to_transform(POSE).GetAsMatrix4(), atol=1e-8)
    expected = model.solve(POSE, model.posture)  # by another solver
    np.testing.assert_allclose(q, expected, atol=1e-3)
    assert joints.solve(POSE + [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]) is None
    assert joints.violation(POSE + [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]) == np.inf
    with pytest.raises(ValueError, match="read-only"):
        q[0] = 0.0


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_solve_returns_none_for_a_pose_that_is_not_finite(model, value):
    joints, pose = make_joint_range(model), np.r_[value, POSE[1:]]
    assert joints.solve(pose) is None
    assert joints.violation(pose) == np.inf


def test_linearized_limits_are_accurate_to_second_order(model):
    joints = make_joint_range(model, margin=MARGIN)
    G, c = joints.linearize(POSE)
    lower = model.plant.GetPositionLowerLimits() + MARGIN - joints.solve(POSE)
    assert len(G) == 14
    errors = []
    for size in (1e-2, 1e-3):
        change = size * np.array([1.0, -0.5, 0.5, 1.0, -1.0, 1.0])
        difference = joints.solve(POSE + change) - joints.solve(POSE)
        scale = lower / (c - G @ POSE)[:7]  # scale of each row [rad]
        predicted = scale * (G @ change)[:7]
        errors.append(np.linalg.norm(tool_motion_part(model, joints.solve(POSE), difference - predicted)))
        np.testing.assert_allclose((G @ change)[7:], -(G @ change)[:7], atol=1e-12)
    assert errors[0] < 5e-3
    assert errors[1] < 0.02 * errors[0]


def tool_motion_part(model, q, change):
    """Return the part of a change (n,) of the joint positions that moves the tool, without null-space motion."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, q)
    J = model.plant.CalcJacobianSpatialVelocity(
        context, JacobianWrtVariable.kV, model.tool_center, np.zeros(3), model.target, model.target
    )
    return np.linalg.pinv(J) @ J @ change


def test_commands_do_not_move_a_joint_beyond_its_limits(model):
    joints = make_joint_range(model, margin=MARGIN)
    motion = MotionConstraints(LinearConstraints.none(6), max_speed=[2.0, 2.0, 2.0, 6.0, 6.0, 6.0], state=[joints])
    motion_filter, desired = MotionConstraintFilter(motion, 0.02), POSE + [-0.45, 0.0, -0.3, 0.0, 0.0, 0.0]
    assert joints.violation(desired) > 0.0
    state, violations = motion_filter.start(POSE), []
    for _ in range(15):
        state, _ = motion_filter.apply(state, desired)
        violations.append(joints.violation(state[:6]))
    assert max(violations) <= 0.0
    assert max(violations) > -0.02  # [rad], a limit is reached
    unlimited = MotionConstraintFilter(MotionConstraints(LinearConstraints.none(6), max_speed=motion.max_speed), 0.02)
    state = unlimited.start(POSE)
    for _ in range(15):
        state, _ = unlimited.apply(state, desired)
    assert joints.violation(state[:6]) > 0.0


def test_posture_must_be_within_the_margin(model):
    with pytest.raises(InputError, match="posture is not within the joint limits"):
        make_joint_range(model, margin=3.0)


def test_joint_margin_requires_an_arm():
    with pytest.raises(InputError, match="station=arm"):
        make_prior_knowledge("BncConnector", guidance="kgrl", joint_margin=0.1)
    config = make_prior_knowledge("BncConnector", guidance="kgrl", station="arm", joint_margin=0.1).primitive
    assert config.motion.violation(config.reference.means[0]) < 0.0
