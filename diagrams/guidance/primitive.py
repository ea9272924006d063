"""Guidance by a movement primitive: the demonstrations alone (KMP), KGRL, sKGRL and residual RL.

`make_law` is also what `guiderail export` writes. In a diagram its law has the parameters, and the systems of
`systems/movement_primitive.py` compute.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from pydrake.systems.framework import Diagram, DiagramBuilder, OutputPort
from pydrake.systems.primitives import Adder, MatrixGain, PassThrough, Saturation, ZeroOrderHold

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.prior import PrimitiveConfig, PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import POSE_SIZE
from guiderail.models.control.command_filters import (
    BarrierFilter,
    CommandLaw,
    KeepOut,
    KeepOutFilter,
    TangentSpaceFilter,
)
from guiderail.models.control.motion_constraints import MotionConstraintFilter
from guiderail.models.laws.primitive import PrimitiveLaw
from guiderail.systems.command_checks import CommandFilter, ConstraintViolation
from guiderail.systems.movement_primitive import (
    HistoryBuffer,
    HistoryLengthSchedule,
    LcNsKmpSystem,
    ProgressClock,
    Residual,
)

MakeFilter = Callable[[PrimitiveConfig, KeepOut], CommandLaw]
"""Function of the primitive's configuration and the keep-out walls that returns the filter of a residual's commands."""

BARRIER_DECAY = 0.2  # γ of `residual_cbf`, largest fraction of the distance to a constraint that one step may cover
# Distance to a constraint at which `residual_tangent` halves the motion towards it, as a multiple of the displacement
# by an action of 1.
SLACK_WIDTH = 0.5


def primitive_config_of(prior: PriorKnowledge) -> PrimitiveConfig:
    """Return the configuration of the prior's primitive; the prior must have demonstrations."""
    assert prior.primitive is not None
    return prior.primitive


def make_law(
    prior: PriorKnowledge,
    *,
    action: Literal["null_space", "residual", "none"] = "null_space",
    constrained: bool = True,
    history: bool = False,
    make_filter: MakeFilter | None = None,
) -> PrimitiveLaw:
    """Return the law of a kind of guidance with a movement primitive.

    Args:
        prior: Prior knowledge with demonstrations.
        action: Effect of the action: a null-space action (KGRL), a displacement of the command (residual RL), or none
            (the demonstrations alone).
        constrained: Enforce the linear constraints at every future point.
        history: True if the motion passes through the last outputs (sKGRL).
        make_filter: Function that returns the filter of a residual's commands; by default none. It needs
                ``constrained=False``, because the primitive's own constraints replace it.

    Raises:
        InputError: If limits of the motion are given, for guidance that does not enforce them, or the motion of a
            residual waits for the robot (``progress=state``).
    """
    config = primitive_config_of(prior)
    period, motion = config.control_period, config.motion
    if action == "residual" and config.progress is not None:
        raise InputError("residual guidance is driven by the clock: choose kgrl, skgrl or kmp for progress=state")
    command_filter: CommandLaw | None = None
    if make_filter is not None:
        if constrained or action != "residual":
            raise ValueError("a filter is for residual commands without the primitive's constraints")
        assert config.keep_out is not None
        command_filter = make_filter(config, config.keep_out)
    if action == "none" or constrained:
        command_filter = MotionConstraintFilter(motion, period) if motion is not None else None
    elif motion is not None:
        motion.refuse_limits()
    primitive = config.primitive(history=history, constrained=constrained)
    return PrimitiveLaw(
        primitive,
        config.null_space_gains(primitive) if action == "null_space" else np.zeros(config.num_outputs),
        residual=config.residual_gains() if action == "residual" else None,
        outputs=config.explored_outputs,
        history_source=config.history_source,  # type: ignore[arg-type]
        # Commanded and measured histories both start at the robot's pose, so that the first command does not jump.
        near=primitive.reference.means[0] if config.num_outputs == POSE_SIZE else None,
        command_filter=command_filter,
        progress=config.progress,
        checked=motion or config.constraints,
    )


class DemonstratedGuidance(Guidance):
    """Base class of guidance with demonstrations.

    ``action`` has one entry per explored output. ``constraint_violation`` is the command's violation of the
    constraints, even if this kind of guidance does not enforce them.
    """

    def _export_inputs(self, builder: DiagramBuilder, config: PrimitiveConfig) -> tuple[OutputPort, OutputPort]:
        """Export the inputs; return the ports of the held action, mapped to all outputs (O,), and of the pose."""
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(config.control_period, config.num_actions))
        action = hold.get_output_port()
        if not np.array_equal(config.selection, np.eye(config.num_outputs)):
            action = add_system(builder, "explored_outputs", MatrixGain(D=config.selection), action).get_output_port()
        pose = builder.AddNamedSystem("pose", PassThrough(config.num_outputs))
        wrench = builder.AddNamedSystem("wrench", PassThrough(config.wrench_size))
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(pose.get_input_port(), "pose")
        builder.ExportInput(wrench.get_input_port(), "wrench")
        self._held_action = hold.get_output_port()
        return action, pose.get_output_port()

    def _finish(
        self, builder: DiagramBuilder, config: PrimitiveConfig, desired_pose: OutputPort, fallback: OutputPort
    ) -> None:
        """Export the outputs and build the diagram."""
        violation = ConstraintViolation(config.motion or config.constraints, config.control_period)
        add_system(builder, "constraint_violation", violation, pose=desired_pose)
        builder.ExportOutput(desired_pose, "desired_pose")
        builder.ExportOutput(self._held_action, "held_action")
        builder.ExportOutput(violation.get_violation_output_port(), "constraint_violation")
        builder.ExportOutput(fallback, "fallback")
        builder.BuildInto(self)


class PrimitiveGuidance(DemonstratedGuidance):
    """Guidance around a movement primitive: the systems of a `PrimitiveLaw`, one for each of its parts.

    With an adaptive history, sKGRL's motion passes through fewer past outputs during contact, so that it reacts to
    forces as quickly as KGRL. With the shortest history, the motion passes through the last output only.
    """

    def __init__(self, prior: PriorKnowledge, *, takes_window: bool = False, **kind: Any):
        """Construct the guidance.

        Args:
            prior: Prior knowledge with demonstrations.
            takes_window: True if the reference is the input ``reference_window`` instead of the demonstrations.
            **kind: Parameters of `make_law`; KGRL by default.

        Raises:
            InputError: As `make_law`.
        """
        super().__init__()
        config, law, builder = primitive_config_of(prior), make_law(prior, **kind), DiagramBuilder()
        action, pose = self._export_inputs(builder, config)
        is_adaptive = law.primitive.history > 0 and config.adaptive_history
        shorter = [
            (short, config.null_space_gains(short))
            for short in (map(config.primitive_of_length, config.shorter_histories) if is_adaptive else ())
        ]
        kmp = LcNsKmpSystem(law.primitive, law.gain, config.control_period, shorter)
        add_system(builder, "lc_ns_kmp", kmp, null_space_action=action)
        if takes_window:
            builder.ExportInput(kmp.get_reference_window_input_port(), "reference_window")
        command, fallback = kmp.get_command_output_port(), kmp.get_fallback_output_port()
        if law.residual is not None:
            residual = add_system(builder, "residual", Residual(law.residual), reference=command, action=action)
            command = residual.get_desired_pose_output_port()
        if law.command_filter is not None:
            safety = CommandFilter(law.command_filter, config.control_period)
            add_system(builder, "command_filter", safety, desired_pose=command, pose=pose)
            command, flag = safety.get_safe_pose_output_port(), safety.get_intervention_output_port()
            if law.primitive.constraints.num_constraints:  # otherwise the primitive has no fallback
                count = add_system(builder, "fallbacks", Adder(2, 1), fallback, flag)
                either = Saturation(np.zeros(1), np.ones(1))
                flag = add_system(builder, "fallback", either, count.get_output_port()).get_output_port()
            fallback = flag
        if law.progress is not None:
            clock = ProgressClock(law.progress, config.num_outputs, config.control_period)
            add_system(builder, "progress", clock, command=command, pose=pose)
            builder.Connect(clock.get_motion_time_output_port(), kmp.get_motion_time_input_port())
            builder.ExportOutput(clock.get_motion_time_output_port(), "motion_time")
        if law.primitive.history:
            history = HistoryBuffer(config.num_outputs, config.history, config.control_period, law.near)
            past = command if law.history_source == "commanded" else pose
            add_system(builder, "history", history, initial_output=pose, output=past)
            builder.Connect(history.get_history_output_port(), kmp.get_history_input_port())
        if shorter:
            lengths = (config.history, *config.shorter_histories)
            schedule = HistoryLengthSchedule(lengths, config.control_period, wrench_size=config.wrench_size)
            builder.AddNamedSystem("history_length", schedule)
            builder.ConnectInput("wrench", schedule.get_wrench_input_port())
            builder.Connect(schedule.get_history_length_output_port(), kmp.get_history_length_input_port())
        self._finish(builder, config, command, fallback)


RESIDUAL: dict[str, Any] = {"action": "residual", "constrained": False}


@register_guidance(
    "kmp", needs=(("demonstrations",),), label="demonstration alone", color="#333333",
    demonstrates=True, displaces=True, ignores_actions=True,
)  # fmt: skip
def kmp(prior: PriorKnowledge) -> Diagram:
    """Build guidance that commands the demonstrations' mean; the action has no effect.

    The linear constraints are enforced only together with shapes or limits of the motion.
    """
    return PrimitiveGuidance(prior, action="none", constrained=False)


@register_guidance(
    "kgrl", needs=(("demonstrations",),), label="KGRL", color="#1f77b4", demonstrates=True, displaces=True
)
def kgrl(prior: PriorKnowledge) -> Diagram:
    """Build KGRL: actions displace the command where the demonstrations vary, and commands satisfy the constraints."""
    return PrimitiveGuidance(prior)


@register_guidance(
    "residual_covariance", needs=(("demonstrations",),), label="residual RL scaled by covariance", color="#e377c2",
    demonstrates=True, displaces=True,
)  # fmt: skip
def residual_covariance(prior: PriorKnowledge) -> Diagram:
    """Build KGRL without constraints: a residual that is scaled by the covariance of the demonstrations."""
    return PrimitiveGuidance(prior, constrained=False)


@register_guidance(
    "skgrl", needs=(("demonstrations",),), label="sKGRL", color="#2ca02c", demonstrates=True, displaces=True
)
def skgrl(prior: PriorKnowledge) -> Diagram:
    """Build sKGRL: null-space actions with a history of outputs, so that exploration is smooth."""
    return PrimitiveGuidance(prior, history=True)


@register_guidance(
    "residual", needs=(("demonstrations",), ("approach", "template")), label="residual RL", color="#d62728",
    demonstrates=True, displaces=True,
)  # fmt: skip
def residual(prior: PriorKnowledge) -> Diagram:
    """Build residual RL with demonstrations, or with a scripted approach and active constraints."""
    from guiderail.diagrams.guidance.sct import ResidualDescent

    return PrimitiveGuidance(prior, **RESIDUAL) if prior.primitive is not None else ResidualDescent(prior)


@register_guidance(
    "safe_residual", needs=(("demonstrations", "keep_out"),), label="safe residual RL", color="#ff7f0e",
    demonstrates=True, displaces=True,
)  # fmt: skip
def safe_residual(prior: PriorKnowledge) -> Diagram:
    """Build residual RL with a filter that projects the command and stops it at walls; see `KeepOutFilter`."""
    return PrimitiveGuidance(prior, **RESIDUAL, make_filter=lambda config, walls: KeepOutFilter(walls))


@register_guidance(
    "residual_cbf", needs=(("demonstrations", "keep_out"),), label="residual RL, barrier function", color="#bcbd22",
    demonstrates=True, displaces=True,
)  # fmt: skip
def residual_cbf(prior: PriorKnowledge) -> Diagram:
    """Build residual RL with a control barrier function on the command; see `BarrierFilter`."""
    return PrimitiveGuidance(prior, **RESIDUAL, make_filter=lambda config, walls: BarrierFilter(walls, BARRIER_DECAY))


@register_guidance(
    "residual_tangent", needs=(("demonstrations", "keep_out"),), label="residual RL, tangent space", color="#7f7f7f",
    demonstrates=True, displaces=True,
)  # fmt: skip
def residual_tangent(prior: PriorKnowledge) -> Diagram:
    """Build residual RL in the tangent space of the constraints; see `TangentSpaceFilter`."""

    def make_filter(config: PrimitiveConfig, walls: KeepOut) -> CommandLaw:
        return TangentSpaceFilter(walls, SLACK_WIDTH * float(config.residual_gains().max()))

    return PrimitiveGuidance(prior, **RESIDUAL, make_filter=make_filter)
