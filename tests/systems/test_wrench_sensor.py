"""Wrench sensor on a moving wrist, which measures only the external contact of the tool."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import ExternallyAppliedSpatialForce, MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.models.common.errors import InputError
from guiderail.systems.wrench_sensors import WrenchSensor

PERIOD = 0.001
R_WAXES = RotationMatrix(RollPitchYaw(0.3, -0.2, 0.9))


class SwingingTool:
    """Pendulum whose tool, two welded bodies, is fixed to the rod at the wrist; frame P on the tool is the center."""

    def __init__(self, time_constant=0.0, has_weight=True):
        builder = DiagramBuilder()
        self.plant = plant = builder.AddSystem(MultibodyPlant(PERIOD))
        plant.SetUseSampledOutputPorts(False)
        rod = plant.AddRigidBody("rod", SpatialInertia.SolidSphereWithMass(1.0, 0.1))
        self.joint = plant.AddJoint(RevoluteJoint("swing", plant.world_frame(), rod.body_frame(), [0.0, 1.0, 0.0]))
        self.tool = plant.AddRigidBody(
            "tool", SpatialInertia(0.7, [0.02, 0.01, -0.05], UnitInertia(0.01, 0.012, 0.008))
        )
        tip = plant.AddRigidBody("tip", SpatialInertia.SolidSphereWithMass(0.2, 0.03))
        plant.WeldFrames(
            self.tool.body_frame(), tip.body_frame(), RigidTransform(RollPitchYaw(1.0, 0.3, 0.2), [0.1, 0.0, -0.2])
        )
        X_ToolWrist = RigidTransform(RollPitchYaw(-0.2, 0.6, 0.3), [0.03, -0.02, 0.04])
        on_tool = plant.AddFrame(FixedOffsetFrame("wrist", self.tool.body_frame(), X_ToolWrist))
        wrist = plant.WeldFrames(
            rod.body_frame(), on_tool, RigidTransform(RollPitchYaw(0.4, 0.1, -0.3), [0.0, 0.1, -0.4])
        )
        plant.set_gravity_enabled(self.tool.model_instance(), has_weight)
        self.X_ToolP = RigidTransform(RollPitchYaw(0.2, 0.5, 0.1), [0.01, -0.03, -0.12])
        center = plant.AddFrame(FixedOffsetFrame("P", self.tool.body_frame(), self.X_ToolP))
        plant.Finalize()
        self.sensor = builder.AddSystem(
            WrenchSensor(plant, wrist, [self.tool, tip], center, R_WAXES, PERIOD, time_constant)
        )
        self.sensor.connect(builder, plant)
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.plant_context = plant.GetMyMutableContextFromRoot(self.context)
        self.center, self.wrist = center, wrist

    def push(self, force, torque):
        """Apply a force [N] and a torque [Nm] in world axes to the origin of P."""
        applied = ExternallyAppliedSpatialForce()
        applied.body_index = self.tool.index()
        applied.p_BoBq_B = self.X_ToolP.translation()
        applied.F_Bq_W = SpatialForce(tau=np.array(torque), f=np.array(force))
        self.plant.get_applied_spatial_force_input_port().FixValue(self.plant_context, Value([applied]))

    @property
    def wrench(self):
        return self.sensor.get_wrench_output_port().Eval(self.sensor.GetMyContextFromRoot(self.context)).copy()


@pytest.mark.parametrize("has_weight", [True, False])
def test_wrench_is_zero_when_the_tool_swings_freely(has_weight):
    """Weight, centripetal force and angular acceleration of the tool are compensated."""
    swinging = SwingingTool(has_weight=has_weight)
    swinging.joint.set_angle(swinging.plant_context, 1.0)
    swinging.joint.set_angular_rate(swinging.plant_context, 2.0)
    for step in range(1, 400, 40):
        swinging.simulator.AdvanceTo(step * PERIOD)
        np.testing.assert_allclose(swinging.wrench, np.zeros(6), atol=1e-9)


def test_wrench_is_the_applied_wrench_while_the_tool_swings():
    swinging = SwingingTool()
    swinging.joint.set_angle(swinging.plant_context, 0.5)
    force, torque = np.array([1.0, -2.0, 3.0]), np.array([0.1, 0.2, -0.3])
    swinging.push(force, torque)
    swinging.simulator.AdvanceTo(0.2)
    R = R_WAXES.matrix().T
    np.testing.assert_allclose(swinging.wrench, np.concatenate([R @ force, R @ torque]), atol=1e-9)


def test_filter_is_a_first_order_low_pass():
    """The response to a force step is 1 − e^(−t/τ)."""
    swinging = SwingingTool(time_constant=0.05)
    swinging.joint.Lock(swinging.plant_context)
    swinging.simulator.AdvanceTo(0.01)
    np.testing.assert_allclose(swinging.wrench, np.zeros(6), atol=1e-9)
    swinging.push([0.0, 0.0, 2.0], [0.0, 0.0, 0.0])
    swinging.simulator.AdvanceTo(0.06 + 0.5 * PERIOD)
    samples = 51  # at 10, 11, …, 60 ms
    expected = 2.0 * (1.0 - np.exp(-samples * PERIOD / 0.05))
    assert np.linalg.norm(swinging.wrench[:3]) == pytest.approx(expected, rel=1e-6)
    swinging.simulator.Initialize()
    np.testing.assert_array_equal(swinging.wrench, np.zeros(6))


def test_wrench_starts_at_zero_without_direct_feedthrough():
    swinging = SwingingTool()
    np.testing.assert_array_equal(swinging.wrench, np.zeros(6))
    assert not swinging.sensor.HasAnyDirectFeedthrough()
    names = [swinging.sensor.get_input_port(i).get_name() for i in range(swinging.sensor.num_input_ports())]
    assert names == ["reaction_forces", "body_poses", "body_spatial_velocities", "body_spatial_accelerations"]


@pytest.mark.parametrize(("period", "time_constant"), [(0.0, 0.1), (0.01, -1.0), (0.01, np.inf)])
def test_constructor_refuses_arguments_out_of_range(period, time_constant):
    swinging = SwingingTool()
    with pytest.raises(InputError):
        WrenchSensor(swinging.plant, swinging.wrist, [swinging.tool], swinging.center, R_WAXES, period, time_constant)


def test_constructor_refuses_a_body_that_is_not_at_the_wrist():
    swinging = SwingingTool()
    rod = swinging.plant.GetBodyByName("rod")
    with pytest.raises(InputError, match="child of"):
        WrenchSensor(swinging.plant, swinging.wrist, [rod], swinging.center, R_WAXES, PERIOD, 0.0)
