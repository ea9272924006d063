"""Replace the controller of a task: write a station, here a point robot of 0.1 kg on soft springs, without walls."""

import numpy as np
from pydrake.multibody.tree import PdControllerGains, PrismaticJoint, SpatialInertia

import guiderail as gr


@gr.register_station("soft_plane", workcell_kind="plane", time_unit=gr.round_period(0.005))
class SoftPlane(gr.JointStation):
    plant_step = gr.round_period(0.005)

    def add_robot(self, plant, passage):
        body, robot = plant.world_body(), plant.AddModelInstance("robot")
        for name, axis in (("x", [1.0, 0.0, 0.0]), ("y", [0.0, 1.0, 0.0])):
            child = plant.AddRigidBody(name, robot, SpatialInertia.SolidSphereWithMass(0.05, passage.robot_radius))
            joint = plant.AddJoint(PrismaticJoint(name, body.body_frame(), child.body_frame(), axis))
            plant.AddJointActuator(name, joint, 50.0).set_controller_gains(PdControllerGains(p=40.0, d=4.0))
            body = child
        return robot


env = gr.make_env("NarrowPassage", guidance="skgrl", station="soft_plane", action_repeat=5)
gr.rollout(env, lambda observation: np.zeros(2), seed=0)
print("largest lag behind the command:", np.abs(env.trace.commanded - env.trace.measured).max().round(4), "m")
