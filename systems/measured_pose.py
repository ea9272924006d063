"""Measured pose of a body in the pose coordinates of a station."""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RigidBody
from pydrake.systems.framework import Context, LeafSystem

from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.drake_multibody import check_bodies, transform_to_pose


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
