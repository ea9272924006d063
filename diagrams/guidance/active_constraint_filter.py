"""The active constraints and the state machine of a skill, behind anything that requests a pose."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder

from guiderail.models.skills import Skill
from guiderail.systems.active_constraint_projector import ActiveConstraintProjector
from guiderail.systems.sct_state_machine import SctStateMachine


class ActiveConstraintFilter(Diagram):
    """The active constraints and the state machine of a skill, behind anything that requests a pose.

    .. pydrake_system::

        name: ActiveConstraintFilter
        input_ports:
        - requested_pose
        - pose
        output_ports:
        - desired_pose
        - fallback
        - last_desired_pose
        - state
        - transition_distance
        - progress
        - commanded_violation
        - measured_violation
    """

    def __init__(self, skill: Skill, frames: Mapping[str, RigidTransform], period: float, leash: float = np.inf):
        """
        Args:
            skill: the template.
            frames: the poses X_WF of its objects by name; W is the frame that all poses are given in.
            period: seconds between control steps.
            leash: [m] how far the robot may be from its command before that waits.
        """
        super().__init__()
        builder = DiagramBuilder()
        self._projector = ActiveConstraintProjector(skill, frames, period, leash)
        builder.AddNamedSystem("projector", self._projector)
        self._machine = SctStateMachine(skill, frames, period)
        builder.AddNamedSystem("state_machine", self._machine)
        # The state follows the command, not the measured pose: so the command is always inside the constraints of the
        # state that it is made for, and a transition doesn't depend on how well the robot tracks.
        builder.Connect(self._projector.get_desired_pose_output_port(), self._machine.get_pose_input_port())
        builder.Connect(self._machine.get_state_output_port(), self._projector.get_state_input_port())
        builder.ExportInput(self._projector.get_requested_pose_input_port(), "requested_pose")
        builder.ExportInput(self._projector.get_pose_input_port(), "pose")
        builder.ConnectInput("pose", self._machine.get_initial_pose_input_port())
        for system, names in (
            (self._projector, ("desired_pose", "fallback", "last_desired_pose")),
            (self._machine, ("state", "transition_distance", "progress")),
            (self._projector, ("commanded_violation", "measured_violation")),
        ):
            for name in names:
                builder.ExportOutput(system.GetOutputPort(name), name)
        builder.BuildInto(self)

    def export_outputs(self, builder: DiagramBuilder) -> None:
        """Exports this filter's outputs from a diagram of guidance that contains it."""
        names = ("desired_pose", "fallback", "state", "transition_distance", "progress", "measured_violation")
        for name in names:
            builder.ExportOutput(self.GetOutputPort(name), name)
        builder.ExportOutput(self.GetOutputPort("commanded_violation"), "constraint_violation")

    def set_frames(self, root_context: Context, frames: Mapping[str, RigidTransform]) -> None:
        """Moves objects; those that aren't named stay. The context is the root diagram's."""
        for system in (self._projector, self._machine):
            system.frames.set(system.GetMyMutableContextFromRoot(root_context), frames)
