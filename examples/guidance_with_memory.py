"""Write guidance with memory, as discrete state of a system, which a reset of the environment initializes.

This guidance adds each action to its last command, not to the measured pose.
"""

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, PassThrough, ZeroOrderHold

from guiderail import Guidance, PriorKnowledge, make_env, register_guidance
from guiderail.systems import ConstraintViolation

STEP = 0.01  # displacement by an action of 1 [m]


class CommandIntegrator(LeafSystem):
    """Command command[k] = command[k − 1] + STEP action[k], with the measured pose as the first command."""

    def __init__(self, known: PriorKnowledge):
        super().__init__()
        self.action = self.DeclareVectorInputPort("action", known.pose_size)
        self.pose = self.DeclareVectorInputPort("pose", known.pose_size)
        # The output depends only on the state: direct feedthrough would close an algebraic loop with the station.
        self.DeclareStateOutputPort("desired_pose", self.DeclareDiscreteState(known.pose_size))
        self.DeclareInitializationDiscreteUpdateEvent(self.start)
        self.DeclarePeriodicDiscreteUpdateEvent(known.period, 0.0, self.step)

    def start(self, context: Context, state: DiscreteValues) -> None:
        """Set the first command to the measured pose, so that the robot does not jump."""
        state.set_value(self.pose.Eval(context))

    def step(self, context: Context, state: DiscreteValues) -> None:
        state.set_value(context.get_discrete_state_vector().value() + STEP * self.action.Eval(context))


@register_guidance("command_integrator")
def command_integrator(known: PriorKnowledge) -> Guidance:
    guidance, builder = Guidance(), DiagramBuilder()
    command = builder.AddNamedSystem("command", CommandIntegrator(known))
    held = builder.AddNamedSystem("held_action", ZeroOrderHold(known.period, known.pose_size))
    check = builder.AddNamedSystem("violation", ConstraintViolation(known.constraints, known.period))
    builder.Connect(command.get_output_port(), check.get_pose_input_port())
    builder.ExportInput(command.GetInputPort("pose"), "pose")
    builder.ExportInput(command.GetInputPort("action"), "action")
    builder.ConnectInput("action", held.get_input_port())
    builder.ExportInput(builder.AddSystem(PassThrough(known.wrench_size)).get_input_port(), "wrench")  # unused
    builder.ExportOutput(command.get_output_port(), "desired_pose")
    builder.ExportOutput(held.get_output_port(), "held_action")
    builder.ExportOutput(check.get_violation_output_port(), "constraint_violation")
    builder.ExportOutput(builder.AddSystem(ConstantVectorSource([0.0])).get_output_port(), "fallback")
    builder.BuildInto(guidance)
    return guidance


env = make_env("NarrowPassage", guidance="command_integrator", action_repeat=5)
for episode in range(2):
    env.reset(seed=0)
    for _ in range(4):
        env.step(np.array([0.0, 0.5]))
    print("last command of episode", episode, env.trace.commanded[-1].round(3), "m")
