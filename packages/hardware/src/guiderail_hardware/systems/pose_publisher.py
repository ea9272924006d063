"""Publisher of desired poses to a robot whose own controller is the impedance controller."""

from collections.abc import Callable

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, LeafSystem

from guiderail.systems.support.declarations import check_period, input_getter
from guiderail.systems.support.drake_multibody import pose_to_transform
from guiderail_hardware.systems.torque_safety_limiter import CONTROLLED, ArmState


class PosePublisher(LeafSystem):
    """Publish a desired pose once per period while the arm is controlled; otherwise stop the robot.

    If the pose is not finite, the robot is stopped as well. Nothing is sent while the arm state is `ArmState.WAITING`.

    .. pydrake_system::

        name: PosePublisher
        input_ports:
        - pose
        - arm_state

    ``pose`` is X_TP as (6,), [x y z Rz Ry Rx] in meters and radians. ``arm_state`` is (1,), a value of `ArmState`.

    Args:
        write_pose: Function that sends a pose X_BaseTool at a time [s], such as `PoseDriver.write_pose`.
        stop: Function that brings the robot to rest, such as `PoseDriver.stop`.
        X_BaseTarget: Pose of the target frame T in the robot's base frame.
        period: Publishing period [s], positive.

    Raises:
        InputError: If the period is out of range.
    """

    def __init__(
        self,
        write_pose: Callable[[RigidTransform, float], None],
        stop: Callable[[], None],
        X_BaseTarget: RigidTransform,
        *,
        period: float,
    ):
        super().__init__()
        check_period(period)
        self._write_pose, self._stop, self._X_BaseTarget = write_pose, stop, X_BaseTarget
        self._pose_port = self.DeclareVectorInputPort("pose", 6)
        self._arm_state_port = self.DeclareVectorInputPort("arm_state", 1)
        self.DeclarePeriodicPublishEvent(period, 0.0, self._publish)

    get_pose_input_port = input_getter("pose", "desired pose of the tool center, (6,)")
    get_arm_state_input_port = input_getter("arm_state", "state of the arm, (1,), a value of `ArmState`")

    def _publish(self, context: Context) -> None:
        state = self._arm_state_port.Eval(context)[0]
        pose = self._pose_port.Eval(context)
        if state in CONTROLLED and np.isfinite(pose).all():
            self._write_pose(self._X_BaseTarget @ pose_to_transform(pose), context.get_time())
        elif state != ArmState.WAITING:
            self._stop()
