"""Guidance by a shared control template: a few inputs of a user or a policy move a pose within active constraints."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, Diagram, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain, PassThrough, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.diagrams.wiring import add_system
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.models.templates import SharedControlTemplate, load_template
from guiderail.systems.movement_primitive import Residual
from guiderail.systems.shared_control_template import ActiveConstraintProjector, SctInputMapping, SctStateMachine


class ActiveConstraintFilter(Diagram):
    """Diagram that applies a template's active constraints and state machine to a requested pose.

    .. pydrake_system::

        name: ActiveConstraintFilter
        input_ports:
        - requested_pose
        - pose
        - frame_poses (optional)
        output_ports:
        - desired_pose
        - fallback
        - last_desired_pose
        - state
        - transition_distance
        - progress
        - commanded_violation
        - measured_violation
        - state_max_wrench
    """

    def __init__(
        self,
        template: SharedControlTemplate,
        frames: Mapping[str, RigidTransform],
        period: float,
        max_tracking_error: float = np.inf,
    ):
        """Construct the diagram.

        `frames` are the poses X_WF of the template's objects by name; W is the frame of all poses. `period` is the
        control period [s]. If the robot is farther than `max_tracking_error` [m] from its command, the last command is
        repeated, unless the new one is closer to the robot.
        """
        super().__init__()
        builder = DiagramBuilder()
        self._projector = ActiveConstraintProjector(template, frames, period, max_tracking_error)
        builder.AddNamedSystem("projector", self._projector)
        self._machine = SctStateMachine(template, frames, period)
        # The state depends on the command, not on the measured pose. The command is then always inside the constraints
        # of the state, and a transition does not depend on the robot's tracking error.
        add_system(builder, "state_machine", self._machine, pose=self._projector.get_desired_pose_output_port())
        builder.Connect(self._machine.get_state_output_port(), self._projector.get_state_input_port())
        builder.ExportInput(self._projector.get_requested_pose_input_port(), "requested_pose")
        builder.ExportInput(self._projector.get_pose_input_port(), "pose")
        builder.ConnectInput("pose", self._machine.get_initial_pose_input_port())
        if template.frames:
            builder.ExportInput(self._projector.get_frame_poses_input_port(), "frame_poses")
            builder.ConnectInput("frame_poses", self._machine.get_frame_poses_input_port())
        for system, names in (
            (self._projector, ("desired_pose", "fallback", "last_desired_pose")),
            (self._machine, ("state", "transition_distance", "progress")),
            (self._projector, ("commanded_violation", "measured_violation")),
        ):
            for name in names:
                builder.ExportOutput(system.GetOutputPort(name), name)
        builder.ExportOutput(self._machine.get_max_wrench_output_port(), "state_max_wrench")
        builder.BuildInto(self)

    def export_ports(self, builder: DiagramBuilder, hold: ZeroOrderHold) -> None:
        """Export the ports of the guidance diagram in `builder`, which contains this filter and the action's `hold`."""
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(self.GetInputPort("pose"), "pose")
        # The wrench is unused, but all guidance has this port.
        wrench = builder.AddNamedSystem("wrench", PassThrough(WRENCH_SIZE))
        builder.ExportInput(wrench.get_input_port(), "wrench")
        if self.HasInputPort("frame_poses"):
            builder.ExportInput(self.GetInputPort("frame_poses"), "frame_poses")
        builder.ExportOutput(hold.get_output_port(), "held_action")
        names = ("desired_pose", "fallback", "state", "transition_distance", "progress", "measured_violation")
        for name in (*names, "state_max_wrench"):
            builder.ExportOutput(self.GetOutputPort(name), name)
        builder.ExportOutput(self.GetOutputPort("commanded_violation"), "constraint_violation")

    def set_frames(self, root_context: Context, frames: Mapping[str, RigidTransform]) -> None:
        """Set the poses of the named objects in the root context; other poses do not change."""
        for system in (self._projector, self._machine):
            system.frames.set(system.GetMyMutableContextFromRoot(root_context), frames)


class SctGuidance(Guidance):
    """Shared control: input mapping and active constraints of the template's current state.

    ``action`` is (n,), the n inputs of the template, from a policy or a user's input device. ``constraint_violation``
    is the command's largest violation of an active constraint [m] or [rad]; it is 0 inside the constraints, or if they
    are not enforced. In addition to the ports of all guidance there are ``state``, ``transition_distance``,
    ``progress`` and ``measured_violation``, all (1,), and ``state_max_wrench`` (8,), the limits of force and torque of
    the state; connect it to the station's ``max_wrench`` if the template has such limits. The optional input
    ``frame_poses`` (6·k,) has the poses of the template's k frames, for objects that move; it is the one source of all
    subsystems.
    """

    def __init__(
        self,
        template: SharedControlTemplate,
        frames: Mapping[str, RigidTransform],
        period: float,
        *,
        input_mapping: SharedControlTemplate | None = None,
        active_constraints: bool = True,
        max_tracking_error: float = np.inf,
    ):
        """Construct the guidance.

        Args:
            template: Shared control template.
            frames: Poses X_WF of the template's objects by name; W is the frame of all poses.
            period: Control period [s].
            input_mapping: Second template, whose initial state maps the inputs instead of `template`. The active
                constraints of `template` are then a safety filter, for example of an end-effector velocity.
            active_constraints: True to enforce the active constraints; False to command the requested pose.
            max_tracking_error: Distance between robot and command beyond which the last command is repeated, unless the
                new one is closer to the robot [m].
        """
        super().__init__()
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(period, (input_mapping or template).inputs))
        self._mapping = SctInputMapping(input_mapping or template, frames, period)
        add_system(builder, "input_mapping", self._mapping, action=hold.get_output_port())
        constrained = template if active_constraints else template.without_active_constraints()
        self._filter = ActiveConstraintFilter(constrained, frames, period, max_tracking_error)
        requested_pose = self._mapping.get_requested_pose_output_port()
        add_system(builder, "active_constraints", self._filter, requested_pose=requested_pose)
        if input_mapping is None:
            state = self._filter.GetOutputPort("state")
        else:
            initial_state = ConstantVectorSource([float(input_mapping.initial_state)])
            state = builder.AddNamedSystem("state", initial_state).get_output_port()
        builder.Connect(state, self._mapping.get_state_input_port())
        builder.Connect(self._filter.GetOutputPort("last_desired_pose"), self._mapping.get_pose_input_port())
        self._filter.export_ports(builder, hold)
        if self._mapping.frames.names and self._mapping.frames.names == template.frames:
            builder.ConnectInput("frame_poses", self._mapping.get_frame_poses_input_port())
        builder.BuildInto(self)

    def set_frames(self, root_context: Context, frames: Mapping[str, RigidTransform]) -> None:
        """Set the poses of the named objects in the root context; other poses do not change."""
        self._filter.set_frames(root_context, frames)
        mapped = {name: X_WF for name, X_WF in frames.items() if name in self._mapping.frames.names}
        self._mapping.frames.set(self._mapping.GetMyMutableContextFromRoot(root_context), mapped)


class ResidualDescent(Guidance):
    """Residual RL without demonstrations: p̂_t = p_t + Δp_t, where p_t is a straight descent.

    ``action`` is (3,); the command also respects the template's speed limits. In addition to the ports of all guidance
    there are ``state``, ``transition_distance``, ``progress`` and ``measured_violation``, all (1,).
    """

    def __init__(self, prior: PriorKnowledge):
        """Construct the guidance from an approach and the active constraints of a template.

        All poses are in the frame of the template's only object.
        """
        super().__init__()
        assert prior.template is not None
        assert prior.approach is not None
        placed, approach, period = prior.template, prior.approach, prior.period
        template = placed.template if placed.is_constrained(True) else placed.template.without_active_constraints()
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(period, 3))
        times = [0.0, (approach.heights[0] - approach.heights[1]) / approach.speed]
        corners = np.zeros((POSE_SIZE, 2))
        corners[2] = approach.heights
        line = builder.AddNamedSystem("descent", TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, corners)))
        # Without this hold, all systems after it would be computed again at every step of the plant.
        descent = add_system(builder, "descent_hold", ZeroOrderHold(period, POSE_SIZE), line.get_output_port())
        spread = add_system(builder, "spread", MatrixGain(D=np.eye(POSE_SIZE, 3)), hold.get_output_port())
        residual = Residual(np.array([approach.reach] * 3 + [0.0] * 3))
        add_system(builder, "residual", residual, reference=descent.get_output_port(), action=spread.get_output_port())
        constraints = ActiveConstraintFilter(template, placed.frames, period)
        requested_pose = residual.get_desired_pose_output_port()
        add_system(builder, "active_constraints", constraints, requested_pose=requested_pose)
        constraints.export_ports(builder, hold)
        builder.BuildInto(self)


def _build_sct(
    prior: PriorKnowledge, input_mapping: SharedControlTemplate | None, *, is_constrained_by_default: bool
) -> SctGuidance:
    placed = prior.template
    assert placed is not None
    is_constrained = placed.is_constrained(is_constrained_by_default)
    return SctGuidance(
        placed.template,
        placed.frames,
        prior.period,
        input_mapping=input_mapping,
        active_constraints=is_constrained,
        max_tracking_error=placed.max_tracking_error if is_constrained else np.inf,
    )


@register_guidance("sct", needs=(("template",),), label="RL-SCT", color="#9467bd")
def sct(prior: PriorKnowledge) -> SctGuidance:
    """Build RL-SCT: the template maps a few inputs to a pose and applies its active constraints."""
    return _build_sct(prior, None, is_constrained_by_default=True)


@register_guidance("none", needs=(("template",),), label="RL", color="#7f7f7f")
def unguided(prior: PriorKnowledge) -> SctGuidance:
    """Build unguided RL: six inputs are the end effector's velocity, and the template only provides its state."""
    return _build_sct(prior, load_template("end_effector_velocity"), is_constrained_by_default=False)
