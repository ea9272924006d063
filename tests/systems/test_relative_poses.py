import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia

from guiderail.systems.poses import RelativePoses

X_WA = RigidTransform(RotationMatrix.MakeZRotation(0.5), [1.0, 0.0, 0.2])
X_WB = RigidTransform(RotationMatrix.MakeXRotation(-2.1), [0.0, 0.3, 0.0])


@pytest.fixture(scope="module")
def plant():
    plant = MultibodyPlant(0.0)
    for name in ("a", "b"):
        plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    return plant


def test_poses_are_relative_to_the_reference_body(plant):
    a, b = plant.GetBodyByName("a"), plant.GetBodyByName("b")
    plant_context = plant.CreateDefaultContext()
    plant.SetFloatingBaseBodyPoseInWorldFrame(plant_context, a, X_WA)
    plant.SetFloatingBaseBodyPoseInWorldFrame(plant_context, b, X_WB)
    system = RelativePoses(plant, [b, a], a)
    context = system.CreateDefaultContext()
    system.get_body_poses_input_port().FixValue(context, plant.get_body_poses_output_port().Eval(plant_context))
    poses = system.get_relative_poses_output_port().Eval(context).reshape(2, 6)
    X_AB = X_WA.inverse() @ X_WB
    rotation = X_AB.rotation().ToAngleAxis()
    np.testing.assert_allclose(poses[0], [*X_AB.translation(), *(rotation.angle() * rotation.axis())], atol=1e-12)
    np.testing.assert_allclose(poses[1], np.zeros(6), atol=1e-12)
