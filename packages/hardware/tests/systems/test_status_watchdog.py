"""Status watchdog as a system: ports and clock; `tests/models/test_state_estimator.py` tests the estimator."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import FixedOffsetFrame, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail_hardware.models.joint_dynamics import JointDynamics
from guiderail_hardware.models.joint_status import Fault, JointStatus, StatusLimits
from guiderail_hardware.systems.status_watchdog import StatusWatchdog

PERIOD = 1.0 / 256.0
LIMITS = StatusLimits(velocity=(1.0, 1.0))
TOLERANCE = (1.0, 0.5)
CLOCK = 1000.0  # robot time at local time zero [s]
SETTLING_STEPS = round(LIMITS.settling_time / PERIOD) + 3


@pytest.fixture(scope="module")
def plant():
    plant = MultibodyPlant(0.0)
    parent = plant.world_body()
    for number in range(2):
        inertia = SpatialInertia(1.0, [0.2, 0.0, 0.0], UnitInertia(0.5, 0.6, 0.7))
        body = plant.AddRigidBody(f"link{number}", inertia)
        end = plant.AddFrame(FixedOffsetFrame(f"end{number}", parent.body_frame(), RigidTransform([0.4, 0.0, 0.0])))
        joint = RevoluteJoint(f"joint{number}", end, body.body_frame(), [0.0, 0.0, 1.0], damping=0.5)
        plant.AddJoint(joint)
        parent = body
    plant.Finalize()
    return plant


class Rig:
    """Watchdog of a robot that moves at constant speed and sends a status just before each check."""

    def __init__(self, plant, has_clock=False):
        self.system = StatusWatchdog(plant, LIMITS, TOLERANCE, period=PERIOD)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.port = self.system.get_status_input_port().FixValue(self.context, Value[object]())
        self.dynamics, self.plant, self.plant_context = JointDynamics(plant), plant, plant.CreateDefaultContext()
        self.torque = self.system.get_torque_input_port().FixValue(self.context, np.zeros(2))
        self.step, self.wall, self.has_clock = 0, 5000.0, has_clock
        self.simulator.Initialize()

    def status(self, **changes):
        """Return the status at this step with changed fields. Velocities vary by rounding, so they are not frozen."""
        time = self.step * PERIOD
        velocities = np.array([0.1, 0.2]) + 1e-12 * (-1) ** self.step
        return replace(
            JointStatus(CLOCK + time, 0.3 + 0.1 * time * np.array([1, 2]), velocities, np.zeros(2)), **changes
        )

    def set(self, status, gap=PERIOD):
        """Set the newest status, the clock and the torque of constant speed; return the fault."""
        self.wall += gap
        self.port.GetMutableData().set_value(status or object())
        if self.has_clock:
            self.system.get_clock_input_port().FixValue(self.context, [self.wall])
        self.plant.SetPositionsAndVelocities(self.plant_context, self.status().values()[:4])
        self.torque.GetMutableData().set_value(self.dynamics.evaluate(self.plant_context)[1])
        return self.fault

    def check(self, status, gap=PERIOD):
        """Set the newest status, return the fault, and advance to the next check."""
        fault = self.set(status, gap)
        self.step += 1
        self.simulator.AdvanceTo(self.step * PERIOD)
        return fault

    def settle(self):
        """Run checks until no fault is reported."""
        for _ in range(SETTLING_STEPS):
            self.check(self.status())
        assert self.fault == Fault.NONE
        return self

    def __getitem__(self, port):
        return self.system.GetOutputPort(port).Eval(self.context).copy()

    @property
    def fault(self):
        return Fault(int(self["fault"][0]))


def test_valid_status_is_output_at_once(plant):
    rig = Rig(plant).settle()
    status = rig.status(external_torque=np.array([0.1, 0.2]))
    assert rig.set(status) == Fault.NONE
    np.testing.assert_array_equal(rig["estimated_state"], status.values()[:4])
    np.testing.assert_array_equal(rig["external_torque"], [0.1, 0.2])
    np.testing.assert_allclose(rig["velocity"], [0.1, 0.2], atol=1e-6)
    assert rig["age"][0] == pytest.approx(0.0, abs=1e-9)


def test_missing_status_is_a_fault(plant):
    rig = Rig(plant)
    assert rig.check(None) == Fault.NO_STATUS
    np.testing.assert_array_equal(rig["estimated_state"], 0.0)
    np.testing.assert_array_equal(rig["velocity"], 0.0)


def test_faulty_status_is_not_output(plant):
    rig = Rig(plant).settle()
    rig.check(rig.status())
    before = rig["estimated_state"]
    assert rig.set(rig.status(positions=np.array([9.0, 9.0]))) == Fault.POSITION_JUMP
    np.testing.assert_array_equal(rig["estimated_state"], before)


@pytest.mark.parametrize("is_sent", [True, False])
def test_velocity_is_predicted_from_the_torque(plant, is_sent):
    """The prediction uses the inertia at the accepted positions and the damping of the joints."""
    rig = Rig(plant).settle()
    rig.set(rig.status())
    rig.torque.GetMutableData().set_value([1.0, -0.5])
    rig.step += 1
    rig.simulator.AdvanceTo(rig.step * PERIOD)
    if not is_sent:
        rig.system.forget_torque(rig.context)
    rig.plant.SetPositionsAndVelocities(rig.plant_context, rig["estimated_state"])
    M, drag = rig.dynamics.evaluate(rig.plant_context)
    rig.port.GetMutableData().set_value(object())
    expected = np.array([0.1, 0.2]) + PERIOD * np.linalg.solve(M, is_sent * np.array([1.0, -0.5]) - drag)
    np.testing.assert_allclose(rig["velocity"], expected, rtol=1e-6)


def test_dynamics_are_those_of_the_plant(plant):
    context = plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, [0.3, -0.4, 0.5, -0.6])
    M, drag = JointDynamics(plant).evaluate(context)
    np.testing.assert_array_equal(M, plant.CalcMassMatrix(context))
    np.testing.assert_allclose(drag, plant.CalcBiasTerm(context) + [0.25, -0.3])


def test_delay_of_this_program_is_no_fault_with_a_clock(plant):
    rig = Rig(plant, has_clock=True).settle()
    for gap in (3, 1, 4):
        rig.step += gap - 1
        assert rig.set(rig.status(), gap * PERIOD) == Fault.NONE
        assert rig["age"][0] <= PERIOD
        rig.step += 1
        rig.simulator.AdvanceTo(rig.context.get_time() + PERIOD)


def test_long_delay_of_this_program_is_a_missed_deadline(plant):
    rig = Rig(plant, has_clock=True).settle()
    rig.step += 51
    assert rig.set(rig.status(), 52 * PERIOD) == Fault.DEADLINE_MISSED


def test_unchanged_clock_input_is_ignored(plant):
    rig = Rig(plant, has_clock=True).settle()
    rig.check(rig.status())
    rig.simulator.AdvancePendingEvents()
    rig.port.GetMutableData().set_value(rig.status(time=rig.status().time + 0.9 * LIMITS.max_lead))
    assert rig.fault == Fault.NONE  # with the clock input, this status would be from the future


def test_infinite_clock_input_is_ignored(plant):
    rig = Rig(plant, has_clock=True).settle()
    rig.wall = np.inf
    assert rig.check(rig.status()) == Fault.NONE


@pytest.mark.parametrize("has_clock", [False, True])
def test_initialization_keeps_the_state(plant, has_clock):
    """The robot is unchanged by an initialization, and damping needs its velocity."""
    rig = Rig(plant, has_clock=has_clock).settle()
    outputs = {name: rig[name].copy() for name in ("estimated_state", "velocity", "external_torque", "fault", "age")}
    assert rig["velocity"].any()
    rig.simulator.Initialize()
    for name, value in outputs.items():
        np.testing.assert_array_equal(rig[name], value)
    for _ in range(3):
        assert rig.check(rig.status()) == Fault.NONE


def test_ports_have_their_documented_sizes(plant):
    system = StatusWatchdog(plant, LIMITS, TOLERANCE, period=PERIOD)
    outputs = [system.get_output_port(i) for i in range(system.num_output_ports())]
    sizes = {"estimated_state": 4, "velocity": 2, "external_torque": 2, "fault": 1, "age": 1, "reported_speed": 1}
    assert {port.get_name(): port.size() for port in outputs} == sizes
    assert (system.get_torque_input_port().size(), system.get_clock_input_port().size()) == (2, 1)
    torque = system.get_torque_input_port().get_index()
    assert not any(system.HasDirectFeedthrough(torque, port.get_index()) for port in outputs)


def test_constructor_refuses_arguments_out_of_range(plant):
    for limits, tolerance, period in (
        (LIMITS, TOLERANCE, 0.0),
        (StatusLimits((1.0,) * 3), (1.0,) * 3, PERIOD),
        (LIMITS, (1.0,), PERIOD),
    ):
        with pytest.raises(InputError):
            StatusWatchdog(plant, limits, tolerance, period=period)
