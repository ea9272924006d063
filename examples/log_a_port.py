"""Log a signal: any port of an environment's diagram can be evaluated at any time."""

import numpy as np

from guiderail import make_env

env = make_env("GridClamp", guidance="sct", action_repeat=5)
diagram, simulator = env.diagram.diagram, env.simulator
print("systems:", ", ".join(system.get_name() for system in diagram.GetSystems()))

guidance = diagram.GetSubsystemByName("guidance")
mapping = guidance.GetSubsystemByName("input_mapping")
print("systems of the guidance:", ", ".join(system.get_name() for system in guidance.GetSystems()))
env.reset(seed=0)
requested: list[float] = []
commanded: list[float] = []


def record(root_context):
    """Record the requested and the commanded x [m]; called after every step of the simulator."""
    requested.append(mapping.get_requested_pose_output_port().Eval(mapping.GetMyContextFromRoot(root_context))[0])
    commanded.append(guidance.get_desired_pose_output_port().Eval(guidance.GetMyContextFromRoot(root_context))[0])


simulator.set_monitor(record)
for _ in range(10):
    env.step(np.array([1.0, 0.0, 0.0]))  # in x, beyond the template's cuboid
simulator.clear_monitor()
print(f"{len(requested)} samples, largest x: {1000 * max(requested):.1f} mm requested", end=", ")
print(f"{1000 * max(commanded):.1f} mm commanded")
