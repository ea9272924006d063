"""Cartesian impedance: control law, physics of an arm in free space, limits and command timeout."""

from dataclasses import fields

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph, CoulombFriction, ExternallyAppliedSpatialForce
from pydrake.multibody.tree import JacobianWrtVariable, SpatialInertia
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.diagrams.stations.arm import add_arm, controller_model
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.control.cartesian_impedance import ArmImpedance, impedance_torques
from guiderail.models.control.wrench import WrenchBound
from guiderail.systems.cartesian_impedance_controller import CartesianImpedanceController, ImpedanceGains, Payload
from guiderail.systems.support.drake_multibody import orientation_error, pose_to_transform, transform_to_pose
from oracles.plants import six_axes

STIFFNESS = np.diag([1500.0, 1000.0, 800.0, 40.0, 30.0, 30.0])
LIMITS = np.array([40.0, 40.0, 40.0, 3.0, 3.0, 3.0])
POSTURES = [
    [0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0],
    [0.8, 0.3, -0.4, -1.8, 0.3, 0.9, 1.0],
    [-1.0, 0.9, 0.5, -0.9, -0.8, -0.7, -1.5],
    [2.0, -0.5, 0.2, 1.5, 0.4, -1.2, 0.3],
]
WORKCELL = BncWorkcell()


class FreeArm:
    """Simulated arm that is commanded to remain at its initial pose, and forces on its tool."""

    def __init__(self, q, *, gains=None, time_step=0.001, ball=False):
        builder = DiagramBuilder()
        self.plant, _ = AddMultibodyPlantSceneGraph(builder, time_step)
        self.arm = add_arm(self.plant, WORKCELL)
        if ball:
            model = self.plant.AddModelInstance("ball")
            self.ball = self.plant.AddRigidBody("ball", model, SpatialInertia.SolidSphereWithMass(2.0, 0.06))
            self.plant.RegisterCollisionGeometry(
                self.ball, RigidTransform(), Sphere(0.06), "ball", CoulombFriction(0.5, 0.5)
            )
        self.plant.Finalize()
        self.model, arm = controller_model(WORKCELL)
        self.tool_center, self.target = arm.tool_center, arm.target
        gains = gains or ImpedanceGains(STIFFNESS, LIMITS, np.array(q, dtype=float))
        self.controller = builder.AddSystem(
            CartesianImpedanceController(self.model, self.target, self.tool_center, gains, period=time_step)
        )
        builder.Connect(
            self.plant.get_state_output_port(self.arm.model), self.controller.get_estimated_state_input_port()
        )
        builder.Connect(
            self.controller.get_generalized_force_output_port(), self.plant.get_actuation_input_port(self.arm.model)
        )
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.plant_context = self.plant.GetMyMutableContextFromRoot(self.context)
        self.controller_context = self.controller.GetMyMutableContextFromRoot(self.context)
        self.plant.SetPositions(self.plant_context, self.arm.model, q)
        self.command(self.pose())

    def pose(self):
        X_TP = self.plant.GetFrameByName("tool_center").CalcPose(
            self.plant_context, self.plant.GetFrameByName("target")
        )
        return transform_to_pose(X_TP)

    def command(self, pose, time=None):
        self.controller.get_desired_pose_input_port().FixValue(self.controller_context, pose)
        if time is not None:
            self.controller.get_command_time_input_port().FixValue(self.controller_context, [time])

    def push(self, force, torque=(0, 0, 0)):
        """Apply a force [N] and a torque [Nm] in world axes to the tool center."""
        applied = ExternallyAppliedSpatialForce()
        body = self.plant.GetBodyByName("tool_center")
        applied.body_index = body.index()
        applied.p_BoBq_B = np.zeros(3)
        applied.F_Bq_W = SpatialForce(tau=np.array(torque, dtype=float), f=np.array(force, dtype=float))
        port = self.plant.get_applied_spatial_force_input_port()
        port.FixValue(self.plant_context, Value([applied]))

    def torque(self):
        return self.controller.get_generalized_force_output_port().Eval(self.controller_context)

    def advance(self, seconds, callback=None):
        """Advance the simulation, and call `callback` every 10 ms."""
        end = self.context.get_time() + seconds
        while self.context.get_time() < end - 1e-9:
            self.simulator.AdvanceTo(min(end, self.context.get_time() + 0.01))
            if callback:
                callback()


def displacement(before, after):
    """Return the translation and the rotation vector of the tool between two poses, in the axes of the target T."""
    X, Y = pose_to_transform(before), pose_to_transform(after)
    rotation = (Y.rotation() @ X.rotation().inverse()).ToAngleAxis()
    return np.concatenate([Y.translation() - X.translation(), rotation.angle() * rotation.axis()])


class Law:
    """Controller of an arm in a random state, and the arguments of its control law."""

    def __init__(self, seed=0, **options):
        rng = np.random.default_rng(seed)
        self.q, self.v = np.array(POSTURES[1]), 0.2 * rng.standard_normal(7)
        gains = {"wrench_limits": np.full(6, 1e3), "posture": self.q + 0.1 * rng.standard_normal(7)}
        self.gains = ImpedanceGains(STIFFNESS, **(gains | {k: options.pop(k) for k in [*options] if k in FIELDS}))
        model, arm = controller_model(WORKCELL)
        context = model.CreateDefaultContext()
        model.SetPositionsAndVelocities(context, [*self.q, *self.v])
        X_WT, X_WP = arm.target.CalcPoseInWorld(context), arm.tool_center.CalcPoseInWorld(context)
        self.X_TP = X_WT.inverse() @ X_WP
        self.desired = transform_to_pose(self.X_TP) + 0.01 * rng.standard_normal(6)
        X_TPd = pose_to_transform(self.desired)
        eta, epsilon = orientation_error(X_TPd.rotation(), self.X_TP.rotation())
        world, R_TW = model.world_frame(), X_WT.rotation().inverse()
        J_W = model.CalcJacobianSpatialVelocity(
            context, JacobianWrtVariable.kV, arm.tool_center, np.zeros(3), world, world
        )
        M = model.CalcMassMatrix(context)
        self.arguments = {
            "K": STIFFNESS,
            "damping_ratio": self.gains.damping_ratio,
            "wrench_limits": self.gains.wrench_limits,
            "p_error": X_TPd.translation() - self.X_TP.translation(),
            "eta": eta,
            "epsilon": epsilon,
            "J": np.vstack([R_TW.matrix() @ J_W[3:], R_TW.matrix() @ J_W[:3]]),
            "M": M,
            "v": self.v,
            "posture_torque": self.gains.posture_stiffness * (self.gains.posture - self.q)
            - self.gains.posture_damping * (M @ self.v),
            "gravity_torque": -model.CalcGravityGeneralizedForces(context),
            "torque_limits": model.GetEffortUpperLimits(),
        }
        self.system = CartesianImpedanceController(
            model, arm.target, arm.tool_center, self.gains, period=0.005, **options
        )
        self.context = self.system.CreateDefaultContext()
        self.fix(desired_pose=self.desired, estimated_state=[*self.q, *self.v])

    def fix(self, **inputs):
        for name, value in inputs.items():
            self.system.GetInputPort(name).FixValue(self.context, value)

    def __getitem__(self, port):
        return self.system.GetOutputPort(port).Eval(self.context)

    def check(self, bound=None, **changes):
        """Assert that the outputs are those of the control law with changed arguments; return the expected outputs."""
        expected = impedance_torques(ArmImpedance(**(self.arguments | changes)), bound)
        np.testing.assert_allclose(self["generalized_force"], expected.torque, rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(self["impedance_wrench"], expected.wrench, rtol=1e-7, atol=1e-7)
        assert self["saturation"].tolist() == [expected.is_saturated]
        return expected


FIELDS = [field.name for field in fields(ImpedanceGains)]


@pytest.mark.parametrize("seed", range(3))
def test_torques_are_those_of_the_law(seed):
    law = Law(seed)
    assert not law.check().is_saturated
    np.testing.assert_array_equal(law["pose"], transform_to_pose(law.X_TP))
    limited = Law(seed, wrench_limits=np.full(6, 3.0))
    assert limited.check().is_saturated


def test_gravity_is_compensated_only_when_requested():
    Law(compensate_gravity=False).check(gravity_torque=np.zeros(7))
    Law(compensate_gravity=True).check()


def test_bound_replaces_the_limits_of_the_wrench():
    bound = WrenchBound(np.full(6, 3.0), 4.0, 2.0, contact_stiffness=1e4)
    Law(bound=bound).check(bound=bound)


def test_requested_bound_lowers_the_configured_one():
    requested = np.array([2.0, 2.0, 2.0, 1.0, 1.0, 1.0, 2.5, 1.1])
    bound = WrenchBound(np.array([3.0, 1.0, 3.0, 3.0, 0.5, 3.0]), 4.0, 1.0, contact_stiffness=1e4)
    law = Law(bound=bound)
    law.fix(max_wrench=requested)
    law.check(bound=WrenchBound(np.array([2.0, 1.0, 2.0, 1.0, 0.5, 1.0]), 2.5, 1.0, contact_stiffness=1e4))
    without_bound = Law(wrench_limits=np.array([3.0, 1.0, 3.0, 3.0, 0.5, 3.0]))
    without_bound.fix(max_wrench=requested)
    without_bound.check(bound=WrenchBound(np.array([2.0, 1.0, 2.0, 1.0, 0.5, 1.0]), 2.5, 1.1))


@pytest.mark.parametrize("invalid", [np.nan, -1.0])
def test_last_valid_bound_applies_while_the_requested_is_invalid(invalid):
    law = Law()
    law.fix(max_wrench=np.full(8, 2.0))
    Simulator(law.system, law.context).Initialize()
    law.fix(max_wrench=np.full(8, invalid))
    law.context.SetDiscreteState(law.system.EvalUniquePeriodicDiscreteUpdate(law.context))
    law.check(bound=WrenchBound(np.full(6, 2.0), 2.0, 2.0))


@pytest.mark.parametrize(
    ("age", "timeout", "command_timed_out"),
    [(0.1, {}, 0.0), (0.10005, {}, 1.0), (0.2, {"timeout": 0.2}, 0.0), (0.2001, {"timeout": 0.2}, 1.0)],
)
def test_command_times_out_after_the_timeout(age, timeout, command_timed_out):
    law = Law(**timeout)
    law.fix(command_time=[-age])
    assert law["command_timed_out"].tolist() == [command_timed_out]


@pytest.mark.parametrize("q", [POSTURES[1], POSTURES[3]])
def test_static_displacement_is_compliance_times_wrench(q):
    arm = FreeArm(q, time_step=0.005)
    before = arm.pose()
    force, torque = np.array([6.0, -4.0, 8.0]), np.array([0.3, -0.2, 0.4])
    arm.push(force, torque)
    arm.advance(4.0)
    expected = np.linalg.solve(STIFFNESS, np.concatenate([force, torque]))
    actual = displacement(before, arm.pose())
    assert np.linalg.norm(actual[:3] - expected[:3]) < 0.02 * np.linalg.norm(expected[:3])
    assert np.linalg.norm(actual[3:] - expected[3:]) < 0.02 * np.linalg.norm(expected[3:])


def test_energy_never_increases_after_a_push():
    gains = ImpedanceGains(STIFFNESS, LIMITS, np.array(POSTURES[1]), damping_ratio=0.3, posture_stiffness=0.0)
    arm = FreeArm(POSTURES[1], gains=gains, time_step=0.001)
    desired = arm.pose()
    # This push does not saturate the spring, so its energy is ½ eᵀ K e.
    arm.push([12.0, -10.0, 15.0], [0.5, 0.5, -0.5])
    arm.advance(0.4)
    arm.push([0.0, 0.0, 0.0])
    energies = []

    def measure():
        X, X_desired = pose_to_transform(arm.pose()), pose_to_transform(desired)
        _, epsilon = orientation_error(X_desired.rotation(), X.rotation())
        error = np.concatenate([X_desired.translation() - X.translation(), 2 * epsilon])
        v = arm.plant.GetVelocities(arm.plant_context)
        energies.append(0.5 * v @ arm.plant.CalcMassMatrix(arm.plant_context) @ v + 0.5 * error @ STIFFNESS @ error)

    measure()
    arm.advance(1.5, measure)
    assert energies[0] > 0.05
    assert np.diff(energies).max() < 1e-4 * energies[0]
    assert energies[-1] < 0.01 * energies[0]


def test_distant_target_is_approached_within_limits():
    arm = FreeArm(POSTURES[0], time_step=0.005)
    start = arm.pose()
    arm.command(start + [-0.1, 0.35, 0.35, 0.5, 0, 0])
    limits = arm.model.GetEffortUpperLimits()
    torques, wrenches = [], []

    def record():
        torques.append(np.abs(arm.torque()))
        wrenches.append(np.abs(arm.controller.get_impedance_wrench_output_port().Eval(arm.controller_context)))

    arm.advance(3.0, record)
    assert (np.array(torques) <= limits).all()
    assert (np.array(wrenches) <= LIMITS + 1e-9).all()
    assert np.linalg.norm((arm.pose() - start)[:3]) > 0.3


def test_arm_returns_within_limits_after_an_impact():
    """A ball of 2 kg is released 0.35 m above link 6."""
    arm = FreeArm(POSTURES[0], time_step=0.001, ball=True)
    start = arm.pose()
    p_WLink = arm.plant.GetFrameByName("iiwa_link_6").CalcPoseInWorld(arm.plant_context).translation()
    arm.plant.SetFreeBodyPose(arm.plant_context, arm.ball, RigidTransform(p_WLink + [0.0, 0.0, 0.35]))
    limits = arm.model.GetEffortUpperLimits()
    deviations = []

    def record():
        assert (np.abs(arm.torque()) <= limits).all()
        deviations.append(np.abs(arm.pose() - start)[:3].max())

    arm.advance(2.5, record)
    assert max(deviations) > 0.002
    np.testing.assert_allclose(arm.pose(), start, atol=2e-3)


def test_last_valid_pose_is_followed_when_commands_stop():
    arm = FreeArm(POSTURES[0], time_step=0.005)
    start = arm.pose()
    command_timed_out = arm.controller.get_command_timed_out_output_port()
    last_valid = start + [0.01, 0, 0, 0, 0, 0]
    arm.command(last_valid, time=0.0)
    arm.advance(0.05)
    assert command_timed_out.Eval(arm.controller_context)[0] == 0.0
    arm.advance(0.2)
    assert command_timed_out.Eval(arm.controller_context)[0] == 1.0
    arm.command(start + [0.5, 0.5, 0, 0, 0, 0], time=0.0)  # a stale message with a distant target
    arm.advance(2.0)
    np.testing.assert_allclose(arm.pose(), last_valid, atol=5e-4)


@pytest.mark.parametrize("coordinate", [np.nan, np.inf, 1e300, 1.001e6])
def test_command_is_ignored_when_it_is_invalid(coordinate):
    arm = FreeArm(POSTURES[0], time_step=0.005)
    start = arm.pose()
    arm.command(np.array([coordinate, -coordinate, coordinate, 0.0, 0.0, 0.0]))
    arm.advance(0.5)
    assert np.isfinite(arm.torque()).all()
    np.testing.assert_allclose(arm.pose(), start, atol=1e-4)


def test_gains_at_their_limits_are_accepted():
    stiffness, posture_gains = np.diag([1e8, 1e-9, 1, 1, 1, 1]), {"posture_stiffness": 0.0, "posture_damping": 0.0}
    ImpedanceGains(stiffness.tolist(), [1e-9] * 6, np.zeros(7), damping_ratio=1e-9, **posture_gains)


def make_controller(plant, tool):
    """Return a controller of this plant whose target is the world frame."""
    gains = ImpedanceGains(STIFFNESS, np.full(6, 1e6), np.zeros(6))
    return CartesianImpedanceController(plant, plant.world_frame(), tool.body_frame(), gains, period=0.01)


@pytest.mark.parametrize("motors", [range(6), (5, 4, 3, 2, 1, 0), (2, 0, 1, 5, 3, 4)])
def test_each_joint_has_the_limit_of_its_own_motor(motors):
    plant, tool = six_axes(motors, range(1, 7))
    controller = make_controller(plant, tool)
    context = controller.CreateDefaultContext()
    controller.get_desired_pose_input_port().FixValue(context, [5.0, 5.0, 5.0, 0.0, 0.0, 0.0])
    controller.get_estimated_state_input_port().FixValue(context, np.r_[np.zeros(6), np.full(6, -100.0)])
    torque = controller.get_generalized_force_output_port().Eval(context)
    np.testing.assert_array_equal(torque, np.arange(1, 7))
    # The transposed actuation matrix maps generalized forces to the order of the motors.
    np.testing.assert_array_equal(plant.MakeActuationMatrix().T @ torque, [index + 1 for index in motors])


@pytest.mark.parametrize("motors", [(), (0, 1), range(5), (0, 1, 2, 3, 4, 4), (0, 1, 2, 3, 4, 5, 5)])
def test_plant_is_refused_without_one_motor_per_joint(motors):
    with pytest.raises(InputError, match=rf"one actuator for each .*axis0, axis1, .*, not {len(motors)} actuators"):
        make_controller(*six_axes(motors))


@pytest.mark.parametrize("number", [np.nan, np.inf])
@pytest.mark.parametrize("index", [0, 6])
def test_estimated_state_that_is_not_finite_is_refused(index, number):
    """Drake would end the process for such a state."""
    controller = make_controller(*six_axes())
    context = controller.CreateDefaultContext()
    controller.get_desired_pose_input_port().FixValue(context, np.zeros(6))
    controller.get_estimated_state_input_port().FixValue(context, np.where(np.arange(12) == index, number, 0.0))
    with pytest.raises(InputError, match="joint positions and velocities must be finite"):
        controller.get_generalized_force_output_port().Eval(context)


def test_gains_are_parameters_of_the_context():
    law = Law(seed=1)
    law.check()
    pristine = law.context.Clone()
    posture = law.gains.posture + 0.05
    turned = np.diag([900.0, 1200.0, 700.0, 20.0, 25.0, 30.0])
    turned[0, 1] = turned[1, 0] = 100.0
    gains = ImpedanceGains(turned, np.full(6, 900.0), posture, 0.7, 4.0, 2.0)
    law.system.set_gains(law.context, gains)
    changed = {
        "K": turned,
        "damping_ratio": 0.7,
        "wrench_limits": np.full(6, 900.0),
        "posture_torque": 4.0 * (posture - law.q) - 2.0 * (law.arguments["M"] @ law.v),
    }
    law.check(**changed)
    np.testing.assert_array_equal(law.system.gains(law.context).stiffness, turned)
    law.context.SetTimeStateAndParametersFrom(pristine)
    law.check()
    assert law.system.gains(law.context) is law.gains


def test_changed_gains_are_refused_with_another_bound():
    law = Law()
    bound = WrenchBound(np.full(6, 3.0), 4.0, 2.0)
    with pytest.raises(InputError, match="bound of an impedance is constant"):
        law.system.set_gains(law.context, ImpedanceGains(STIFFNESS, LIMITS, np.zeros(7), bound=bound))


@pytest.mark.parametrize("changed", ["gains", "payload"])
def test_parameters_are_refused_in_the_context_of_a_diagram(changed):
    """There, the parameters of another controller would be changed."""
    law, builder = Law(), DiagramBuilder()
    builder.AddSystem(law.system)
    root = builder.Build().CreateDefaultContext()
    value = law.gains if changed == "gains" else Payload(1.0)
    with pytest.raises(InputError, match=r"pass system\.GetMyMutableContextFromRoot"):
        getattr(law.system, f"set_{changed}")(root, value)


def test_payload_is_compensated():
    """A payload of 2 kg at the tool center does not displace the tool if the controller has it as a parameter."""
    displacements = []
    for is_known in (True, False):
        arm = FreeArm(POSTURES[0], time_step=0.005)
        if is_known:
            arm.controller.set_payload(arm.controller_context, Payload(2.0))
        before = arm.pose()
        arm.push([0.0, 0.0, -2.0 * 9.81])
        arm.advance(1.0)
        displacements.append(displacement(before, arm.pose()))
    known, unknown = (np.abs(each).max() for each in displacements)
    assert known < 1e-4
    assert unknown > 0.01


def test_center_of_a_payload_is_relative_to_the_tool_center():
    law = Law()
    law.system.set_payload(law.context, Payload(1.5, (0.1, 0.0, 0.0)))
    first = law["generalized_force"].copy()
    law.system.set_payload(law.context, Payload(1.5, (0.0, 0.1, 0.0)))
    assert not np.allclose(law["generalized_force"], first, atol=0.1)


def test_gains_are_copies_that_cannot_be_written_to():
    limits, posture = [10.0] * 6, np.zeros(7)
    gains = ImpedanceGains(np.eye(6), limits, posture)
    posture[:] = 1.0
    assert gains.wrench_limits.shape == (6,)
    assert not gains.posture.any()
    for array in (gains.stiffness, gains.wrench_limits, gains.posture):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 2.0
