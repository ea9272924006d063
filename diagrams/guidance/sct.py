"""Guidance by a shared control template: a person's or a policy's few inputs in, a safe pose out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, PassThrough, ZeroOrderHold

from guiderail.diagrams.guidance.active_constraint_filter import ActiveConstraintFilter
from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.known import Known
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.models.pose_coordinates import WRENCH_SIZE
from guiderail.models.skills import Skill, load_skill
from guiderail.systems.sct_input_mapping import SctInputMapping


class SctGuidance(Guidance):
    """Shared control: input mapping, then active constraints, in the state that the state machine is in.

    ``action`` is (n,), whoever gives it: a policy, or a person's device. ``constraint_violation`` is the larger of
    metres and radians from the projection, 0 inside. Beside the ports of all guidance it exports ``state``,
    ``transition_distance``, ``progress`` and ``measured_violation``, all (1,).
    """

    def __init__(
        self,
        skill: Skill,
        frames: Mapping[str, RigidTransform],
        period: float,
        *,
        input_mapping: Skill | None = None,
        active_constraints: bool = True,
        leash: float = np.inf,
    ):
        """
        Args:
            skill: the template.
            frames: the poses X_WF of its objects by name; W is the frame that all poses are given in.
            period: seconds between control steps.
            input_mapping: a skill whose initial state maps the inputs, instead of the template's own mappings: so its
                active constraints are a safety filter behind, for one, a plain end-effector velocity.
            active_constraints: False leaves the constraints out, and what was requested is commanded.
            leash: [m] how far the robot may be from its command before that waits.
        """
        super().__init__()
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(period, (input_mapping or skill).inputs))
        self._mapping = SctInputMapping(input_mapping or skill, frames, period)
        builder.AddNamedSystem("input_mapping", self._mapping)
        constrained = skill if active_constraints else skill.without_active_constraints()
        self._filter = ActiveConstraintFilter(constrained, frames, period, leash)
        builder.AddNamedSystem("active_constraints", self._filter)
        if input_mapping is None:
            state = self._filter.GetOutputPort("state")
        else:
            free = np.array([float(input_mapping.initial_state)])
            source = builder.AddNamedSystem("state", ConstantVectorSource(free))
            state = source.get_output_port()
        builder.Connect(hold.get_output_port(), self._mapping.get_action_input_port())
        builder.Connect(state, self._mapping.get_state_input_port())
        builder.Connect(self._filter.GetOutputPort("last_desired_pose"), self._mapping.get_pose_input_port())
        builder.Connect(self._mapping.get_requested_pose_output_port(), self._filter.GetInputPort("requested_pose"))

        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(self._filter.GetInputPort("pose"), "pose")
        # No template of ours listens to forces yet; the port is there because all guidance has the same ports.
        wrench = builder.AddNamedSystem("wrench", PassThrough(WRENCH_SIZE))
        builder.ExportInput(wrench.get_input_port(), "wrench")
        self._filter.export_outputs(builder)
        builder.ExportOutput(hold.get_output_port(), "held_action")
        builder.BuildInto(self)

    def set_frames(self, root_context: Context, frames: Mapping[str, RigidTransform]) -> None:
        """Moves objects; those that aren't named stay. The context is the root diagram's."""
        self._filter.set_frames(root_context, frames)
        known = {name: X_WF for name, X_WF in frames.items() if name in self._mapping.frames.names}
        self._mapping.frames.set(self._mapping.GetMyMutableContextFromRoot(root_context), known)


def _through_template(known: Known, input_mapping: Skill | None, constrained: bool) -> SctGuidance:
    assert known.template is not None
    template = known.template
    return SctGuidance(
        template.skill,
        template.frames,
        known.period,
        input_mapping=input_mapping,
        active_constraints=constrained,
        leash=template.leash if constrained else np.inf,
    )


@register_guidance("sct", needs=(("template",),), label="RL-SCT", colour="#9467bd")
def sct(known: Known) -> SctGuidance:
    """A few inputs through the template, its active constraints behind them."""
    assert known.template is not None
    return _through_template(known, None, known.template.constrained(True))


@register_guidance("none", needs=(("template",),), label="RL", colour="#7f7f7f")
def unguided(known: Known) -> SctGuidance:
    """Six inputs as the end effector's velocity; the template says only how far it is, unless it is to constrain."""
    assert known.template is not None
    return _through_template(known, load_skill("end_effector_velocity"), known.template.constrained(False))
