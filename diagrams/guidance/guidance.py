"""Contract of all guidance: the ports between a policy's action and the commanded pose.

=================  =====  ==========================================================================================
input              size   meaning
=================  =====  ==========================================================================================
`action`           A      action of the policy in [−1, 1]; held for a control period
`pose`             O      measured pose, in the station's coordinates
`wrench`           W      measured wrench; the port exists even if the guidance does not use it
=================  =====  ==========================================================================================

======================  =====  =====================================================================================
output                  size   meaning
======================  =====  =====================================================================================
`desired_pose`          O      commanded pose
`held_action`           A      action of the current control period
`constraint_violation`  1      max(c − G y) of the command over the known constraints; negative is slack
`fallback`              1      1 if a safe pose is commanded instead of the requested one
======================  =====  =====================================================================================

Guidance may export more; a task's reward can name such a port, for example a template's `progress`.
"""

from __future__ import annotations

from collections.abc import Mapping

from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, InputPort, OutputPort

from guiderail.models.common.errors import InputError

INPUTS = ("action", "pose", "wrench")
OUTPUTS = ("desired_pose", "held_action", "constraint_violation", "fallback")


class Guidance(Diagram):
    """Diagram with the ports of the contract.

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
        """Set the poses of objects in this episode, by name; guidance without objects does nothing."""

    def get_action_input_port(self) -> InputPort:
        """Return the port of the policy's action in [−1, 1], (A,)."""
        return self.GetInputPort("action")

    def get_pose_input_port(self) -> InputPort:
        """Return the port of the measured pose, (O,)."""
        return self.GetInputPort("pose")

    def get_wrench_input_port(self) -> InputPort:
        """Return the port of the measured wrench, (W,)."""
        return self.GetInputPort("wrench")

    def get_desired_pose_output_port(self) -> OutputPort:
        """Return the port of the commanded pose, (O,)."""
        return self.GetOutputPort("desired_pose")

    def get_held_action_output_port(self) -> OutputPort:
        """Return the port of the current action, (A,)."""
        return self.GetOutputPort("held_action")

    def get_constraint_violation_output_port(self) -> OutputPort:
        """Return the port of max(c − G y) of the command, (1,)."""
        return self.GetOutputPort("constraint_violation")

    def get_fallback_output_port(self) -> OutputPort:
        """Return the port that is 1 if a safe pose is commanded instead of the requested one, (1,)."""
        return self.GetOutputPort("fallback")


def check_guidance_ports(guidance: Diagram, pose_size: int, wrench_size: int, kind: str = "") -> None:
    """Refuse a diagram with ports that do not fit a station.

    Args:
        guidance: Diagram.
        pose_size: O of the station.
        wrench_size: W of the station.
        kind: Name of the guidance for the message; default: the diagram's.

    Raises:
        InputError: If a port of the contract is missing or has another size.
    """
    name_of_guidance = f"guidance '{kind or guidance.get_name()}'"
    missing_inputs = [name for name in INPUTS if not guidance.HasInputPort(name)]
    missing = missing_inputs + [name for name in OUTPUTS if not guidance.HasOutputPort(name)]
    if missing:
        remedy = ", and an input that it doesn't use from a PassThrough of its size" if missing_inputs else ""
        raise InputError(f"{name_of_guidance} exports no port {', '.join(missing)}: all guidance does{remedy}")
    sizes = {
        "pose": (guidance.GetInputPort("pose").size(), pose_size),
        "wrench": (guidance.GetInputPort("wrench").size(), wrench_size),
        "desired_pose": (guidance.GetOutputPort("desired_pose").size(), pose_size),
        "held_action": (guidance.GetOutputPort("held_action").size(), guidance.GetInputPort("action").size()),
        "constraint_violation": (guidance.GetOutputPort("constraint_violation").size(), 1),
        "fallback": (guidance.GetOutputPort("fallback").size(), 1),
    }
    for name, (size, needed) in sizes.items():
        if size != needed:
            raise InputError(f"port {name} of {name_of_guidance} has size {size}, where {needed} is needed")
