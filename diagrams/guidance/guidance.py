"""The contract of all guidance: the ports that stand between a policy's action and the pose that a robot is commanded.

=================  =====  ==========================================================================================
input              size   meaning
=================  =====  ==========================================================================================
`action`           A      the policy's, in [−1, 1]; held for a control period
`pose`             O      measured, in the station's coordinates
`wrench`           W      measured; the port is there whether or not this guidance listens to it
=================  =====  ==========================================================================================

======================  =====  =====================================================================================
output                  size   meaning
======================  =====  =====================================================================================
`desired_pose`          O      what to command
`held_action`           A      the action that acts now
`constraint_violation`  1      max(c − G y) of the command over the constraints that are known; negative is slack
`fallback`              1      1 where something safe is commanded instead of what was asked for
======================  =====  =====================================================================================

Guidance may export more; a task's reward can name such a port (`progress` of a template, for one).
"""

from __future__ import annotations

from collections.abc import Mapping

from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, InputPort, OutputPort

from guiderail.models.common.errors import InputError

INPUTS = ("action", "pose", "wrench")
OUTPUTS = ("desired_pose", "held_action", "constraint_violation", "fallback")


class Guidance(Diagram):
    """A diagram with the ports above.

    .. pydrake_system::

        name: Guidance
        input_ports:
        - action
        - pose
        - wrench
        output_ports:
        - desired_pose
        - held_action
        - constraint_violation
        - fallback
    """

    def set_frames(self, root_context: Context, frames: Mapping[str, RigidTransform]) -> None:
        """Says where objects are in this episode, by name; guidance that knows of none does nothing."""

    def get_action_input_port(self) -> InputPort:
        """The policy's action in [−1, 1], (A,)."""
        return self.GetInputPort("action")

    def get_pose_input_port(self) -> InputPort:
        """The measured pose, (O,)."""
        return self.GetInputPort("pose")

    def get_wrench_input_port(self) -> InputPort:
        """The measured wrench, (W,)."""
        return self.GetInputPort("wrench")

    def get_desired_pose_output_port(self) -> OutputPort:
        """What to command, (O,)."""
        return self.GetOutputPort("desired_pose")

    def get_held_action_output_port(self) -> OutputPort:
        """The action that acts now, (A,)."""
        return self.GetOutputPort("held_action")

    def get_constraint_violation_output_port(self) -> OutputPort:
        """max(c − G y) of the command, (1,)."""
        return self.GetOutputPort("constraint_violation")

    def get_fallback_output_port(self) -> OutputPort:
        """1 where something safe is commanded instead of what was asked for, (1,)."""
        return self.GetOutputPort("fallback")


def check_guidance_ports(guidance: Diagram, pose_size: int, wrench_size: int, kind: str = "") -> None:
    """Refuses a diagram that can't stand between a policy and a station.

    Args:
        guidance: the diagram.
        pose_size, wrench_size: O and W of the station.
        kind: what the sentence calls it; the diagram's name unless given.

    Raises:
        InputError: if a port of the contract is missing or of another size than the station's.
    """
    called = f"guidance '{kind or guidance.get_name()}'"
    unlistened = [name for name in INPUTS if not guidance.HasInputPort(name)]
    missing = unlistened + [name for name in OUTPUTS if not guidance.HasOutputPort(name)]
    if missing:
        remedy = ", and an input that it doesn't use from a PassThrough of its size" if unlistened else ""
        raise InputError(f"{called} exports no port {', '.join(missing)}: all guidance does{remedy}")
    sizes = {
        "pose": (guidance.GetInputPort("pose").size(), pose_size),
        "wrench": (guidance.GetInputPort("wrench").size(), wrench_size),
        "desired_pose": (guidance.GetOutputPort("desired_pose").size(), pose_size),
        "held_action": (guidance.GetOutputPort("held_action").size(), guidance.GetInputPort("action").size()),
        "constraint_violation": (guidance.GetOutputPort("constraint_violation").size(), 1),
        "fallback": (guidance.GetOutputPort("fallback").size(), 1),
    }
    for name, (found, wanted) in sizes.items():
        if found != wanted:
            raise InputError(f"port {name} of {called} has size {found}, where {wanted} is needed")
