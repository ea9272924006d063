"""Passes on sound commands, and holds the last one where they stop."""

from __future__ import annotations

from pydrake.systems.framework import BasicVector, Context, LeafSystem

from guiderail.systems.command_watch import CommandWatch


class CommandWatchdog(LeafSystem):
    """Holds the last safe pose when commands stop, for robots whose controller doesn't watch by itself.

    What is sound, and what is held where nothing is, `CommandWatch` says.

    .. pydrake_system::

        name: CommandWatchdog
        input_ports:
        - desired_pose
        - pose
        - command_time (optional)
        output_ports:
        - safe_pose
        - holding

    `desired_pose`, `pose` (measured, read at initialization) and `safe_pose` are (6,). `command_time` is (1,), when
    `desired_pose` was given [s]; unconnected, commands never grow old. `holding` is (1,): 1 while a pose is held.
    """

    def __init__(self, period: float, timeout: float = 0.1):
        """
        Args:
            period: at which a sound command is remembered [s], positive.
            timeout: age from which a command no longer counts [s], positive.

        Raises:
            InputError: if an argument is not positive.
        """
        super().__init__()
        self._desired_pose = self.DeclareVectorInputPort("desired_pose", 6)
        self._pose = self.DeclareVectorInputPort("pose", 6)
        self._command_time = self.DeclareVectorInputPort("command_time", 1)
        self._watch = CommandWatch(
            self, self._desired_pose, self._command_time, self._pose.Eval, period=period, timeout=timeout
        )
        self._safe_pose = self.DeclareVectorOutputPort("safe_pose", 6, self._calc_safe_pose, self._watch.tickets)
        self._holding = self.DeclareVectorOutputPort("holding", 1, self._watch.calc_holding, self._watch.commands)

    def get_desired_pose_input_port(self):
        """What is commanded, (6,)."""
        return self._desired_pose

    def get_pose_input_port(self):
        """What is measured, (6,)."""
        return self._pose

    def get_command_time_input_port(self):
        """When the desired pose was given, (1,) [s]; optional."""
        return self._command_time

    def get_safe_pose_output_port(self):
        """The command, or the last sound one, (6,)."""
        return self._safe_pose

    def get_holding_output_port(self):
        """1 while a pose is held, (1,)."""
        return self._holding

    def _calc_safe_pose(self, context: Context, output: BasicVector) -> None:
        output.SetFromVector(self._watch.pose(context))
