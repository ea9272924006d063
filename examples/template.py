"""Use a shared control template alone: its guidance diagram commands an end effector, here with constant inputs."""

import numpy as np
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail import load_template
from guiderail.diagrams.guidance.sct import SctGuidance
from guiderail.models.common.transforms import transform_to_pose

PERIOD = 0.02
template = load_template("pouring", mug_radius_m=0.05)  # wider mug than in the template file
guidance = SctGuidance(template, {"mug_tip": RigidTransform([0.6, 0.0, 0.3])}, PERIOD)

builder = DiagramBuilder()
builder.AddNamedSystem("guidance", guidance)
start = transform_to_pose(RigidTransform([0.6, -0.3, 0.45]))
inputs = {"action": [0.0, 1.0, -1.0], "pose": start, "wrench": np.zeros(6)}  # action towards the mug and down
for name, value in inputs.items():
    source = builder.AddNamedSystem(name, ConstantVectorSource(np.array(value)))
    builder.Connect(source.get_output_port(), guidance.GetInputPort(name))
diagram = builder.Build()

simulator = Simulator(diagram)
context = guidance.GetMyContextFromRoot(simulator.get_context())
for seconds in (0.5, 1.0, 2.0):
    simulator.AdvanceTo(seconds)
    state = template.states[int(guidance.GetOutputPort("state").Eval(context)[0])].name
    height = guidance.get_desired_pose_output_port().Eval(context)[2] - 0.3
    print(f"after {seconds} s: state {state}, {100 * height:.1f} cm above the mug")
