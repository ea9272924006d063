"""Coordinates of the pose of a rigid transform."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.transforms import POSE_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import transform_to_pose


class PoseFromTransform(LeafSystem):
    """Convert a rigid transform into pose coordinates; the inverse of `TransformFromPose`.

    ``transform`` is an abstract `RigidTransform`. ``pose`` is (6,) [x y z Rz Ry Rx] in meters and radians, Rz and Rx in
    [−π, π], Ry in [−π/2, π/2].
    """

    def __init__(self) -> None:
        super().__init__()
        self._transform_port = self.DeclareAbstractInputPort("transform", Value(RigidTransform()))
        declare.output(self, "pose", POSE_SIZE, self._pose, [self._transform_port])

    get_transform_input_port = input_getter("transform", "rigid transform")
    get_pose_output_port = output_getter("pose", "pose, (6,)")

    def _pose(self, context: Context) -> np.ndarray:
        return transform_to_pose(self._transform_port.Eval(context))
