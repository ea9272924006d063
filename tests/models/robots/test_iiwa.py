"""LBR iiwa 14: rotor inertia, and the external wrench at the wrist."""

import numpy as np
import pytest
from pydrake.multibody.plant import MultibodyPlant

from guiderail.models.common.parsing import add_models
from guiderail.models.control.wrench import external_wrench
from guiderail.models.robots.catalog import CONNECTOR_TOOL, IIWA14
from guiderail.models.robots.mounting import add_end_effector, add_robot


@pytest.fixture(scope="module")
def arm():
    plant = MultibodyPlant(0.0)
    add_end_effector(plant, IIWA14, add_robot(plant, IIWA14), CONNECTOR_TOOL)
    plant.Finalize()
    return plant


def test_iiwa_reflected_rotor_inertia_dominates(arm):
    """Without the rotor inertia times the squared gear ratio, an explicit impedance would be unstable."""
    context = arm.CreateDefaultContext()
    arm.SetPositions(context, IIWA14.home)
    reflected = [arm.get_joint_actuator(index).default_reflected_inertia() for index in arm.GetJointActuatorIndices()]
    assert np.diag(arm.CalcMassMatrix(context)).min() > 1.0
    assert reflected[0] == pytest.approx(1.321e-4 * 160**2)


def test_wrist_wrench_at_rest_is_the_external_wrench():
    mass, gravity = 2.0, np.array([0.0, 0.0, -9.81])
    M = np.diag([0.01, 0.02, 0.03, mass, mass, mass])
    expected = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 5.0])  # 5 N upwards
    F_reaction = np.array([0.0, 0.0, 0.0, 0.0, 0.0, mass * 9.81 - 5.0])
    np.testing.assert_allclose(external_wrench(F_reaction, M, np.zeros(6), np.zeros(6), gravity), expected, atol=1e-12)


def test_wrist_wrench_is_zero_in_free_fall_with_spin():
    """The motion of a free body with an offset center of mass is computed by Drake."""
    plant = MultibodyPlant(0.0)
    (model,) = add_models(plant, CONNECTOR_TOOL.model)
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
