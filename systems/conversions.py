"""Conversions between Drake's rigid transforms and spatial forces and the vectors of poses and wrenches."""

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import pose_to_transform, transform_to_pose


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


class SpatialForceFromWrench(LeafSystem):
    """Convert a wrench, force first, into Drake's `SpatialForce`, whose vector has the torque first.

    ``wrench`` is (6,) [fx fy fz tx ty tz] in N and Nm. ``spatial_force`` is an abstract `SpatialForce` at the same
    point and in the same axes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._wrench_port = self.DeclareVectorInputPort("wrench", WRENCH_SIZE)
        zero = Value(SpatialForce.Zero())
        declare.abstract_output(self, "spatial_force", zero, self._spatial_force, [self._wrench_port])

    get_wrench_input_port = input_getter("wrench", "wrench, (6,), force first")
    get_spatial_force_output_port = output_getter("spatial_force", "spatial force")

    def _spatial_force(self, context: Context) -> SpatialForce:
        wrench = self._wrench_port.Eval(context)
        return SpatialForce(tau=wrench[3:], f=wrench[:3])


class WrenchFromSpatialForce(LeafSystem):
    """Convert Drake's `SpatialForce` into a wrench, force first; the inverse of `SpatialForceFromWrench`.

    ``spatial_force`` is an abstract `SpatialForce`. ``wrench`` is (6,) [fx fy fz tx ty tz] in N and Nm, at the same
    point and in the same axes.
    """

    def __init__(self) -> None:
        super().__init__()
        self._spatial_force_port = self.DeclareAbstractInputPort("spatial_force", Value(SpatialForce.Zero()))
        declare.output(self, "wrench", WRENCH_SIZE, self._wrench, [self._spatial_force_port])

    get_spatial_force_input_port = input_getter("spatial_force", "spatial force")
    get_wrench_output_port = output_getter("wrench", "wrench, (6,), force first")

    def _wrench(self, context: Context) -> np.ndarray:
        force = self._spatial_force_port.Eval(context)
        return np.concatenate([force.translational(), force.rotational()])
