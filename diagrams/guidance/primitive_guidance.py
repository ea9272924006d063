"""Guidance by a movement primitive: the demonstrations alone, KGRL, sKGRL, and the residual baselines."""

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import MatrixGain, PassThrough, ZeroOrderHold

from guiderail.diagrams.guidance.primitive_skill import PrimitiveSkill
from guiderail.systems.history_buffer import HistoryBuffer
from guiderail.systems.history_length_schedule import HistoryLengthSchedule
from guiderail.systems.lc_ns_kmp_system import LcNsKmpSystem
from guiderail.systems.residual import Residual
from guiderail.systems.safety_filter import SafetyFilter


class PrimitiveGuidance(Diagram):
    """What all guidance made of a movement primitive shares: its ports.

    .. pydrake_system::

        name: PrimitiveGuidance
        input_ports:
        - action
        - pose
        - wrench
        output_ports:
        - desired_pose
        - fallback

    ``action`` (A,) is the policy's in [−1, 1], one entry per explored output, held for a control period. ``pose`` (O,)
    and ``wrench`` are measured; whoever has no use for one still has the port. ``desired_pose`` (O,) is what to
    command, ``fallback`` (1,) is 1 where something safe was commanded instead of what was asked for.
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
        return action, pose.get_output_port()

    def _finish(self, builder: DiagramBuilder, desired_pose: OutputPort, fallback: OutputPort) -> None:
        builder.ExportOutput(desired_pose, "desired_pose")
        builder.ExportOutput(fallback, "fallback")
        builder.BuildInto(self)


def _add_demonstration(builder: DiagramBuilder, skill: PrimitiveSkill, action: OutputPort) -> LcNsKmpSystem:
    """The primitive that nothing pulls at: neither actions nor constraints nor a history."""
    primitive = skill.primitive(history=False, constrained=False)
    kmp = builder.AddNamedSystem("kmp", LcNsKmpSystem(primitive, None, skill.control_period))
    # Not a ConstantVectorSource: Drake takes that for something that depends on time, and the primitive would be
    # computed anew at every step of the plant.
    deaf = builder.AddNamedSystem("no_action", MatrixGain(D=np.zeros((skill.num_outputs, skill.num_outputs))))
    builder.Connect(action, deaf.get_input_port())
    builder.Connect(deaf.get_output_port(), kmp.get_null_space_action_input_port())
    return kmp


class KmpGuidance(PrimitiveGuidance):
    """The demonstrations alone (thesis, section 2.2.7): the action changes nothing."""

    def __init__(self, skill: PrimitiveSkill):
        super().__init__()
        builder = DiagramBuilder()
        action, _ = self._export_inputs(builder, skill)
        kmp = _add_demonstration(builder, skill, action)
        self._finish(builder, kmp.get_output_output_port(), kmp.get_fallback_output_port())


class ResidualGuidance(PrimitiveGuidance):
    """Residual learning (section 4.4.1): p̂_t = p_t^kmp + Δp_t, as far in every direction and at any time."""

    def __init__(self, skill: PrimitiveSkill, *, safe: bool = False):
        """
        Args:
            skill: the demonstrations; with `safe`, also what to keep away from.
            safe: True puts hand-made active constraints behind the sum; ``fallback`` is then 1 where a wall was in
                the way.
        """
        super().__init__()
        builder = DiagramBuilder()
        action, pose = self._export_inputs(builder, skill)
        kmp = _add_demonstration(builder, skill, action)
        residual = builder.AddNamedSystem("residual", Residual(skill.residual_gains()))
        builder.Connect(kmp.get_output_output_port(), residual.get_reference_input_port())
        builder.Connect(action, residual.get_action_input_port())
        if not safe:
            self._finish(builder, residual.get_desired_pose_output_port(), kmp.get_fallback_output_port())
            return
        assert skill.keep_out is not None
        safety = builder.AddNamedSystem("safety_filter", SafetyFilter(skill.keep_out, skill.control_period))
        builder.Connect(residual.get_desired_pose_output_port(), safety.get_desired_pose_input_port())
        builder.Connect(pose, safety.get_pose_input_port())
        self._finish(builder, safety.get_safe_pose_output_port(), safety.get_intervention_output_port())


class KgrlGuidance(PrimitiveGuidance):
    """KGRL (equation 4.21): null-space actions on a primitive that keeps the constraints."""

    def __init__(self, skill: PrimitiveSkill):
        super().__init__()
        builder = DiagramBuilder()
        action, _ = self._export_inputs(builder, skill)
        primitive = skill.primitive(history=False)
        gains = skill.null_space_gains(primitive)
        kmp = builder.AddNamedSystem("lc_ns_kmp", LcNsKmpSystem(primitive, gains, skill.control_period))
        builder.Connect(action, kmp.get_null_space_action_input_port())
        self._finish(builder, kmp.get_output_output_port(), kmp.get_fallback_output_port())


class SkgrlGuidance(PrimitiveGuidance):
    """sKGRL (equations 5.1-5.3): KGRL whose motion passes through where it has been.

    With an adaptive history it passes through less of it in contact, so that it answers to forces as quickly as KGRL
    there, and is as smooth as ever elsewhere. The shortest history is one output, never none: every command still
    begins where the last one ended, whatever the length does.
    """

    def __init__(self, skill: PrimitiveSkill):
        super().__init__()
        builder = DiagramBuilder()
        action, pose = self._export_inputs(builder, skill)
        primitive = skill.primitive(history=True)
        gains = skill.null_space_gains(primitive)
        shorter = [
            (one, skill.null_space_gains(one)) for one in map(skill.primitive_of_length, skill.shorter_histories)
        ]
        kmp = builder.AddNamedSystem("lc_ns_kmp", LcNsKmpSystem(primitive, gains, skill.control_period, shorter))
        if shorter:
            schedule = builder.AddNamedSystem(
                "history_length",
                HistoryLengthSchedule(
                    (skill.history, *skill.shorter_histories), skill.control_period, wrench_size=skill.wrench_size
                ),
            )
            builder.ConnectInput("wrench", schedule.get_wrench_input_port())
            builder.Connect(schedule.get_history_length_output_port(), kmp.get_history_length_input_port())
        history = builder.AddNamedSystem(
            "history", HistoryBuffer(skill.num_outputs, skill.history, skill.control_period)
        )
        past = kmp.get_output_output_port() if skill.history_source == "commanded" else pose
        builder.Connect(action, kmp.get_null_space_action_input_port())
        builder.Connect(history.get_history_output_port(), kmp.get_history_input_port())
        builder.Connect(past, history.get_output_input_port())
        # Either way it starts from where the robot is: a command from anywhere else would be a jump.
        builder.Connect(pose, history.get_initial_output_input_port())
        self._finish(builder, kmp.get_output_output_port(), kmp.get_fallback_output_port())
