"""Poses of bodies, poses without jumps of their angles, and conversions of poses and wrenches to Drake's types."""

from collections.abc import Sequence

import numpy as np
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE, nearest_pose
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import (
    check_bodies,
    pose_to_transform,
    transform_to_pose,
    transform_to_vector,
)


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


class MeasuredPose(LeafSystem):
    """Compute the pose of a body P in a frame T that is fixed in the world.

        X_TP = X_TW X_WP

    ``body_poses`` is the plant's output. ``pose`` is (6,), [x y z Rz Ry Rx] in meters and radians.

    Args:
        plant: Finalized plant.
        body: Body P.
        X_WT: Pose of frame T in the world.

    Raises:
        InputError: If the body is of another plant.
    """

    def __init__(self, plant: MultibodyPlant, body: RigidBody, X_WT: RigidTransform):
        super().__init__()
        check_bodies(plant, "body", [body])
        self._body = int(body.index())
        self._X_TW = X_WT.inverse()
        self._body_poses_port = self.DeclareAbstractInputPort(
            "body_poses", plant.get_body_poses_output_port().Allocate()
        )
        declare.output(self, "pose", 6, self._pose, [self._body_poses_port])

    get_body_poses_input_port = input_getter("body_poses", "plant's body poses")
    get_pose_output_port = output_getter("pose", "pose X_TP, (6,)")

    def _pose(self, context: Context) -> np.ndarray:
        return transform_to_pose(self._X_TW @ self._body_poses_port.Eval(context)[self._body])


class RelativePoses(LeafSystem):
    """Compute the poses of bodies B relative to a reference body R.

        X_RB = X_RW X_WB

    ``body_poses`` is the plant's output. ``relative_poses`` is (6·n,) for n bodies: the position of each body [m] and
    its orientation as a rotation vector of at most π radians.

    Args:
        plant: Finalized plant.
        bodies: Bodies B, at least one.
        reference: Body R.

    Raises:
        InputError: If a body is of another plant.
    """

    def __init__(self, plant: MultibodyPlant, bodies: Sequence[RigidBody], reference: RigidBody):
        super().__init__()
        check_bodies(plant, "bodies", bodies)
        check_bodies(plant, "reference", [reference])
        self._bodies = [int(body.index()) for body in bodies]
        self._reference = int(reference.index())
        self._body_poses_port = self.DeclareAbstractInputPort(
            "body_poses", plant.get_body_poses_output_port().Allocate()
        )
        declare.output(self, "relative_poses", 6 * len(self._bodies), self._relative_poses, [self._body_poses_port])

    get_body_poses_input_port = input_getter("body_poses", "plant's body poses")
    get_relative_poses_output_port = output_getter("relative_poses", "poses relative to the reference, (6·n,)")

    def _relative_poses(self, context: Context) -> np.ndarray:
        poses = self._body_poses_port.Eval(context)
        X_WR = poses[self._reference]
        return np.concatenate([transform_to_vector(X_WR.InvertAndCompose(poses[body])) for body in self._bodies])


class ContinuousPose(LeafSystem):
    """Replace the angles of a measured pose by those of the same orientation that are nearest to the pose before.

    Measured angles are within ±π and jump by a full turn at ±π; [Rz Ry Rx] also jump to (Rz + π, π − Ry, Rx + π) at
    Ry = ±π/2. A history, a progress, limits and an observation of the output have no such jumps.

    Both ports are (6,), [x y z Rz Ry Rx] in meters and radians. The pose before is sampled every period and is `near`
    at initialization. A pose that is not finite is output unchanged and not stored.

    Args:
        near: Pose (6,) of which the first output is the nearest equivalent, such as the first mean of a reference.
        period: Sampling period [s], positive; the pose turns by less than half a turn in it.
    """

    def __init__(self, near: np.ndarray, period: float):
        super().__init__()
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        self._last = self.DeclareDiscreteState(near)
        declare.output(self, "continuous_pose", POSE_SIZE, self._continuous_pose, [self._pose_port, self._last])
        declare.update(self, period, self._update, declare.reset_to_default(self))

    get_pose_input_port = input_getter("pose", "measured pose, (6,)")
    get_continuous_pose_output_port = output_getter("continuous_pose", "pose without jumps of its angles, (6,)")

    def _continuous_pose(self, context: Context) -> np.ndarray:
        return nearest_pose(self._pose_port.Eval(context), context.get_discrete_state().value(self._last))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        pose = self._continuous_pose(context)
        if is_finite(pose):
            discrete_state.set_value(self._last, pose)
