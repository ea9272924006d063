"""Wrench on a tool from the generalized forces along its pose coordinates."""

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE, wrench_of_generalized_force
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


class PoseWrench(LeafSystem):
    """Transform generalized forces along pose coordinates into the wrench at the tool center.

        f = τ_xyz,  [ez, Rz(a) ey, Rz(a) Ry(b) ex]ᵀ t = τ_abc

    f is the force, t the torque and τ the generalized force (see `wrench_of_generalized_force`). On a gantry, the joint
    positions are the tool's pose coordinates. The wrench of the environment on the tool, without the tool's weight and
    inertia, is therefore computed from the plant's generalized contact forces.

    ``pose`` is X_TP, the pose of the tool center P in a frame T, as (6,) [x y z a b c] in meters and radians.
    ``generalized_force`` is (6,), along and about these coordinates [N, Nm]. ``wrench`` is (6,), [fx fy fz tx ty tz] at
    P in the axes of T [N, Nm].
    """

    def __init__(self) -> None:
        super().__init__()
        self._pose_port = self.DeclareVectorInputPort("pose", POSE_SIZE)
        self._generalized_force_port = self.DeclareVectorInputPort("generalized_force", POSE_SIZE)
        sources = [self._pose_port, self._generalized_force_port]
        declare.output(self, "wrench", WRENCH_SIZE, self._wrench, sources)

    get_pose_input_port = input_getter("pose", "pose X_TP, (6,)")
    get_generalized_force_input_port = input_getter("generalized_force", "generalized forces, (6,) [N, Nm]")
    get_wrench_output_port = output_getter("wrench", "wrench at P in the axes of T, (6,), force first")

    def _wrench(self, context: Context) -> np.ndarray:
        return wrench_of_generalized_force(self._pose_port.Eval(context), self._generalized_force_port.Eval(context))
