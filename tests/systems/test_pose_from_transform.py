import numpy as np
from pydrake.common import RandomGenerator
from pydrake.math import RigidTransform, UniformlyRandomRotationMatrix

from guiderail.systems import PoseFromTransform, TransformFromPose


def test_conversions_are_inverse():
    there, back = PoseFromTransform(), TransformFromPose()
    contexts = there.CreateDefaultContext(), back.CreateDefaultContext()
    generator, rng = RandomGenerator(1), np.random.default_rng(1)
    for _ in range(100):
        X = RigidTransform(UniformlyRandomRotationMatrix(generator), rng.standard_normal(3))
        there.get_transform_input_port().FixValue(contexts[0], X)
        pose = there.get_pose_output_port().Eval(contexts[0])
        back.get_pose_input_port().FixValue(contexts[1], pose)
        assert back.get_transform_output_port().Eval(contexts[1]).IsNearlyEqualTo(X, 1e-12)
        assert (np.abs(pose[[3, 5]]) <= np.pi).all()
        assert abs(pose[4]) <= np.pi / 2
