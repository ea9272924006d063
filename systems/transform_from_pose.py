"""Rigid transform of a pose in coordinates."""

from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.transforms import POSE_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import pose_to_transform


class TransformFromPose(LeafSystem):
    """Convert pose coordinates into a rigid transform.

        X = (Rz(a) Ry(b) Rx(c), [x y z])

    ``pose`` is (6,) [x y z a b c] in meters and radians. ``transform`` is an abstract `RigidTransform`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        declare.abstract_output(self, "transform", Value(RigidTransform()), self._transform, [self._pose_port])

    get_pose_input_port = input_getter("pose", "pose, (6,)")
    get_transform_output_port = output_getter("transform", "rigid transform")

    def _transform(self, context: Context) -> RigidTransform:
        return pose_to_transform(self._pose_port.Eval(context))
