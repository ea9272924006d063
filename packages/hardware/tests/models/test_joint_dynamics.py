import numpy as np
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint, SpatialInertia

from guiderail_hardware.models.joint_dynamics import JointDynamics


def test_damping_acts_on_its_joint_in_any_order_of_declaration():
    plant = MultibodyPlant(0.0)
    upper, lower = (plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(1.0, 0.1)) for name in "ab")
    joints = [
        plant.AddJoint(RevoluteJoint("elbow", upper.body_frame(), lower.body_frame(), [0, 0, 1], damping=2.0)),
        plant.AddJoint(RevoluteJoint("base", plant.world_frame(), upper.body_frame(), [0, 0, 1], damping=1.0)),
    ]
    plant.Finalize()
    context = plant.CreateDefaultContext()
    for joint in joints:
        joint.set_angular_rate(context, 1.0)
    drag = JointDynamics(plant).evaluate(context)[1] - plant.CalcBiasTerm(context)
    np.testing.assert_allclose([drag[joint.velocity_start()] for joint in joints], [2.0, 1.0])
