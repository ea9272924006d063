"""Ports of all guidance, from a policy's action to the commanded pose, and guidance by a law.

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
`constraint_violation`  1      max(c − G y) of the command y over all constraints G y ≥ c; negative is slack
`fallback`              1      1 if a safe pose is commanded instead of the requested one
======================  =====  =====================================================================================

Guidance may export further output ports, such as a template's `progress`; a task's reward can name them. Guidance
whose reference depends on the observation also has the input `reference_window`, which a system from
`Guidance.make_reference` computes.
"""

from __future__ import annotations

from collections.abc import Mapping

from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder, System

from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.laws.law import Law
from guiderail.systems.command_checks import ConstraintViolation
from guiderail.systems.law_system import LawSystem
from guiderail.systems.support.declarations import input_getter, output_getter

INPUTS = ("action", "pose", "wrench")
OUTPUTS = ("desired_pose", "held_action", "constraint_violation", "fallback")


class Guidance(Diagram):
    """Diagram with the ports of all guidance.

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
        """Set the poses of objects by name in the root context; guidance without objects ignores them."""

    def make_reference(self, observation_size: int) -> System | None:
        """Return the system that computes ``reference_window`` from the observation (n,); None without this input.

        The system has an input ``observation`` and an output ``reference_window``, and no direct feedthrough, because
        an observation may contain the command.
        """
        return None

    get_action_input_port = input_getter("action", "policy's action in [−1, 1], (A,)")
    get_pose_input_port = input_getter("pose", "measured pose, (O,)")
    get_wrench_input_port = input_getter("wrench", "measured wrench, (W,)")
    get_desired_pose_output_port = output_getter("desired_pose", "commanded pose, (O,)")
    get_held_action_output_port = output_getter("held_action", "current action, (A,)")
    get_constraint_violation_output_port = output_getter("constraint_violation", "command's max(c − G y), (1,)")
    get_fallback_output_port = output_getter(
        "fallback", "flag, 1 if a safe pose is commanded instead of the requested one, (1,)"
    )


class LawGuidance(Guidance):
    """Guidance by a law, once per control step; see `LawSystem`.

    The command is not constrained; ``constraint_violation`` is its violation of the prior knowledge's `constraints`.
    """

    def __init__(self, prior: PriorKnowledge, law: Law):
        """Construct the guidance.

        Args:
            prior: Prior knowledge, for the control period, the size of the wrench and the linear constraints.
            law: Law whose outputs are those of the station's pose.

        Raises:
            InputError: If `law` is not a law, or has another number of outputs.
        """
        super().__init__()
        builder = DiagramBuilder()
        system = LawSystem(law, prior.wrench_size, prior.period)
        if law.num_outputs != prior.pose_size:
            raise InputError(
                f"the pose has size {prior.pose_size}: give the law as many outputs, not {law.num_outputs}"
            )
        builder.AddNamedSystem("law", system)
        violation = ConstraintViolation(prior.constraints, prior.period)
        add_system(builder, "violation", violation, pose=system.get_desired_pose_output_port())
        for name in INPUTS:
            builder.ExportInput(system.GetInputPort(name), name)
        for name in ("desired_pose", "held_action", "fallback"):
            builder.ExportOutput(system.GetOutputPort(name), name)
        builder.ExportOutput(violation.get_violation_output_port(), "constraint_violation")
        builder.BuildInto(self)


def check_guidance_ports(guidance: Diagram, pose_size: int, wrench_size: int, kind: str = "") -> None:
    """Check that the ports of a diagram fit a station with poses (O,) and wrenches (W,).

    The error message names the `kind` of guidance, or the diagram if `kind` is empty.

    Raises:
        InputError: If one of the ports `INPUTS` and `OUTPUTS` is missing or has another size.
    """
    name_of_guidance = f"guidance '{kind or guidance.get_name()}'"
    missing_inputs = [name for name in INPUTS if not guidance.HasInputPort(name)]
    missing = missing_inputs + [name for name in OUTPUTS if not guidance.HasOutputPort(name)]
    if missing:
        remedy = ", an unused input from a PassThrough of its size" if missing_inputs else ""
        raise InputError(f"{name_of_guidance} lacks the port {', '.join(missing)}: export it{remedy}")
    action_size = guidance.GetInputPort("action").size()
    inputs = {"pose": pose_size, "wrench": wrench_size}
    outputs = {"desired_pose": pose_size, "held_action": action_size, "constraint_violation": 1, "fallback": 1}
    for name, needed in (inputs | outputs).items():
        port = guidance.GetInputPort(name) if name in inputs else guidance.GetOutputPort(name)
        if port.size() != needed:
            raise InputError(f"port {name} of {name_of_guidance} has size {port.size()}, where {needed} is needed")
