"""Watchdog that outputs the last valid command when commands stop."""

from pydrake.systems.framework import LeafSystem

from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail.systems.support.last_valid_pose import LastValidPose


class CommandWatchdog(LeafSystem):
    """Output the desired pose while it is valid, otherwise the last valid desired pose.

    This system is for robot controllers without a command timeout. A command is valid while it is finite, not older
    than the timeout, and not more than one period in the future; see `LastValidPose`. While the blend factor is zero,
    the last valid pose is the measured pose. If there is no valid command when control begins, the robot therefore
    stays where it is.

    ``desired_pose``, ``pose`` (measured, read at initialization and while the blend factor is zero) and ``safe_pose``
    are (O,). ``command_time`` is (1,), the time stamp of ``desired_pose`` [s]; if it is not connected, commands never
    time out. ``blend_factor`` is (1,), from a `TorqueSafetyLimiter`, and 1 by default.
    ``command_timed_out`` (1,) is 1 while no valid command is available.

    Args:
        period: Period of the check [s], positive; ideally the period of the commands.
        timeout: Age above which a command is stale [s], positive and finite.
        pose_size: Number of coordinates O, at least 1.

    Raises:
        InputError: If the timeout is out of range; at initialization, if the measured pose is not finite.
    """

    def __init__(self, period: float, timeout: float = 0.1, pose_size: int = 6):
        super().__init__()
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", pose_size)
        self._pose_port = self.DeclareVectorInputPort("pose", pose_size)
        self._command_time_port = self.DeclareVectorInputPort("command_time", 1)
        self._blend_factor_port = self.DeclareVectorInputPort("blend_factor", 1)
        followed_pose = LastValidPose(
            self,
            self._desired_pose_port,
            self._command_time_port,
            self._pose_port.Eval,
            period=period,
            timeout=timeout,
            blend_factor=self._blend_factor_port,
        )
        declare.output(self, "safe_pose", pose_size, followed_pose.eval, followed_pose.sources)
        followed_pose.declare_timed_out_output(self)

    get_desired_pose_input_port = input_getter("desired_pose", "commanded pose, (O,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_command_time_input_port = input_getter("command_time", "time stamp of the desired pose, (1,) [s]; optional")
    get_blend_factor_input_port = input_getter("blend_factor", "blend factor, (1,); 0 while the arm is not controlled")
    get_safe_pose_output_port = output_getter("safe_pose", "last valid desired pose, (O,)")
    get_command_timed_out_output_port = output_getter("command_timed_out", "flag that no command is valid, (1,)")
