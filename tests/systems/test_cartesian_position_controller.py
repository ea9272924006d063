from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsStatus
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import ArmControllerPlant, controller_model
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.iiwa import IIWA14
from guiderail.models.robots.inverse_kinematics import solve_inverse_kinematics
from guiderail.systems import cartesian_position_controller
from guiderail.systems.cartesian_position_controller import CartesianPositionController, SpeedLimits
from guiderail.systems.support.drake_multibody import pose_to_transform, transform_to_pose

READY_POSTURE = np.array(IIWA14.home)
START = np.array([0.0, 0.0, 0.02, 0.8, 0.0, 0.0])
NOWHERE = np.full(6, np.nan)
GOAL = START + [0.05, -0.08, 0.06, -0.5, 0.1, -0.2]


@pytest.fixture(scope="module")
def arm():
    return controller_model(BncWorkcell())


class Commanded:
    """Controller with its joint command initially at `START` or at given joint positions."""

    def __init__(self, arm, q_start=None, **options):
        self.plant, model = arm
        if q_start is None:
            q_start = solve_inverse_kinematics(
                self.plant, model.target, model.tool_center, pose_to_transform(START), READY_POSTURE
            )
        self.q_start = q_start
        self.system = CartesianPositionController(
            self.plant, model.target, model.tool_center, **{"posture": READY_POSTURE} | options
        )
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.system.get_positions_input_port().FixValue(self.context, self.q_start)
        self.desired = self.system.get_desired_pose_input_port().FixValue(self.context, START)
        self.simulator.Initialize()

    def command(self, pose, time=None):
        self.desired.GetMutableData().set_value(pose)
        if time is not None:
            self.system.get_command_time_input_port().FixValue(self.context, [time])

    def advance(self, seconds):
        self.simulator.AdvanceTo(self.context.get_time() + seconds)

    @property
    def joints(self):
        return self.system.get_joint_positions_output_port().Eval(self.context).copy()

    @property
    def pose(self):
        return self.system.get_pose_output_port().Eval(self.context).copy()

    @property
    def stuck(self):
        return self.system.get_stuck_output_port().Eval(self.context)[0]

    @property
    def command_timed_out(self):
        return self.system.get_command_timed_out_output_port().Eval(self.context)[0]


def test_joint_command_starts_at_the_measured_positions(arm):
    commanded = Commanded(arm)
    np.testing.assert_array_equal(commanded.joints, commanded.q_start)
    np.testing.assert_allclose(commanded.pose, START, atol=1e-8)


def test_no_direct_feedthrough(arm):
    assert not Commanded(arm).system.HasAnyDirectFeedthrough()


def test_tool_reaches_the_desired_pose(arm):
    commanded = Commanded(arm)
    commanded.command(GOAL)
    commanded.advance(2.0)
    np.testing.assert_allclose(commanded.pose, GOAL, atol=1e-5)
    assert commanded.stuck == 0.0


def test_closed_form_is_the_optimum_when_no_limit_is_active(arm, monkeypatch):
    quick, slow = Commanded(arm), Commanded(arm)
    for commanded in (quick, slow):
        commanded.command(GOAL)
    quick.advance(1.0)
    monkeypatch.setattr(cartesian_position_controller, "_within", lambda values, limits: False)
    slow.advance(1.0)
    np.testing.assert_allclose(quick.joints, slow.joints, atol=1e-6)
    assert quick.stuck == slow.stuck == 0.0
    assert np.abs(quick.joints - quick.q_start).max() > 0.1


def test_tool_slows_down_when_a_joint_velocity_limit_is_active(arm):
    commanded = Commanded(arm, speed_limits=SpeedLimits(translational=50.0, rotational=50.0))
    commanded.command(GOAL)
    limit = commanded.plant.GetVelocityUpperLimits()
    # Sampled between the steps, which are at multiples of the period.
    commanded.advance(0.005)
    way = GOAL[:3] - START[:3]
    for _ in range(20):
        q = commanded.joints
        commanded.advance(0.01)
        assert (np.abs(commanded.joints - q) / 0.01 <= limit + 1e-6).all()
        moved = commanded.pose[:3] - START[:3]
        assert np.linalg.norm(np.cross(moved, way)) <= 0.02 * np.linalg.norm(way) * max(np.linalg.norm(moved), 1e-3)
    np.testing.assert_allclose(commanded.pose, GOAL, atol=1e-4)


def test_tool_speed_is_within_its_limits(arm):
    limits = SpeedLimits(translational=0.1, rotational=0.5)
    commanded = Commanded(arm, speed_limits=limits)
    commanded.command(START + [0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    velocity_limit = commanded.plant.GetVelocityUpperLimits()
    commanded.advance(0.005)
    for _ in range(50):
        q, pose = commanded.joints, commanded.pose
        commanded.advance(0.01)
        assert (np.abs(commanded.joints - q) / 0.01 <= velocity_limit + 1e-6).all()
        assert np.linalg.norm(commanded.pose[:3] - pose[:3]) / 0.01 <= limits.translational * 1.02


def test_joint_limits_are_satisfied_when_the_pose_is_unreachable(arm):
    commanded = Commanded(arm, speed_limits=SpeedLimits(translational=2.0, rotational=3.0))
    commanded.command(START + [2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    commanded.advance(3.0)
    assert (commanded.joints >= commanded.plant.GetPositionLowerLimits()).all()
    assert (commanded.joints <= commanded.plant.GetPositionUpperLimits()).all()
    assert np.isfinite(commanded.joints).all()


def beyond(arm, posture, joint, by):
    """Posture with one joint outside its upper limit, the mirrored posture inside it, and the pose of the latter."""
    plant, model = arm
    outside, inside = np.array(posture, dtype=float), np.array(posture, dtype=float)
    outside[joint] = plant.GetPositionUpperLimits()[joint] + by
    inside[joint] = plant.GetPositionUpperLimits()[joint] - by
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, inside)
    return outside, transform_to_pose(model.tool_center.CalcPose(context, model.target))


BENT, STRETCHED = READY_POSTURE, np.zeros(7)


@pytest.mark.parametrize("by", [1e-4, 0.02, 0.3])
@pytest.mark.parametrize(("posture", "joint"), [(BENT, 1), (BENT, 3), (BENT, 5), (STRETCHED, 1)])
def test_joint_outside_its_limit_returns_without_a_jump(arm, posture, joint, by):
    """An arm may have been moved there by hand; a stretched posture is singular as well."""
    q, goal = beyond(arm, posture, joint, by)
    commanded = Commanded(arm, q)
    commanded.command(goal)
    limit = commanded.plant.GetVelocityUpperLimits()
    for step in range(400):
        before = commanded.joints
        commanded.simulator.AdvanceTo((step + 0.5) * 0.01)
        moved = commanded.joints - before
        assert (np.abs(moved) / 0.01 <= limit + 1e-6).all()
        assert moved[joint] <= 0.0 or commanded.joints[joint] <= commanded.plant.GetPositionUpperLimits()[joint]
    assert (commanded.joints <= commanded.plant.GetPositionUpperLimits()).all()
    np.testing.assert_allclose(commanded.pose, goal, atol=1e-3)


def test_joint_outside_its_limit_moves_no_farther_out(arm):
    q, _ = beyond(arm, BENT, 3, 1e-4)
    _, farther = beyond(arm, BENT, 3, -0.1)
    commanded = Commanded(arm, q)
    commanded.command(farther)
    commanded.advance(1.0)
    assert commanded.joints[3] <= q[3]


def test_joint_command_is_constant_when_the_pose_is_not_finite(arm):
    commanded = Commanded(arm)
    commanded.command(np.full(6, np.nan))
    commanded.advance(0.1)
    np.testing.assert_array_equal(commanded.joints, commanded.q_start)
    assert commanded.command_timed_out == 1.0
    commanded.command(GOAL)
    commanded.advance(0.1)
    assert (commanded.joints != commanded.q_start).any()
    assert commanded.command_timed_out == 0.0


def test_joint_command_is_constant_when_commands_stop(arm):
    commanded = Commanded(arm, timeout=0.1)
    commanded.command(GOAL, time=0.0)
    commanded.advance(0.095)
    assert commanded.command_timed_out == 0.0
    commanded.advance(0.02)
    assert commanded.command_timed_out == 1.0
    stopped = commanded.joints
    commanded.advance(0.5)
    np.testing.assert_array_equal(commanded.joints, stopped)
    assert np.linalg.norm(commanded.pose - GOAL) > 0.05
    # A new command is valid at the next period, and a stale one does not become valid again.
    commanded.command(GOAL, time=commanded.context.get_time())
    commanded.advance(0.01)
    assert commanded.command_timed_out == 0.0
    commanded.command(START, time=0.0)
    commanded.advance(0.01)
    assert commanded.command_timed_out == 1.0


@pytest.mark.parametrize("time", [0.02, 1e6, np.inf, np.nan])
def test_command_is_ignored_when_its_time_stamp_is_invalid(arm, time):
    commanded = Commanded(arm)
    commanded.command(GOAL, time=time)
    commanded.advance(0.005)
    np.testing.assert_array_equal(commanded.joints, commanded.q_start)
    assert commanded.command_timed_out == 1.0


def test_time_stamps_change_nothing_when_commands_are_current(arm):
    plain, timed = Commanded(arm), Commanded(arm)
    plain.command(GOAL)
    for step in range(20):
        timed.command(GOAL, time=0.01 * step)
        for commanded in (plain, timed):
            commanded.simulator.AdvanceTo(0.01 * (step + 1))
    np.testing.assert_array_equal(timed.joints, plain.joints)


@pytest.mark.parametrize(
    "wrong",
    [
        {"period": 0.0},
        {"posture": np.zeros(3)},
        {"posture": np.full(7, np.nan)},
        {"posture": np.array([0.0] * 6 + [np.inf])},
        {"posture_gain": -1.0},
        {"speed_limits": (1, 1)},
        {"posture_gain": np.nan},
        {"posture_gain": np.inf},
        {"timeout": 0.0},
    ],
)
def test_constructor_refuses_arguments_out_of_range(arm, wrong):
    plant, model = arm
    with pytest.raises(InputError):
        CartesianPositionController(plant, model.target, model.tool_center, **({"posture": READY_POSTURE} | wrong))


def test_constructor_refuses_an_arm_of_fewer_than_six_joints():
    plant = MultibodyPlant(0.0)
    body = plant.AddRigidBody("link")
    plant.AddJoint(RevoluteJoint("joint", plant.world_frame(), body.body_frame(), [0.0, 0.0, 1.0]))
    plant.Finalize()
    with pytest.raises(InputError, match="at least six joints, not 1"):
        CartesianPositionController(plant, plant.world_frame(), body.body_frame(), posture=np.zeros(1))


@pytest.mark.parametrize("speed", [0.0, -1.0, np.nan])
@pytest.mark.parametrize("name", ["translational", "rotational"])
def test_speed_limits_refuse_values_out_of_range(name, speed):
    with pytest.raises(InputError, match="positive"):
        SpeedLimits(**{name: speed})


def test_defaults_of_the_controller(arm):
    explicit = {"speed_limits": SpeedLimits(translational=0.25, rotational=1.0), "posture_gain": 0.5, "timeout": 0.1}
    for time in (None, 0.0, -5e-5):
        joints = []
        for options in ({}, explicit):
            commanded = Commanded(arm, **options)
            commanded.command(START + [0.3, 0.0, 0.0, 2.0, 0.0, 0.0], time)
            commanded.advance(0.145)
            joints.append(commanded.joints)
        np.testing.assert_array_equal(*joints)
    assert SpeedLimits() == explicit["speed_limits"]


def test_posture_is_copied(arm):
    posture, joints = READY_POSTURE + 0.2, []
    for is_changed in (False, True):
        commanded = Commanded(arm, posture=posture)
        if is_changed:
            posture[:] = 0.0
        commanded.advance(0.1)
        joints.append(commanded.joints)
    np.testing.assert_array_equal(*joints)


def test_posture_gain_of_zero_is_accepted(arm):
    commanded = Commanded(arm, posture_gain=0.0)
    commanded.command(GOAL)
    commanded.advance(2.0)
    np.testing.assert_allclose(commanded.pose, GOAL, atol=1e-5)


def test_flags_are_reset_at_initialization(arm):
    commanded = Commanded(arm, speed_limits=SpeedLimits(translational=2.0, rotational=3.0))
    commanded.command(START + [2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    commanded.advance(3.0)
    assert commanded.stuck == 1.0
    commanded.command(NOWHERE)
    commanded.advance(0.02)
    assert (commanded.stuck, commanded.command_timed_out) == (1.0, 1.0)
    commanded.simulator.Initialize()
    assert (commanded.stuck, commanded.command_timed_out) == (0.0, 0.0)
    np.testing.assert_array_equal(commanded.joints, commanded.q_start)


def first_step(arm, monkeypatch, q, velocities, is_regular=True, solution=None):
    """Return the controller after its first step with the given unlimited velocities, and the calls of the solver."""
    calls, solve = [], cartesian_position_controller.DoDifferentialInverseKinematics

    def record(*arguments):
        calls.append(arguments)
        return solution or solve(*arguments)

    monkeypatch.setattr(cartesian_position_controller, "DoDifferentialInverseKinematics", record)
    monkeypatch.setattr(
        cartesian_position_controller, "damped_joint_velocities", lambda *_: (np.array(velocities), is_regular)
    )
    commanded = Commanded(arm, q)
    commanded.command(GOAL)
    commanded.advance(0.005)
    return commanded, calls


@pytest.mark.parametrize("share", [0.9, 1.0005, 3.0])
def test_desired_tool_velocity_is_reduced_to_its_limits(arm, monkeypatch, share):
    desired, limits = [], SpeedLimits(translational=0.2, rotational=0.5)
    solve = cartesian_position_controller.damped_joint_velocities

    def record(J, V, preferred):
        desired.append(V)
        return solve(J, V, preferred)

    monkeypatch.setattr(cartesian_position_controller, "damped_joint_velocities", record)
    commanded = Commanded(arm, speed_limits=limits)
    commanded.command(commanded.pose + np.array([0.0, 0.002, 0.0, 0.005, 0.0, 0.0]) * share)
    commanded.advance(0.005)
    expected = min(share, 1.0) * np.array([0.0, 0.0, 0.5, 0.0, 0.2, 0.0])
    np.testing.assert_allclose(desired[0], expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", [0, 6])
@pytest.mark.parametrize(
    ("steps", "speed", "is_solved"),
    # Number of steps to the position limit, and speed towards it relative to the velocity limit.
    [(10.0, 1.0, False), (10.0, 1.0001, True), (1.01, 0.1, False), (0.99, 0.1, True), (0.0, 0.0, False)],
)
def test_solver_is_called_only_when_a_limit_is_active(arm, monkeypatch, joint, side, steps, speed, is_solved):
    plant = arm[0]
    q, velocities = READY_POSTURE.copy(), np.zeros(7)
    limits = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    velocities[joint] = side * speed * plant.GetVelocityUpperLimits()[joint]
    q[joint] = limits[int(side > 0)][joint] - steps * 0.01 * velocities[joint]
    commanded, calls = first_step(arm, monkeypatch, q, velocities)
    assert len(calls) == is_solved
    if not is_solved:
        np.testing.assert_array_equal(commanded.joints, np.clip(q + 0.01 * velocities, *limits))
        assert commanded.stuck == 0.0
    else:
        np.testing.assert_array_equal(calls[0][-1].get_joint_position_limits(), limits)


def test_joint_command_is_constant_when_the_solver_fails(arm, monkeypatch):
    failure = SimpleNamespace(joint_velocities=None, status=DifferentialInverseKinematicsStatus.kNoSolutionFound)
    commanded, calls = first_step(arm, monkeypatch, READY_POSTURE, np.full(7, 100.0), solution=failure)
    assert len(calls) == 1
    np.testing.assert_array_equal(commanded.joints, READY_POSTURE)
    assert commanded.stuck == 1.0


@pytest.mark.parametrize("speed", [-4.0, -1.0, -0.5, 0.5, 1.0, 4.0])
def test_velocities_are_scaled_down_together_in_a_singular_posture(arm, monkeypatch, speed):
    limit = arm[0].GetVelocityUpperLimits()
    velocities = limit * [0.01, speed, 0.02, -0.03, 0.0, 0.0, 0.1]
    commanded, calls = first_step(arm, monkeypatch, READY_POSTURE, velocities, is_regular=False)
    expected = READY_POSTURE + 0.01 * velocities / max(1.0, abs(speed))
    np.testing.assert_allclose(commanded.joints, expected, rtol=0.0, atol=1e-15)
    assert not calls


# With aligned wrist axes an arm of six joints can neither turn its tool about one direction nor move it along another.
SINGULAR = np.array([-0.2448, -1.3796, 1.8297, -2.021, 0.0, 0.0])


class SixJoints(Commanded):
    """Controller of a UR5e that starts in a singular posture."""

    def __init__(self, shift, lower_share=1.0):
        known = ArmControllerPlant(BncWorkcell(), "ur5e")
        for index in known.plant.GetJointIndices():
            joint = known.plant.get_joint(index)
            joint.set_velocity_limits(lower_share * joint.velocity_lower_limits(), joint.velocity_upper_limits())
        self.plant, self.q_start = known.plant, SINGULAR
        self.system = CartesianPositionController(
            known.plant, known.arm.target, known.arm.tool_center, posture=known.posture
        )
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.system.get_positions_input_port().FixValue(self.context, SINGULAR)
        context = known.plant.CreateDefaultContext()
        known.plant.SetPositions(context, SINGULAR)
        self.start = transform_to_pose(known.arm.tool_center.CalcPose(context, known.arm.target))
        self.desired = self.system.get_desired_pose_input_port().FixValue(self.context, self.start + shift)
        self.simulator.Initialize()


@pytest.mark.parametrize("shift", [[0.05, 0, 0, 0, 0, 0], [0, 0.05, 0, 0, 0, 0], [0, 0, 0, 0.3, 0, 0], [0] * 6])
def test_tool_leaves_a_singular_posture_without_a_jump(shift):
    """The orientation deviates temporarily in the lost direction of the wrist, and `stuck` is reported."""
    commanded = SixJoints(np.array(shift))
    limit = commanded.plant.GetVelocityUpperLimits()
    errors, stuck = [], []
    commanded.advance(0.005)
    for _ in range(600):
        q = commanded.joints
        commanded.advance(0.01)
        assert (np.abs(commanded.joints - q) / 0.01 <= limit + 1e-6).all()
        errors.append(np.abs(commanded.pose - commanded.start - shift))
        stuck.append(commanded.stuck)
    errors = np.array(errors)
    assert errors[:, :3].max() < np.abs(shift[:3]).max() + 0.005
    assert errors[-1, :3].max() < 2e-3
    assert errors[-1, 3:].max() < 0.05
    assert max(stuck) == float(bool(np.any(shift)))


def test_lower_velocity_limits_hold_in_a_singular_posture_when_they_are_smaller():
    commanded = SixJoints(np.array([0.05, 0.0, 0.0, 0.3, 0.0, 0.0]), lower_share=0.05)
    lower, slowest = commanded.plant.GetVelocityLowerLimits(), np.zeros(6)
    commanded.advance(0.005)
    for _ in range(60):
        q = commanded.joints
        commanded.advance(0.01)
        slowest = np.minimum(slowest, (commanded.joints - q) / 0.01)
    assert (slowest >= lower - 1e-6).all()
    assert (slowest / lower).max() > 0.99  # a limit was reached


def test_tool_follows_its_path_near_a_singular_posture():
    """The path passes the singularity of the wrist by a rotation that is not lost."""
    commanded = SixJoints(np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0]))
    commanded.advance(3.0)
    np.testing.assert_allclose(commanded.pose, commanded.start + [0, 0, 0, 0, 0.5, 0], atol=1e-4)
    assert commanded.stuck == 0.0


@pytest.mark.parametrize("bad", [np.full(7, np.nan), [np.nan] + [0.0] * 6, [0.0] * 6 + [np.inf]])
def test_initialization_fails_when_positions_are_not_finite(arm, bad):
    with pytest.raises(InputError, match="measured positions must be finite"):
        Commanded(arm, q_start=bad)
