"""A straight descent with a policy's residual, behind a skill's active constraints."""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.framework import Diagram, DiagramBuilder
from pydrake.systems.primitives import MatrixGain, PassThrough, TrajectorySource, ZeroOrderHold
from pydrake.trajectories import PiecewisePolynomial

from guiderail.diagrams.guidance.sct import WRENCH_SIZE, ActiveConstraintFilter
from guiderail.models.skills import Skill
from guiderail.systems.residual import Residual

POSE_SIZE = 6


class ResidualDescent(Diagram):
    """Residual learning without demonstrations: p̂_t = p_t + Δp_t, where p_t comes straight down.

    .. pydrake_system::

        name: ResidualDescent
        input_ports:
        - action
        - pose
        - wrench
        output_ports:
        - desired_pose
        - fallback
        - commanded_violation
        - measured_violation
        - held_action

    ``action`` is (3,) in [−1, 1], held for a control period; what is commanded also keeps the skill's greatest speeds.
    """

    def __init__(
        self, skill: Skill, frame: str, heights: tuple[float, float], speed: float, reach: float, period: float
    ):
        """
        Args:
            skill: its active constraints are kept; it has one object's frame, in which poses are given.
            frame: the name of that frame.
            heights: where the descent begins and ends [m].
            speed: of the descent [m/s].
            reach: how far a full action moves the command along each axis [m].
            period: seconds between control steps.
        """
        super().__init__()
        builder = DiagramBuilder()
        hold = builder.AddNamedSystem("action_hold", ZeroOrderHold(period, 3))
        times = [0.0, (heights[0] - heights[1]) / speed]
        corners = np.zeros((POSE_SIZE, 2))
        corners[2] = heights
        line = builder.AddNamedSystem("descent", TrajectorySource(PiecewisePolynomial.FirstOrderHold(times, corners)))
        # Held: otherwise everything behind it would be computed anew at every step of the plant.
        held = builder.AddNamedSystem("descent_hold", ZeroOrderHold(period, POSE_SIZE))
        spread = builder.AddNamedSystem("spread", MatrixGain(D=np.eye(POSE_SIZE, 3)))
        residual = builder.AddNamedSystem("residual", Residual(np.array([reach] * 3 + [0.0] * 3)))
        constraints = ActiveConstraintFilter(skill, {frame: RigidTransform()}, period)
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
        for name in ("desired_pose", "fallback", "commanded_violation", "measured_violation"):
            builder.ExportOutput(constraints.GetOutputPort(name), name)
        builder.ExportOutput(hold.get_output_port(), "held_action")
        builder.BuildInto(self)
