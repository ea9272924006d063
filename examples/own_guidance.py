"""Compose your own guidance: connect systems in a diagram that has the ports of guidance.

This guidance is KGRL with a single action, which displaces the motion along one direction.
"""

import numpy as np
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import MatrixGain, ZeroOrderHold

from guiderail import Options, PriorKnowledge, make_env, register_guidance
from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.primitive import PrimitiveGuidance


class AlongOptions(Options):
    """Options of the guidance, for `gymnasium.make` and `--env`."""

    angle: float = Field(0.0, ge=-180, le=180, description="angle of the direction in the plane [degrees]")


@register_guidance("kgrl_along", needs=(("demonstrations",),), label="KGRL along a line", options=AlongOptions)
class KgrlAlong(Guidance):
    """Guidance with an action (1,); its product with a direction (2,) is the action of KGRL."""

    def __init__(self, known: PriorKnowledge):
        super().__init__()
        builder = DiagramBuilder()
        angle = np.deg2rad(known.options["angle"])
        kgrl = builder.AddNamedSystem("kgrl", PrimitiveGuidance(known))
        direction = MatrixGain(D=np.array([[np.cos(angle)], [np.sin(angle)]]))
        builder.AddNamedSystem("direction", direction)
        held = builder.AddNamedSystem("held_action", ZeroOrderHold(known.period, 1))
        builder.ExportInput(direction.get_input_port(), "action")
        builder.ConnectInput("action", held.get_input_port())
        builder.Connect(direction.get_output_port(), kgrl.get_action_input_port())
        builder.ExportInput(kgrl.get_pose_input_port(), "pose")
        builder.ExportInput(kgrl.get_wrench_input_port(), "wrench")
        builder.ExportOutput(held.get_output_port(), "held_action")
        for name in ("desired_pose", "constraint_violation", "fallback"):
            builder.ExportOutput(kgrl.GetOutputPort(name), name)
        builder.BuildInto(self)


env = make_env("NarrowPassage", guidance="kgrl_along", angle=30.0)
env.reset(seed=0)
for _ in range(10):
    info = env.step(np.array([1.0]))[-1]
print("largest commanded violation of", info["control_steps"], "control steps:", info["constraint_violation"])
