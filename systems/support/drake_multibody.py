"""Conversion between poses and Drake's rigid transforms, and checks of a plant's frames and bodies."""

from collections.abc import Sequence

import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import Frame, RigidBody

from guiderail.models.common.errors import InputError


def check_plant(plant: MultibodyPlant, fixed: Frame | None = None, **frames: Frame) -> None:
    """Raise an `InputError` if one of the frames is of another plant, or `fixed` is not fixed in the world."""
    for name, frame in frames.items():
        if frame.GetParentPlant() is not plant:
            raise InputError(f"{name} is the frame {frame.name()} of another plant: give a frame of this plant")
    if fixed is not None and fixed.body() not in plant.GetBodiesWeldedTo(plant.world_body()):
        raise InputError(f"the target frame {fixed.name()} can move: give a frame that is fixed in the world")


def check_bodies(plant: MultibodyPlant, what: str, bodies: Sequence[RigidBody]) -> None:
    """Raise an `InputError` if one of the bodies is of another plant; `what` is their name in messages."""
    for body in bodies:
        if body.GetParentPlant() is not plant:
            raise InputError(f"{what} has the body {body.name()} of another plant: give a body of this plant")


def effort_limits(plant: MultibodyPlant) -> np.ndarray:
    """Return the effort limits of the joints of a plant, (n,) [Nm], in the order of the plant's velocities.

    `MultibodyPlant.GetEffortUpperLimits` returns them in the order of the actuators, which can differ.

    Raises:
        InputError: If a joint has no actuator or several.
    """
    limits = np.full(plant.num_velocities(), np.nan)
    for actuator in (plant.get_joint_actuator(index) for index in plant.GetJointActuatorIndices()):
        limits[actuator.joint().velocity_start()] = actuator.effort_limit()
    if np.isnan(limits).any() or plant.num_actuators() != len(limits):
        joints = [plant.get_joint(index) for index in plant.GetJointIndices()]
        names = ", ".join(joint.name() for joint in joints if joint.num_velocities())
        raise InputError(
            f"a plant whose joint torques are controlled needs one actuator for each of its joints ({names}), "
            f"not {plant.num_actuators()} actuators"
        )
    return limits


def pose_to_transform(pose: np.ndarray) -> RigidTransform:
    """Return X = (Rz(a) Ry(b) Rx(c), [x y z]) of a pose [x y z a b c] (6,) [m, rad]."""
    return RigidTransform(RollPitchYaw(pose[5], pose[4], pose[3]), pose[:3])


def transform_to_pose(X: RigidTransform) -> np.ndarray:
    """Return the pose [x y z a b c] (6,) [m, rad] of a transform, a and c in [−π, π], b in [−π/2, π/2]."""
    return np.concatenate([X.translation(), RollPitchYaw(X.rotation()).vector()[::-1]])


def transform_to_vector(X: RigidTransform) -> np.ndarray:
    """Return position [m] and rotation vector [rad] of a transform as (6,); the angle is at most π."""
    rotation = X.rotation().ToAngleAxis()
    return np.concatenate([X.translation(), rotation.angle() * rotation.axis()])


def orientation_error(R_desired: RotationMatrix, R: RotationMatrix) -> tuple[float, np.ndarray]:
    """Return the quaternion (η, ε) of R_desired Rᵀ, with ε (3,); its sign is chosen so that η ≥ 0."""
    q = (R_desired @ R.inverse()).ToQuaternion()
    sign = 1.0 if q.w() >= 0.0 else -1.0
    return sign * q.w(), sign * q.xyz()
