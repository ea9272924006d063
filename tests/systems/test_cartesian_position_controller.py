from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.multibody.inverse_kinematics import DifferentialInverseKinematicsStatus
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import RevoluteJoint
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.stations.arm import ArmControllerPlant, controller_model
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError
from guiderail.models.robots.catalog import IIWA14
from guiderail.models.robots.inverse_kinematics import solve_inverse_kinematics
from guiderail.systems import cartesian_position_controller
from guiderail.systems.cartesian_position_controller import CartesianPositionController, SpeedLimits
from guiderail.systems.support.drake_multibody import pose_to_transform, transform_to_pose

READY_POSTURE = np.array(IIWA14.home)
START = np.array([0.0, 0.0, 0.02, 0.8, 0.0, 0.0])
GOAL = START + [0.05, -0.08, 0.06, -0.5, 0.1, -0.2]


@pytest.fixture(scope="module")
def arm():
    return controller_model(BncWorkcell())


class Rig:
    """Controller whose joint command starts at the pose `START` or at given joint positions."""

    def __init__(self, arm, q_start=None, posture=READY_POSTURE, **options):
        self.plant, model = arm
        if q_start is None:
            q_start = solve_inverse_kinematics(
                self.plant, model.target, model.tool_center, pose_to_transform(START), READY_POSTURE
            )
        self.q_start = q_start
        self.system = CartesianPositionController(
            self.plant, model.target, model.tool_center, posture=posture, **options
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
    rig = Rig(arm)
    np.testing.assert_array_equal(rig.joints, rig.q_start)
    np.testing.assert_allclose(rig.pose, START, atol=1e-8)


def test_tool_reaches_the_desired_pose(arm):
    rig = Rig(arm)
    rig.command(GOAL)
    rig.advance(2.0)
    np.testing.assert_allclose(rig.pose, GOAL, atol=1e-5)
    assert rig.stuck == 0.0


def test_closed_form_is_the_optimum_when_no_limit_is_active(arm, monkeypatch):
    closed_form, optimized = Rig(arm), Rig(arm)
    for rig in (closed_form, optimized):
        rig.command(GOAL)
    closed_form.advance(1.0)
    monkeypatch.setattr(cartesian_position_controller, "_within", lambda values, limits: False)
    optimized.advance(1.0)
    np.testing.assert_allclose(closed_form.joints, optimized.joints, atol=1e-6)
    assert closed_form.stuck == optimized.stuck == 0.0
    assert np.abs(closed_form.joints - closed_form.q_start).max() > 0.1


def test_tool_slows_down_when_a_joint_velocity_limit_is_active(arm):
    rig = Rig(arm, speed_limits=SpeedLimits(translational=50.0, rotational=50.0))
    rig.command(GOAL)
    limit = rig.plant.GetVelocityUpperLimits()
    rig.advance(0.005)  # samples are in the middle of the control periods of 10 ms
    line = GOAL[:3] - START[:3]
    for _ in range(20):
        q = rig.joints
        rig.advance(0.01)
        assert (np.abs(rig.joints - q) / 0.01 <= limit + 1e-6).all()
        moved = rig.pose[:3] - START[:3]
        assert np.linalg.norm(np.cross(moved, line)) <= 0.02 * np.linalg.norm(line) * max(np.linalg.norm(moved), 1e-3)
    np.testing.assert_allclose(rig.pose, GOAL, atol=1e-4)


def test_tool_speed_is_within_its_limits(arm):
    limits = SpeedLimits(translational=0.1, rotational=0.5)
    rig = Rig(arm, speed_limits=limits)
    rig.command(START + [0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
    velocity_limit = rig.plant.GetVelocityUpperLimits()
    rig.advance(0.005)
    for _ in range(50):
        q, pose = rig.joints, rig.pose
        rig.advance(0.01)
        assert (np.abs(rig.joints - q) / 0.01 <= velocity_limit + 1e-6).all()
        assert np.linalg.norm(rig.pose[:3] - pose[:3]) / 0.01 <= limits.translational * 1.02


def test_joint_limits_are_satisfied_when_the_pose_is_unreachable(arm):
    rig = Rig(arm, speed_limits=SpeedLimits(translational=2.0, rotational=3.0))
    rig.command(START + [2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    rig.advance(3.0)
    assert (rig.joints >= rig.plant.GetPositionLowerLimits()).all()
    assert (rig.joints <= rig.plant.GetPositionUpperLimits()).all()
    assert np.isfinite(rig.joints).all()


def outside_limit(arm, posture, joint, excess):
    """Return joint positions with a joint outside its upper limit, and the tool pose with the joint as far inside.

    Args:
        arm: Plant and arm.
        posture: Positions (7,) of the other joints [rad].
        joint: Index of the joint.
        excess: Distance of the joint from its upper limit [rad].
    """
    plant, model = arm
    outside, inside = np.array(posture, dtype=float), np.array(posture, dtype=float)
    outside[joint] = plant.GetPositionUpperLimits()[joint] + excess
    inside[joint] = plant.GetPositionUpperLimits()[joint] - excess
    context = plant.CreateDefaultContext()
    plant.SetPositions(context, inside)
    return outside, transform_to_pose(model.tool_center.CalcPose(context, model.target))


BENT, STRETCHED = READY_POSTURE, np.zeros(7)


@pytest.mark.parametrize("excess", [1e-4, 0.3])
@pytest.mark.parametrize(("posture", "joint"), [(BENT, 3), (STRETCHED, 1)])
def test_joint_outside_its_limit_returns_without_a_jump(arm, posture, joint, excess):
    """A person may have moved the joint there by hand. The stretched posture is also singular."""
    q, goal = outside_limit(arm, posture, joint, excess)
    rig = Rig(arm, q)
    rig.command(goal)
    limit = rig.plant.GetVelocityUpperLimits()
    for step in range(400):
        before = rig.joints
        rig.simulator.AdvanceTo((step + 0.5) * 0.01)
        moved = rig.joints - before
        assert (np.abs(moved) / 0.01 <= limit + 1e-6).all()
        assert moved[joint] <= 0.0 or rig.joints[joint] <= rig.plant.GetPositionUpperLimits()[joint]
    assert (rig.joints <= rig.plant.GetPositionUpperLimits()).all()
    np.testing.assert_allclose(rig.pose, goal, atol=1e-3)


def test_joint_outside_its_limit_never_moves_farther_outside(arm):
    q, _ = outside_limit(arm, BENT, 3, 1e-4)
    _, farther = outside_limit(arm, BENT, 3, -0.1)
    rig = Rig(arm, q)
    rig.command(farther)
    rig.advance(1.0)
    assert rig.joints[3] <= q[3]


def test_joint_command_is_constant_when_the_pose_is_not_finite(arm):
    rig = Rig(arm)
    rig.command(np.full(6, np.nan))
    rig.advance(0.1)
    np.testing.assert_array_equal(rig.joints, rig.q_start)
    assert rig.command_timed_out == 1.0
    rig.command(GOAL)
    rig.advance(0.1)
    assert (rig.joints != rig.q_start).any()
    assert rig.command_timed_out == 0.0


def test_joint_command_is_constant_when_commands_stop(arm):
    rig = Rig(arm)
    rig.command(GOAL, time=0.0)
    rig.advance(0.095)
    assert rig.command_timed_out == 0.0
    rig.advance(0.02)
    assert rig.command_timed_out == 1.0
    stopped = rig.joints
    rig.advance(0.5)
    np.testing.assert_array_equal(rig.joints, stopped)
    assert np.linalg.norm(rig.pose - GOAL) > 0.05
    # A new command is valid at the next period. A stale command that follows is invalid.
    rig.command(GOAL, time=rig.context.get_time())
    rig.advance(0.01)
    assert rig.command_timed_out == 0.0
    rig.command(START, time=0.0)
    rig.advance(0.01)
    assert rig.command_timed_out == 1.0


@pytest.mark.parametrize("time", [0.02, 1e6, np.inf, np.nan])
def test_command_is_ignored_when_its_time_stamp_is_invalid(arm, time):
    rig = Rig(arm)
    rig.command(GOAL, time=time)
    rig.advance(0.005)
    np.testing.assert_array_equal(rig.joints, rig.q_start)
    assert rig.command_timed_out == 1.0


@pytest.mark.parametrize("arguments", [{"posture": np.full(7, np.nan)}, {"posture": np.array([0.0] * 6 + [np.inf])}])
def test_constructor_refuses_arguments_out_of_range(arm, arguments):
    plant, model = arm
    with pytest.raises(InputError):
        CartesianPositionController(plant, model.target, model.tool_center, **({"posture": READY_POSTURE} | arguments))


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


def test_flags_are_reset_at_initialization(arm):
    rig = Rig(arm, speed_limits=SpeedLimits(translational=2.0, rotational=3.0))
    rig.command(START + [2.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    rig.advance(3.0)
    assert rig.stuck == 1.0
    rig.command(np.full(6, np.nan))
    rig.advance(0.02)
    assert (rig.stuck, rig.command_timed_out) == (1.0, 1.0)
    rig.simulator.Initialize()
    assert (rig.stuck, rig.command_timed_out) == (0.0, 0.0)
    np.testing.assert_array_equal(rig.joints, rig.q_start)


def first_step(arm, monkeypatch, q, velocities, is_regular=True, solution=None):
    """Return the rig after its first step, and the arguments of each call of the solver.

    Args:
        arm: Plant and arm.
        monkeypatch: Pytest's fixture.
        q: Initial joint positions [rad].
        velocities: Joint velocities before the limits are applied [rad/s].
        is_regular: False if the velocities are those of a singular posture.
        solution: Result of the solver; by default, its own result.
    """
    calls, solve = [], cartesian_position_controller.DoDifferentialInverseKinematics

    def record(*arguments):
        calls.append(arguments)
        return solution or solve(*arguments)

    monkeypatch.setattr(cartesian_position_controller, "DoDifferentialInverseKinematics", record)
    monkeypatch.setattr(
        cartesian_position_controller, "damped_joint_velocities", lambda *_: (np.array(velocities), is_regular)
    )
    rig = Rig(arm, q)
    rig.command(GOAL)
    rig.advance(0.005)
    return rig, calls


@pytest.mark.parametrize("share", [0.9, 1.0005, 3.0])
def test_desired_tool_velocity_is_reduced_to_its_limits(arm, monkeypatch, share):
    desired, limits = [], SpeedLimits(translational=0.2, rotational=0.5)
    solve = cartesian_position_controller.damped_joint_velocities

    def record(J, V, preferred):
        desired.append(V)
        return solve(J, V, preferred)

    monkeypatch.setattr(cartesian_position_controller, "damped_joint_velocities", record)
    rig = Rig(arm, speed_limits=limits)
    rig.command(rig.pose + np.array([0.0, 0.002, 0.0, 0.005, 0.0, 0.0]) * share)
    rig.advance(0.005)
    expected = min(share, 1.0) * np.array([0.0, 0.0, 0.5, 0.0, 0.2, 0.0])
    np.testing.assert_allclose(desired[0], expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", [0, 6])
@pytest.mark.parametrize(
    ("steps", "speed", "is_solved"),
    # Steps to the position limit at this speed, and speed as a share of the velocity limit.
    [(10.0, 1.0, False), (10.0, 1.0001, True), (1.01, 0.1, False), (0.99, 0.1, True), (0.0, 0.0, False)],
)
def test_solver_is_called_only_when_a_limit_is_active(arm, monkeypatch, joint, side, steps, speed, is_solved):
    plant = arm[0]
    q, velocities = READY_POSTURE.copy(), np.zeros(7)
    limits = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    velocities[joint] = side * speed * plant.GetVelocityUpperLimits()[joint]
    q[joint] = limits[int(side > 0)][joint] - steps * 0.01 * velocities[joint]
    rig, calls = first_step(arm, monkeypatch, q, velocities)
    assert len(calls) == is_solved
    if not is_solved:
        np.testing.assert_array_equal(rig.joints, np.clip(q + 0.01 * velocities, *limits))
        assert rig.stuck == 0.0
    else:
        np.testing.assert_array_equal(calls[0][-1].get_joint_position_limits(), limits)


def test_joint_command_is_constant_when_the_solver_fails(arm, monkeypatch):
    failure = SimpleNamespace(joint_velocities=None, status=DifferentialInverseKinematicsStatus.kNoSolutionFound)
    rig, calls = first_step(arm, monkeypatch, READY_POSTURE, np.full(7, 100.0), solution=failure)
    assert len(calls) == 1
    np.testing.assert_array_equal(rig.joints, READY_POSTURE)
    assert rig.stuck == 1.0


@pytest.mark.parametrize("speed", [-4.0, -1.0, -0.5, 0.5, 1.0, 4.0])
def test_velocities_have_a_common_scale_in_a_singular_posture(arm, monkeypatch, speed):
    limit = arm[0].GetVelocityUpperLimits()
    velocities = limit * [0.01, speed, 0.02, -0.03, 0.0, 0.0, 0.1]
    rig, calls = first_step(arm, monkeypatch, READY_POSTURE, velocities, is_regular=False)
    expected = READY_POSTURE + 0.01 * velocities / max(1.0, abs(speed))
    np.testing.assert_allclose(rig.joints, expected, rtol=0.0, atol=1e-15)
    assert not calls


# Joint positions [rad] with aligned wrist axes: the tool velocity has only five independent components.
SINGULAR = np.array([-0.2448, -1.3796, 1.8297, -2.021, 0.0, 0.0])


def singular_rig(shift, lower_share=1.0):
    """Return a rig of a UR5e that starts in a singular posture and is commanded to move by `shift` (6,), and its start.

    `lower_share` is a factor of the lower velocity limits.
    """
    model = ArmControllerPlant(BncWorkcell(), "ur5e")
    for index in model.plant.GetJointIndices():
        joint = model.plant.get_joint(index)
        joint.set_velocity_limits(lower_share * joint.velocity_lower_limits(), joint.velocity_upper_limits())
    rig = Rig((model.plant, model.arm), SINGULAR, model.posture)
    start = rig.pose
    rig.command(start + shift)
    return rig, start


@pytest.mark.parametrize("shift", [[0.05, 0, 0, 0, 0, 0], [0, 0.05, 0, 0, 0, 0], [0, 0, 0, 0.3, 0, 0], [0] * 6])
def test_tool_leaves_a_singular_posture_without_a_jump(shift):
    """The orientation deviates temporarily about the direction that the wrist lost, while `stuck` is 1."""
    rig, start = singular_rig(np.array(shift))
    limit = rig.plant.GetVelocityUpperLimits()
    errors, stuck = [], []
    rig.advance(0.005)
    for _ in range(600):
        q = rig.joints
        rig.advance(0.01)
        assert (np.abs(rig.joints - q) / 0.01 <= limit + 1e-6).all()
        errors.append(np.abs(rig.pose - start - shift))
        stuck.append(rig.stuck)
    errors = np.array(errors)
    assert errors[:, :3].max() < np.abs(shift[:3]).max() + 0.005
    assert errors[-1, :3].max() < 2e-3
    assert errors[-1, 3:].max() < 0.05
    assert max(stuck) == float(bool(np.any(shift)))


def test_lower_velocity_limits_apply_in_a_singular_posture():
    rig, _ = singular_rig(np.array([0.05, 0.0, 0.0, 0.3, 0.0, 0.0]), lower_share=0.05)
    lower, min_velocity = rig.plant.GetVelocityLowerLimits(), np.zeros(6)
    rig.advance(0.005)
    for _ in range(60):
        q = rig.joints
        rig.advance(0.01)
        min_velocity = np.minimum(min_velocity, (rig.joints - q) / 0.01)
    assert (min_velocity >= lower - 1e-6).all()
    assert (min_velocity / lower).max() > 0.99  # a joint reached its limit


def test_tool_follows_its_path_near_a_singular_posture():
    """The path leaves the singularity by a rotation about a direction that the wrist has not lost."""
    rig, start = singular_rig(np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0]))
    rig.advance(3.0)
    np.testing.assert_allclose(rig.pose, start + [0, 0, 0, 0, 0.5, 0], atol=1e-4)
    assert rig.stuck == 0.0


@pytest.mark.parametrize("positions", [np.full(7, np.nan), [np.nan] + [0.0] * 6, [0.0] * 6 + [np.inf]])
def test_initialization_fails_when_positions_are_not_finite(arm, positions):
    with pytest.raises(InputError, match="must be finite"):
        Rig(arm, q_start=positions)
