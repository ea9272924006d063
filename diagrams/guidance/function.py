"""Guidance defined by a function of action, measured pose and wrench."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.function_guidance_system import FunctionGuidanceSystem, GuidanceFunction


class FunctionGuidance(Guidance):
    """Guidance that commands law(action, pose, wrench) once per control step; see `FunctionGuidanceSystem`.

    The command is not constrained; ``constraint_violation`` is the command's violation of the task's constraints.
    """

    def __init__(self, prior: PriorKnowledge, law: GuidanceFunction, action_size: int):
        """Construct the guidance.

        Args:
            prior: Prior knowledge, for the control period, the station's sizes and the task's constraints.
            law: Pure function from an action (A,), the measured pose (O,) and wrench (W,) to a desired pose (O,).
            action_size: A, at least 1.

        Raises:
            InputError: If a size or the period is out of range.
        """
        super().__init__()
        builder = DiagramBuilder()
        system = FunctionGuidanceSystem(law, action_size, prior.pose_size, prior.wrench_size, prior.period)
        builder.AddNamedSystem("law", system)
        violation = builder.AddNamedSystem("violation", ConstraintViolation(prior.constraints, prior.period))
        builder.Connect(system.get_desired_pose_output_port(), violation.get_pose_input_port())
        for name in ("action", "pose", "wrench"):
            builder.ExportInput(system.GetInputPort(name), name)
        for name in ("desired_pose", "held_action", "fallback"):
            builder.ExportOutput(system.GetOutputPort(name), name)
        builder.ExportOutput(violation.get_violation_output_port(), "constraint_violation")
        builder.BuildInto(self)
