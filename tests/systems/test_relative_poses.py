import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia

from guiderail.models.pose_coordinates import pose_to_transform
from guiderail.systems.measured_pose import MeasuredPose
from guiderail.systems.relative_poses import RelativePoses

X_WA = RigidTransform(RotationMatrix.MakeZRotation(0.5), [1.0, 0.0, 0.2])
X_WB = RigidTransform(RotationMatrix.MakeXRotation(-2.1), [0.0, 0.3, 0.0])


@pytest.fixture(scope="module")
def plant():
    plant = MultibodyPlant(0.0)
    for name in ("a", "b"):
        plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    return plant


def evaluated(plant, system):
    plant_context = plant.CreateDefaultContext()
    for name, X in (("a", X_WA), ("b", X_WB)):
        plant.SetFloatingBaseBodyPoseInWorldFrame(plant_context, plant.GetBodyByName(name), X)
    context = system.CreateDefaultContext()
    system.get_body_poses_input_port().FixValue(context, plant.get_body_poses_output_port().Eval(plant_context))
    return system.get_output_port().Eval(context)


def test_relative_poses_are_those_in_the_reference_body(plant):
    a, b = plant.GetBodyByName("a"), plant.GetBodyByName("b")
    seen = evaluated(plant, RelativePoses(plant, [b, a], a)).reshape(2, 6)
    X_AB = X_WA.inverse() @ X_WB
    turn = X_AB.rotation().ToAngleAxis()
    np.testing.assert_allclose(seen[0], [*X_AB.translation(), *(turn.angle() * turn.axis())], atol=1e-12)
    np.testing.assert_allclose(seen[1], np.zeros(6), atol=1e-12)


def test_measured_pose_is_that_in_the_target_frame(plant):
    X_WT = RigidTransform(RotationMatrix.MakeYRotation(0.2), [0.1, 0.2, 0.3])
    pose = evaluated(plant, MeasuredPose(plant, plant.GetBodyByName("b"), X_WT))
    np.testing.assert_allclose(
        pose_to_transform(pose).GetAsMatrix34(), (X_WT.inverse() @ X_WB).GetAsMatrix34(), atol=1e-12
    )


def test_refuses_no_bodies(plant):
    with pytest.raises(ValueError, match="at least one"):
        RelativePoses(plant, [], plant.world_body())
