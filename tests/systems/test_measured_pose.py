import numpy as np
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import SpatialInertia

from guiderail.systems.poses import MeasuredPose
from guiderail.systems.support.drake_multibody import pose_to_transform

X_WT = RigidTransform(RotationMatrix.MakeYRotation(0.2), [0.1, 0.2, 0.3])
X_WP = RigidTransform(RotationMatrix.MakeXRotation(-2.1), [0.0, 0.3, 0.0])


def test_pose_is_the_pose_of_the_body_in_the_target_frame():
    plant = MultibodyPlant(0.0)
    body = plant.AddRigidBody("body", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
    plant.Finalize()
    plant_context = plant.CreateDefaultContext()
    plant.SetFloatingBaseBodyPoseInWorldFrame(plant_context, body, X_WP)
    system = MeasuredPose(plant, body, X_WT)
    context = system.CreateDefaultContext()
    system.get_body_poses_input_port().FixValue(context, plant.get_body_poses_output_port().Eval(plant_context))
    pose = system.get_pose_output_port().Eval(context)
    np.testing.assert_allclose(
        pose_to_transform(pose).GetAsMatrix34(), (X_WT.inverse() @ X_WP).GetAsMatrix34(), atol=1e-12
    )
