import numpy as np
import pytest
from pydrake.manipulation import SchunkWsgPositionController
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.models.common.errors import InputError
from guiderail.systems.gripper_command import GripperCommand

LOWER, UPPER, OPENING = np.array([0.0, -1.0]), np.array([0.04, 1.0]), np.array([0.03, 0.5])


class Rig:
    """Gripper command with a position input that may be unconnected."""

    def __init__(self):
        self.system = GripperCommand(LOWER, UPPER, OPENING, period=0.01)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()

    def command(self, position):
        self.system.get_position_input_port().FixValue(self.context, position)

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    @property
    def desired(self):
        return self.system.get_desired_state_output_port().Eval(self.context)


def test_initial_opening_is_output_when_input_is_unconnected():
    rig = Rig()
    rig.advance(0.1)
    np.testing.assert_array_equal(rig.desired, [0.03, 0.5, 0.0, 0.0])


def test_command_is_clipped_to_its_limits_and_output_at_once():
    rig = Rig()
    rig.command([0.01, 0.2])
    np.testing.assert_array_equal(rig.desired, [0.01, 0.2, 0.0, 0.0])
    rig.command([-5.0, 5.0])
    np.testing.assert_array_equal(rig.desired, [0.0, 1.0, 0.0, 0.0])


@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_last_position_is_output_when_a_command_is_not_finite(number):
    rig = Rig()
    rig.command([0.01, 0.2])
    rig.advance(0.05)
    rig.command([number, 0.4])
    for _ in range(3):
        np.testing.assert_array_equal(rig.desired, [0.01, 0.4, 0.0, 0.0])
        rig.advance(0.05)


@pytest.mark.parametrize("is_initialized", [False, True])
def test_reset_restores_the_initial_opening(is_initialized):
    rig = Rig()
    rig.command([0.01, 0.2])
    rig.advance(0.05)
    rig.command([np.nan, np.nan])
    if is_initialized:
        rig.context.SetTime(0.0)
        rig.simulator.Initialize()
    else:
        rig.system.SetDefaultContext(rig.context)
    np.testing.assert_array_equal(rig.desired, [0.03, 0.5, 0.0, 0.0])


@pytest.mark.parametrize(("limit", "outside"), [(LOWER, -np.inf), (UPPER, np.inf)])
@pytest.mark.parametrize("joint", [0, 1])
def test_opening_may_be_at_a_limit_but_not_beyond(limit, outside, joint):
    opening = OPENING.copy()
    opening[joint] = limit[joint]
    GripperCommand(LOWER, UPPER, opening, period=0.01)
    opening[joint] = np.nextafter(limit[joint], outside)
    with pytest.raises(InputError, match="opening must be within"):
        GripperCommand(LOWER, UPPER, opening, period=0.01)


def test_force_limit_is_the_last_valid_request():
    system = GripperCommand(LOWER, UPPER, OPENING, period=0.01, max_force=30.0)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()

    def force_limit(requested):
        system.get_requested_force_input_port().FixValue(context, [requested])
        value = float(system.get_force_limit_output_port().Eval(context)[0])
        simulator.AdvanceTo(context.get_time() + 0.02)
        return value

    assert float(system.get_force_limit_output_port().Eval(context)[0]) == 30.0  # not connected
    assert [force_limit(force) for force in (12.0, np.nan, -1.0, 50.0, 0.0, 5.0)] == [12.0, 12.0, 12.0, 30.0, 30.0, 5.0]
    for wrong in (0.0, np.inf, np.nan):
        with pytest.raises(InputError, match="max_force must be positive and finite"):
            GripperCommand(LOWER, UPPER, OPENING, period=0.01, max_force=wrong)


def test_command_moves_the_fingers_of_drakes_wsg_controller():
    """Two fingers on prismatic joints close on nothing, with the force limit that was requested."""
    builder = DiagramBuilder()
    command = builder.AddSystem(GripperCommand.for_wsg(period=0.05))
    controller = builder.AddSystem(SchunkWsgPositionController())
    plant = builder.AddSystem(two_fingers())
    builder.Connect(command.get_desired_position_output_port(), controller.get_desired_position_input_port())
    builder.Connect(command.get_force_limit_output_port(), controller.get_force_limit_input_port())
    builder.Connect(plant.get_state_output_port(), controller.get_state_input_port())
    builder.Connect(controller.get_generalized_force_output_port(), plant.get_actuation_input_port())
    builder.ExportInput(command.get_position_input_port(), "position")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    plant_context = plant.GetMyMutableContextFromRoot(context)

    def distance():
        left, right = plant.GetPositions(plant_context)
        return right - left

    plant.SetPositions(plant_context, [-0.03, 0.03])
    diagram.GetInputPort("position").FixValue(context, [0.02])
    simulator.AdvanceTo(2.0)
    assert distance() == pytest.approx(0.02, abs=1e-3)
    diagram.GetInputPort("position").FixValue(context, [1.0])  # beyond the opening
    simulator.AdvanceTo(4.0)
    assert distance() == pytest.approx(0.107, abs=1e-3)


def two_fingers():
    """Return a plant of two fingers that slide along x."""
    plant = MultibodyPlant(0.001)
    for name in ("left", "right"):
        body = plant.AddRigidBody(name, SpatialInertia.SolidSphereWithMass(0.05, 0.01))
        joint = plant.AddJoint(PrismaticJoint(name, plant.world_frame(), body.body_frame(), [1.0, 0.0, 0.0]))
        plant.AddJointActuator(name, joint)
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    return plant
