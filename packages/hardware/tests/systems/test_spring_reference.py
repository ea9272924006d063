"""Reference of a robot's own spring and damper: its law exerts the wrench, and the reference is the desired pose."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.stations.arm import ArmControllerPlant
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.systems.support.drake_multibody import pose_to_transform, transform_to_pose
from guiderail_hardware.station import make_robot_impedance, tool_jacobian
from guiderail_hardware.systems.spring_reference import SpringReference

SPEED = 0.3  # joint speeds [rad/s]


@pytest.fixture(scope="module")
def model():
    return ArmControllerPlant(BncWorkcell(), "panda")


@pytest.fixture(scope="module")
def robot(model):
    return make_robot_impedance(model, Impedance().with_max_force(15.0))


def measured(model, positions):
    """Return the pose X_TP of the tool center at joint positions (n,)."""
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, positions)
    return model.tool_center.CalcPose(context, model.target)


def reference(model, robot, positions, velocities, wrench):
    """Return the reference X_TPr at a joint state for a wrench (6,)."""
    system = SpringReference(model, robot)
    context = system.CreateDefaultContext()
    system.get_estimated_state_input_port().FixValue(context, np.concatenate([positions, velocities]))
    system.get_impedance_wrench_input_port().FixValue(context, wrench)
    return pose_to_transform(system.get_reference_pose_output_port().Eval(context))


def deflection(X, X_reference):
    """Return the translation and the rotation vector, in the axes of T, from a pose to the reference, (6,)."""
    turn = (X_reference.rotation() @ X.rotation().inverse()).ToAngleAxis()
    return np.concatenate([X_reference.translation() - X.translation(), turn.angle() * turn.axis()])


@pytest.mark.parametrize("seed", range(5))
def test_law_of_the_robot_exerts_the_wrench(model, robot, seed):
    rng = np.random.default_rng(seed)
    positions = model.posture + rng.uniform(-0.3, 0.3, 7)
    velocities, wrench = rng.uniform(-SPEED, SPEED, 7), rng.uniform(-robot.max_wrench, robot.max_wrench)
    X_reference = reference(model, robot, positions, velocities, wrench)
    V = (tool_jacobian(model, positions, model.target) @ velocities)[[3, 4, 5, 0, 1, 2]]
    spring = robot.stiffness @ deflection(measured(model, positions), X_reference)
    np.testing.assert_allclose(spring - robot.damping @ V, wrench, atol=1e-9)


def test_reference_is_the_desired_pose_while_no_limit_is_active(model, robot):
    velocities = np.random.default_rng(0).uniform(-SPEED, SPEED, 7)
    X = measured(model, model.posture)
    X_desired = RigidTransform([0.002, -0.001, 0.003]) @ X
    V = (tool_jacobian(model, model.posture, model.target) @ velocities)[[3, 4, 5, 0, 1, 2]]
    wrench = robot.stiffness @ deflection(X, X_desired) - robot.damping @ V
    found = reference(model, robot, model.posture, velocities, wrench)
    np.testing.assert_allclose(transform_to_pose(found), transform_to_pose(X_desired), atol=1e-9)
