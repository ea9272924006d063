"""Guidance without a diagram of one's own: a function of action, measured pose and wrench."""

from __future__ import annotations

from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.function_guidance_system import FunctionGuidanceSystem, GuidanceFunction


class FunctionGuidance(Guidance):
    """Commands law(action, pose, wrench) once a control step; see `FunctionGuidanceSystem`.

    Nothing is constrained by it: ``constraint_violation`` says by how much the law left the task's constraints.
    """

    def __init__(self, known: PriorKnowledge, law: GuidanceFunction, action_size: int):
        """
        Args:
            known: for the control period, the station's sizes and the task's constraints.
            law: from an action (A,), the measured pose (O,) and wrench (W,) to a desired pose (O,); a pure function.
            action_size: A, at least 1.

        Raises:
            InputError: if a size or the period is out of range.
        """
        super().__init__()
        builder = DiagramBuilder()
        system = FunctionGuidanceSystem(law, action_size, known.pose_size, known.wrench_size, known.period)
        builder.AddNamedSystem("law", system)
        judge = builder.AddNamedSystem("violation", ConstraintViolation(known.constraints, known.period))
        builder.Connect(system.get_desired_pose_output_port(), judge.get_pose_input_port())
        for name in ("action", "pose", "wrench"):
            builder.ExportInput(system.GetInputPort(name), name)
        for name in ("desired_pose", "held_action", "fallback"):
            builder.ExportOutput(system.GetOutputPort(name), name)
        builder.ExportOutput(judge.get_violation_output_port(), "constraint_violation")
        builder.BuildInto(self)
