"""A straight descent with a policy's residual, behind a skill's active constraints."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import MatrixGain, PassThrough, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.guidance.active_constraint_filter import ActiveConstraintFilter
from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.known import Known
from guiderail.models.pose_coordinates import POSE_SIZE, WRENCH_SIZE
from guiderail.systems.residual import Residual


class ResidualDescent(Guidance):
    """Residual learning without demonstrations: p̂_t = p_t + Δp_t, where p_t comes straight down.

    ``action`` is (3,); what is commanded also keeps the skill's greatest speeds. Exports ``measured_violation`` too.
    """

    def __init__(self, known: Known):
        """
        Args:
            known: its approach, and a template whose active constraints are kept; that one has one object's frame, in
                which poses are given.
        """
        super().__init__()
        assert known.template is not None
        assert known.approach is not None
        template, approach, period = known.template, known.approach, known.period
        skill = template.skill if template.constrained(True) else template.skill.without_active_constraints()
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(period, 3))
        times = [0.0, (approach.heights[0] - approach.heights[1]) / approach.speed]
        corners = np.zeros((POSE_SIZE, 2))
        corners[2] = approach.heights
        line = builder.AddNamedSystem("descent", TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, corners)))
        # Held: otherwise everything behind it would be computed anew at every step of the plant.
        held = builder.AddNamedSystem("descent_hold", ZeroOrderHold(period, POSE_SIZE))
        spread = builder.AddNamedSystem("spread", MatrixGain(D=np.eye(POSE_SIZE, 3)))
        residual = builder.AddNamedSystem("residual", Residual(np.array([approach.reach] * 3 + [0.0] * 3)))
        constraints = ActiveConstraintFilter(skill, template.frames, period)
        builder.AddNamedSystem("active_constraints", constraints)
        wrench = builder.AddNamedSystem("wrench", PassThrough(WRENCH_SIZE))
        builder.Connect(line.get_output_port(), held.get_input_port())
        builder.Connect(held.get_output_port(), residual.get_reference_input_port())
        builder.Connect(hold.get_output_port(), spread.get_input_port())
        builder.Connect(spread.get_output_port(), residual.get_action_input_port())
        builder.Connect(residual.get_desired_pose_output_port(), constraints.GetInputPort("requested_pose"))
        builder.ExportInput(hold.get_input_port(), "action")
        builder.ExportInput(constraints.GetInputPort("pose"), "pose")
        builder.ExportInput(wrench.get_input_port(), "wrench")
        builder.ExportOutput(hold.get_output_port(), "held_action")
        constraints.export_outputs(builder)
        builder.BuildInto(self)
