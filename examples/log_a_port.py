"""Log a signal: any port of an environment's diagram can be evaluated at any time."""

import numpy as np

from guiderail import make_env

env = make_env("GridClamp", guidance="sct", action_repeat=5)
diagram, simulator = env.task.diagram, env.simulator
print("systems:", ", ".join(system.get_name() for system in diagram.GetSystems()))

guidance = diagram.GetSubsystemByName("guidance")
mapping = guidance.GetSubsystemByName("input_mapping")
print("in the guidance:", ", ".join(system.get_name() for system in guidance.GetSystems()))
env.reset(seed=0)
asked: list[float] = []
commanded: list[float] = []


def look(root_context):
    """Store the requested and the commanded position; called after every step of the simulator."""
    asked.append(mapping.get_requested_pose_output_port().Eval(mapping.GetMyContextFromRoot(root_context))[0])
    commanded.append(guidance.get_desired_pose_output_port().Eval(guidance.GetMyContextFromRoot(root_context))[0])


simulator.set_monitor(look)
for _ in range(10):
    env.step(np.array([1.0, 0.0, 0.0]))  # to the side, beyond the template's cuboid
simulator.clear_monitor()
print(
    f"{len(asked)} looks, to the side: {1000 * max(asked):.1f} mm asked for, {1000 * max(commanded):.1f} mm commanded"
)
