"""A robot of six perpendicular axes, whose kinematics are simple."""

from collections.abc import Iterable, Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, RigidBody, SpatialInertia


def six_axes(
    motors: Iterable[int] = range(6), limits: Sequence[float] = (200.0,) * 6
) -> tuple[MultibodyPlant, RigidBody]:
    """Return a plant of three prismatic and three revolute axes, and its last link, to which a hand is welded.

    Args:
        motors: Axis of each motor.
        limits: Effort limit of the motor of each axis, (6,) [N, Nm].
    """
    plant, axes = MultibodyPlant(0.0), []
    link = plant.world_body()
    for index, axis in enumerate([*np.eye(3), *np.eye(3)[::-1]]):
        child = plant.AddRigidBody(f"link{index}", SpatialInertia.SolidSphereWithMass(0.3 + 0.1 * index, 0.05))
        kind = PrismaticJoint if index < 3 else RevoluteJoint
        axes.append(plant.AddJoint(kind(f"axis{index}", link.body_frame(), child.body_frame(), axis)))
        link = child
    for number, index in enumerate(motors):
        plant.AddJointActuator(f"motor{number}", axes[index], limits[index])
    hand = plant.AddRigidBody("hand", SpatialInertia.SolidSphereWithMass(0.1, 0.02))
    plant.WeldFrames(link.body_frame(), hand.body_frame())
    plant.Finalize()
    return plant, link
