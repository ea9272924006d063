"""Replace the controller of a task: write a station, which is the diagram of plant and controller."""

import numpy as np
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.controllers import PidController
from pydrake.systems.framework import Context, DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, MatrixGain, PassThrough

import guiderail as gr
from guiderail.models.objects.narrow_passage.geometry import PassageGeometry

PERIOD = gr.round_period(0.02)  # control period [s]; multiples of a rounded period are exact


@gr.register_station("soft_plane", workcell_kind="plane", time_unit=PERIOD / 10)
class SoftPlane(gr.Station):
    """Point robot of 0.1 kg with a soft PID controller, without walls."""

    control_period = PERIOD

    def __init__(self, passage: PassageGeometry):
        super().__init__()
        builder = DiagramBuilder()
        self.plant, self.scene_graph = plant, _ = AddMultibodyPlantSceneGraph(builder, PERIOD / 10)
        plant.SetUseSampledOutputPorts(False)  # output ports have the state after the step, not the sampled state
        body = plant.world_body()
        for name, axis in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 1.0, 0.0])):
            child = plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(0.05, passage.robot_radius))
            joint = PrismaticJoint(name, body.body_frame(), child.body_frame(), axis)
            plant.AddJointActuator(name, plant.AddJoint(joint), 50.0)
            body = child
        plant.Finalize()
        add, connect, state = builder.AddNamedSystem, builder.Connect, plant.get_state_output_port()
        desired = add("desired_state", MatrixGain(D=np.eye(4, 2)))  # at rest
        controller = add("controller", PidController([40.0, 40.0], [0.0, 0.0], [4.0, 4.0]))
        pose = add("pose", MatrixGain(D=np.eye(2, 4)))
        connect(desired.get_output_port(), controller.get_input_port_desired_state())
        connect(state, controller.get_input_port_estimated_state())
        connect(controller.get_output_port_control(), plant.get_actuation_input_port())
        connect(state, pose.get_input_port())
        builder.ExportInput(desired.get_input_port(), "desired_pose")
        builder.ExportInput(add("command_time", PassThrough(1)).get_input_port(), "command_time")  # unused
        builder.ExportOutput(pose.get_output_port(), "pose")
        for name, size in (("wrench", 2), ("contact_force", 1), ("saturation", 1), ("command_timed_out", 1)):
            builder.ExportOutput(add(name, ConstantVectorSource(np.zeros(size))).get_output_port(), name)
        builder.BuildInto(self)

    def set_pose(self, context: Context, pose: np.ndarray) -> None:
        """Put the robot at rest at `pose`, (2,)."""
        self.plant.SetPositionsAndVelocities(self.plant.GetMyMutableContextFromRoot(context), np.r_[pose, 0.0, 0.0])


for station in ("plane", "soft_plane"):
    env = gr.make_env("NarrowPassage", guidance="skgrl", station=station, action_repeat=5)
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.zeros(2))
    lag = np.linalg.norm(env.trace.commanded - env.trace.measured, axis=1).max()
    print(f"{station}: the robot lags behind the command by at most {1e3 * lag:.1f} mm")
