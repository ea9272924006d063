"""Poses of bodies of a plant relative to a reference body."""

from collections.abc import Sequence

import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, LeafSystem

from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_bodies, transform_to_vector


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
