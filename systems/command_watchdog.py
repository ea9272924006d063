"""Passes on valid commands, and holds the last one where they stop."""

import numpy as np
from pydrake.systems.framework import BasicVector, Context, InputPort, LeafSystem, OutputPort

from guiderail.models.common.errors import InputError
from guiderail.systems.support.command_watch import CommandWatch


class CommandWatchdog(LeafSystem):
    """Holds the last valid pose when commands stop, for robots whose controller has no watchdog of its own.

    A command is valid while it is finite, no older than a timeout and no more than a period from the future; see
    `CommandWatch`, which also says when that is checked.

    .. pydrake_system::

        name: CommandWatchdog
        input_ports:
        - desired_pose
        - pose
        - command_time (optional)
        output_ports:
        - safe_pose
        - command_timed_out

    ``desired_pose``, ``pose`` (measured, read at initialization) and ``safe_pose`` are (O,). ``command_time`` is (1,),
    when ``desired_pose`` was given [s]; unconnected, commands never get stale. ``command_timed_out`` is (1,): 1 while a pose is
    held.
    """

    def __init__(self, period: float, timeout: float = 0.1, pose_size: int = 6):
        """
        Args:
            period: at which commands are checked [s], positive; best the period at which they change.
            timeout: age beyond which a command is stale [s], positive.
            pose_size: O, at least 1.

        Raises:
            InputError: if an argument is out of range.
        """
        super().__init__()
        if pose_size < 1:
            raise InputError(f"a pose has at least one coordinate, not {pose_size}")
        self._desired_pose_port = self.DeclareVectorInputPort("desired_pose", pose_size)
        self._pose_port = self.DeclareVectorInputPort("pose", pose_size)
        self._command_time_port = self.DeclareVectorInputPort("command_time", 1)
        self._watch = CommandWatch(
            self,
            self._desired_pose_port,
            self._command_time_port,
            self._measured_pose,
            period=period,
            timeout=timeout,
        )
        self._safe_pose_port = self.DeclareVectorOutputPort(
            "safe_pose", pose_size, self._calc_safe_pose, prerequisites_of_calc=self._watch.tickets
        )
        self._command_timed_out_port = self.DeclareVectorOutputPort(
            "command_timed_out", 1, self._watch.calc_holding, prerequisites_of_calc=self._watch.holding_tickets
        )

    def get_desired_pose_input_port(self) -> InputPort:
        """The commanded pose, (O,)."""
        return self._desired_pose_port

    def get_pose_input_port(self) -> InputPort:
        """The measured pose, (O,)."""
        return self._pose_port

    def get_command_time_input_port(self) -> InputPort:
        """When the desired pose was given, (1,) [s]; optional."""
        return self._command_time_port

    def get_safe_pose_output_port(self) -> OutputPort:
        """The commanded pose, or the held one, (O,)."""
        return self._safe_pose_port

    def get_command_timed_out_output_port(self) -> OutputPort:
        """1 while a pose is held, (1,)."""
        return self._command_timed_out_port

    def _measured_pose(self, context: Context) -> np.ndarray:
        return self._pose_port.Eval(context)

    def _calc_safe_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._watch.pose(context))
