import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import JointIndex

from guiderail.models.parsing import add_model
from guiderail.models.robots.iiwa import CONNECTOR_TOOL_URDF, IIWA_URDF, READY_POSTURE
from guiderail.models.tool_wrench import external_wrench


@pytest.fixture(scope="module")
def arm():
    plant = MultibodyPlant(0.0)
    model = add_model(plant, IIWA_URDF)
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("iiwa_link_0"))
    add_model(plant, CONNECTOR_TOOL_URDF)
    plant.WeldFrames(plant.GetFrameByName("iiwa_flange", model), plant.GetFrameByName("tool_body"))
    plant.Finalize()
    return plant


def test_stretched_out_the_flange_is_where_the_data_sheet_says(arm):
    context = arm.CreateDefaultContext()
    p_WFlange = arm.GetFrameByName("iiwa_flange").CalcPoseInWorld(context).translation()
    np.testing.assert_allclose(p_WFlange, [0, 0, 1.306], atol=1e-9)


def test_limits_of_the_data_sheet(arm):
    joints = [
        arm.get_joint(JointIndex(index)) for index in arm.GetJointIndices() if arm.get_joint(index).num_positions()
    ]
    upper = [joint.position_upper_limit() for joint in joints]
    velocity = [joint.velocity_upper_limit() for joint in joints]
    np.testing.assert_allclose(np.rad2deg(np.ravel(upper)), [170, 120, 170, 120, 170, 120, 175], atol=1e-3)
    np.testing.assert_allclose(np.rad2deg(np.ravel(velocity)), [85, 85, 100, 75, 130, 135, 135], atol=1e-3)
    effort = [arm.get_joint_actuator(index).effort_limit() for index in arm.GetJointActuatorIndices()]
    assert effort == [320, 320, 176, 176, 110, 40, 40]


def test_reflected_rotor_inertia_dominates(arm):
    """n² of a gear of 160 turns a gram square metre into kilograms; without it no explicit impedance is stable."""
    context = arm.CreateDefaultContext()
    arm.SetPositions(context, READY_POSTURE)
    reflected = [arm.get_joint_actuator(index).default_reflected_inertia() for index in arm.GetJointActuatorIndices()]
    assert np.diag(arm.CalcMassMatrix(context)).min() > 1.0
    assert reflected[0] == pytest.approx(1.321e-4 * 160**2)


def test_a_tool_at_rest_feels_what_the_wrist_does_not_carry():
    mass, gravity = 2.0, np.array([0.0, 0.0, -9.81])
    M = np.diag([0.01, 0.02, 0.03, mass, mass, mass])
    pushed_up = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0])
    F_reaction = np.array([0.0, 0.0, 0.0, 0.0, 0.0, mass * 9.81 - 5.0])
    np.testing.assert_allclose(external_wrench(F_reaction, M, np.zeros(6), np.zeros(6), gravity), pushed_up, atol=1e-12)


def test_a_tool_that_spins_and_falls_freely_is_touched_by_nothing(arm):
    """A free body with an offset centre of mass, checked against Drake's own dynamics."""
    plant = MultibodyPlant(0.0)
    model = add_model(plant, CONNECTOR_TOOL_URDF)
    plant.Finalize()
    body = plant.GetBodyByName("tool_body", model)
    context = plant.CreateDefaultContext()
    plant.SetVelocities(context, [1.0, -2.0, 3.0, 0.4, 0.5, -0.6])
    A = plant.EvalBodySpatialAccelerationInWorld(context, body).get_coeffs()
    V = plant.EvalBodySpatialVelocityInWorld(context, body).get_coeffs()
    bodies = plant.GetBodyIndices(model)
    M = plant.CalcSpatialInertia(context, body.body_frame(), bodies).CopyToFullMatrix6()
    wrench = external_wrench(np.zeros(6), M, V, A, plant.gravity_field().gravity_vector())
    np.testing.assert_allclose(wrench, np.zeros(6), atol=1e-9)
