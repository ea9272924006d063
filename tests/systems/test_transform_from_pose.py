import numpy as np
from pydrake.math import RigidTransform

from guiderail.systems import TransformFromPose


def test_transform_has_the_position_and_the_rotations_of_the_pose():
    system = TransformFromPose()
    context = system.CreateDefaultContext()
    system.get_pose_input_port().FixValue(context, [1.0, 2.0, 3.0, np.pi / 2, 0.0, 0.0])
    X = system.get_transform_output_port().Eval(context)
    assert isinstance(X, RigidTransform)
    np.testing.assert_allclose(X.translation(), [1.0, 2.0, 3.0])
    np.testing.assert_allclose(X.rotation().matrix() @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-15)
    system.get_pose_input_port().FixValue(context, np.zeros(6))
    assert system.get_transform_output_port().Eval(context).IsExactlyIdentity()
