"""Guidance by the weights of a movement primitive, the actions of episodic reinforcement learning (PPT)."""

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem
from pydrake.systems.primitives import ZeroOrderHold

from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.primitive import RESIDUAL, PrimitiveGuidance, primitive_config_of
from guiderail.diagrams.guidance.prior import PriorKnowledge
from guiderail.diagrams.guidance.registry import register_guidance
from guiderail.models.common.arrays import as_whole
from guiderail.systems.support import declarations as declare
from guiderail.systems.support.declarations import input_getter, output_getter
from guiderail_data.promp import basis

NUM_BASIS = 5  # weights of each output


class WeightedBasis(LeafSystem):
    """Compute the displacement Σ_k φ_k(s) w_k of a motion at the phase s, with the basis functions of `ProMp`.

    ``weights`` is (A·K,), the K weights of the first output, then those of the second, … in [−1, 1], and
    ``displacement`` (A,). The basis functions sum to 1, so that a displacement is in [−1, 1], too. The phase grows from
    0 to 1 in the steps of the motion.

    Args:
        num_outputs: Number A of outputs.
        num_steps: Number of control steps of the motion, at least 2.
        period: Control period [s], positive.
        num_basis: Number K of basis functions, at least 2.

    Raises:
        InputError: If a number or the period is out of range.
    """

    def __init__(self, num_outputs: int, num_steps: int, period: float, num_basis: int = NUM_BASIS):
        super().__init__()
        num_basis = as_whole(num_basis, "num_basis", 2, as_whole(num_steps, "num_steps", 2))
        self._shape, self._period = (num_outputs, num_basis), period
        self._basis = basis(np.linspace(0.0, 1.0, num_steps), num_basis)
        self._weights_port = self.DeclareVectorInputPort("weights", num_outputs * num_basis)
        self._step = self.DeclareDiscreteState(1)
        declare.update(self, period, self._set_step, self._set_step)
        declare.output(self, "displacement", num_outputs, self._displacement, [self._weights_port, self._step])

    get_weights_input_port = input_getter("weights", "weights of the basis functions, (A·K,)")
    get_displacement_output_port = output_getter("displacement", "displacement of the motion, (A,)")

    def _set_step(self, context: Context, discrete_state: DiscreteValues) -> None:
        discrete_state.set_value(self._step, [round(context.get_time() / self._period)])

    def _displacement(self, context: Context) -> np.ndarray:
        step = int(context.get_discrete_state().value(self._step).item())
        weights = self._weights_port.Eval(context).reshape(self._shape)
        return weights @ self._basis[min(step, len(self._basis) - 1)]


@register_guidance(
    "promp", needs=(("demonstrations",),), label="weights of a ProMP", color="#8c6d31", demonstrates=True
)
class PrompGuidance(Guidance):
    """Guidance by weights: residual RL whose action (A·K,) displaces the whole demonstrated motion.

    With `action_repeat` as long as an episode, the policy acts once in an episode, as in reinforcement learning with
    ProMPs and PPO (PPT; Huang et al., 2025). Its energy tank is part of each station with a bounded impedance.
    """

    def __init__(self, prior: PriorKnowledge):
        """Construct the guidance from prior knowledge with demonstrations."""
        super().__init__()
        config, builder = primitive_config_of(prior), DiagramBuilder()
        residual = builder.AddNamedSystem("residual", PrimitiveGuidance(prior, **RESIDUAL))
        motion = WeightedBasis(config.num_actions, config.reference.num_steps, config.control_period)
        builder.AddNamedSystem("weighted_basis", motion)
        held = builder.AddNamedSystem(
            "held_action", ZeroOrderHold(config.control_period, motion.get_weights_input_port().size())
        )
        builder.ExportInput(motion.get_weights_input_port(), "action")
        builder.ConnectInput("action", held.get_input_port())
        builder.Connect(motion.get_displacement_output_port(), residual.get_action_input_port())
        builder.ExportInput(residual.get_pose_input_port(), "pose")
        builder.ExportInput(residual.get_wrench_input_port(), "wrench")
        builder.ExportOutput(held.get_output_port(), "held_action")
        for name in ("desired_pose", "constraint_violation", "fallback"):
            builder.ExportOutput(residual.GetOutputPort(name), name)
        builder.BuildInto(self)
