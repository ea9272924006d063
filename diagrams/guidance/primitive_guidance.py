"""What all guidance made of a movement primitive shares: its ports, and the demonstrations that nothing pulls at."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import DiagramBuilder, OutputPort
from pydrake.systems.primitives import MatrixGain, PassThrough, ZeroOrderHold

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.known import Known
from guiderail.diagrams.guidance.primitive_skill import PrimitiveSkill
from guiderail.systems.constraint_violation import ConstraintViolation
from guiderail.systems.lc_ns_kmp_system import LcNsKmpSystem


def skill_of(known: Known) -> PrimitiveSkill:
    """The demonstrations that are known; whoever registered its needs has them."""
    assert known.demonstrations is not None
    return known.demonstrations


class PrimitiveGuidance(Guidance):
    """A diagram with the ports of all guidance, around a movement primitive.

    ``action`` has one entry per explored output. ``constraint_violation`` is judged of the command as it comes out,
    whether or not this kind keeps the constraints.
    """

    def _export_inputs(self, builder: DiagramBuilder, skill: PrimitiveSkill) -> tuple[OutputPort, OutputPort]:
        """Exports the inputs and returns where the held action, spread over all outputs (O,), and the pose come out."""
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(skill.control_period, skill.num_actions))
        action = hold.get_output_port()
        if not np.array_equal(skill.selection, np.eye(skill.num_outputs)):
            spread = builder.AddNamedSystem("explored_outputs", MatrixGain(D=skill.selection))
            builder.Connect(action, spread.get_input_port())
            action = spread.get_output_port()
        pose = builder.AddNamedSystem("pose", PassThrough(skill.num_outputs))
        wrench = builder.AddNamedSystem("wrench", PassThrough(skill.wrench_size))
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(pose.get_input_port(), "pose")
        builder.ExportInput(wrench.get_input_port(), "wrench")
        self._held_action = hold.get_output_port()
        return action, pose.get_output_port()

    def _finish(
        self, builder: DiagramBuilder, skill: PrimitiveSkill, desired_pose: OutputPort, fallback: OutputPort
    ) -> None:
        """Exports the outputs and builds."""
        violation = builder.AddNamedSystem(
            "constraint_violation", ConstraintViolation(skill.constraints, skill.control_period)
        )
        builder.Connect(desired_pose, violation.get_pose_input_port())
        builder.ExportOutput(desired_pose, "desired_pose")
        builder.ExportOutput(self._held_action, "held_action")
        builder.ExportOutput(violation.get_violation_output_port(), "constraint_violation")
        builder.ExportOutput(fallback, "fallback")
        builder.BuildInto(self)


def add_demonstration(builder: DiagramBuilder, skill: PrimitiveSkill, action: OutputPort) -> LcNsKmpSystem:
    """Adds the primitive without actions, constraints or history: what the demonstrations alone command."""
    primitive = skill.primitive(history=False, constrained=False)
    kmp = builder.AddNamedSystem("kmp", LcNsKmpSystem(primitive, None, skill.control_period))
    # Not a ConstantVectorSource: Drake takes that for something that depends on time, and the primitive would be
    # computed anew at every step of the plant.
    zero = builder.AddNamedSystem("no_action", MatrixGain(D=np.zeros((skill.num_outputs, skill.num_outputs))))
    builder.Connect(action, zero.get_input_port())
    builder.Connect(zero.get_output_port(), kmp.get_null_space_action_input_port())
    return kmp
