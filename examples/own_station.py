"""Replace the controller of a task: write a station, which is the diagram of plant and controller."""

import numpy as np
from pydrake.multibody.tree import PdControllerGains, PrismaticJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder

import guiderail as gr
from guiderail.diagrams.stations.station import add_plant, add_position_ports


@gr.register_station("soft_plane", workcell_kind="plane", time_unit=gr.round_period(0.005))
class SoftPlane(gr.Station):
    """Point robot of 0.1 kg on two soft springs with dampers, without walls."""

    def __init__(self, passage):
        super().__init__()
        builder = DiagramBuilder()
        self.plant, self.scene_graph = plant, _ = add_plant(builder, gr.round_period(0.005))
        body, robot = plant.world_body(), plant.AddModelInstance("robot")
        for name, axis in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 1.0, 0.0])):
            child = plant.AddRigidBody(name, robot, SpatialInertia.SolidSphereWithMass(0.05, passage.robot_radius))
            joint = plant.AddJoint(PrismaticJoint(name, body.body_frame(), child.body_frame(), axis))
            plant.AddJointActuator(name, joint, 50.0).set_controller_gains(PdControllerGains(p=40.0, d=4.0))
            body = child
        plant.Finalize()
        desired_pose, pose = add_position_ports(builder, plant, robot)
        self.finish(builder, desired_pose, pose=pose)


env = gr.make_env("NarrowPassage", guidance="skgrl", station="soft_plane", action_repeat=5)
gr.rollout(env, lambda observation: np.zeros(2), seed=0)
print("largest lag behind the command:", np.abs(env.trace.commanded - env.trace.measured).max().round(4), "m")
