"""Adversarial poses against the joint limits of an arm: `python tests/harness/joint_adversary.py [STEPS [SEED]]`.

An iiwa under impedance control follows desired poses all around the workcell, in all orientations. A
`MotionConstraintFilter` with a `JointRange` filters the poses. Neither commanded nor simulated joint positions may
exceed a limit.
"""

import sys
import time
from dataclasses import dataclass

import numpy as np
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.command_checks import CommandFilter

START = np.array([0.0, 0.0, 0.1, 0.7, 0.0, 0.0])
REACH = np.array([0.5, 0.5, 0.4, 2.5, 0.8, 0.8])  # largest offsets of the desired poses from the start [m, rad]
MIN_HEIGHT = 0.05  # lower bound of the commanded height, above the fixture [m]
MARGIN = 0.2  # margin of commanded joint positions to the limits [rad]
SPEED = np.array([0.1, 0.1, 0.1, 0.3, 0.3, 0.3])  # largest commanded speed [m/s, rad/s]


@dataclass
class Result:
    """Statistics of the executed steps.

    Attributes:
        steps: Number of control steps.
        commanded: Largest excess of a commanded joint position over a limit reduced by the margin [rad].
        measured: Largest excess of a simulated joint position over a limit [rad]; negative within the limits.
        near: Number of commands within 0.01 rad of a limit reduced by the margin.
        fallbacks: Number of steps at which the filter intervened.
    """

    steps: int = 0
    commanded: float = -np.inf
    measured: float = -np.inf
    near: int = 0
    fallbacks: int = 0


def attack(steps: int, seed: int = 0, *, constrained: bool = True) -> Result:
    """Run `steps` control steps with or without the joint constraints; return the result."""
    rng, result, builder = np.random.default_rng(seed), Result(), DiagramBuilder()
    station = builder.AddNamedSystem("station", ArmStation(BncWorkcell()))
    joints = station.joint_range(MARGIN)
    linear = LinearConstraints(np.eye(6)[2:3], np.array([MIN_HEIGHT]))
    motion = MotionConstraints(linear, max_speed=SPEED, state=[joints] if constrained else [])
    system = CommandFilter(MotionConstraintFilter(motion, station.control_period), station.control_period)
    builder.AddNamedSystem("filter", system)
    builder.Connect(station.get_pose_output_port(), system.get_pose_input_port())
    builder.Connect(system.get_safe_pose_output_port(), station.get_desired_pose_input_port())
    builder.ExportInput(system.get_desired_pose_input_port(), "desired_pose")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    desired = diagram.GetInputPort("desired_pose").FixValue(context, START)
    station.set_pose(context, START)
    simulator.Initialize()
    plant, model = station.plant, station.arm.model
    model_joints = [plant.get_joint(i) for i in plant.GetJointIndices(model) if plant.get_joint(i).num_positions()]
    lower = np.concatenate([joint.position_lower_limits() for joint in model_joints])
    upper = np.concatenate([joint.position_upper_limits() for joint in model_joints])
    filter_context, plant_context = system.GetMyContextFromRoot(context), plant.GetMyContextFromRoot(context)
    for k in range(steps):
        if k % 200 == 0:
            desired.GetMutableData().set_value(START + REACH * rng.choice([-1.0, 1.0, rng.uniform(-1.0, 1.0)], 6))
        simulator.AdvanceTo((k + 1) * station.control_period)
        violation = joints.violation(system.get_safe_pose_output_port().Eval(filter_context))
        result.commanded = max(result.commanded, violation)
        result.near += violation > -0.01
        q = plant.GetPositions(plant_context, model)
        result.measured = max(result.measured, float(np.maximum(lower - q, q - upper).max()))
        result.fallbacks += system.get_intervention_output_port().Eval(filter_context)[0] > 0.0
        result.steps += 1
    return result


def main(steps: int = 20_000, seed: int = 0) -> int:
    start = time.perf_counter()
    result = attack(steps, seed)
    print(result, f"{time.perf_counter() - start:.0f} s")
    return int(result.commanded > 1e-9 or result.measured > 0.0)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
