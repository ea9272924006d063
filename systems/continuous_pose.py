"""Measured pose whose angles do not jump."""

import numpy as np
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from guiderail.models.common.arrays import is_finite
from guiderail.models.common.transforms import POSE_SIZE, nearest_pose
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter


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
