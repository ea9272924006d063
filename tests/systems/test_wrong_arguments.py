"""Constructors of systems refuse arguments of the wrong type, size or plant with one sentence."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, SpatialInertia

from guiderail import systems
from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, ReferenceTrajectory
from guiderail.models.templates import load_template

PERIOD = 0.02
HOLE = {"hole": RigidTransform()}
STIFFNESS = np.diag([600.0] * 3 + [25.0] * 3)
LIMITS = np.array([20.0] * 3 + [2.0] * 3)
GAINS = systems.ImpedanceGains(STIFFNESS, LIMITS, posture=np.zeros(6))


def gantry(*, finalize=True):
    """Return a plant of three prismatic and three revolute axes with a welded hand, and the last axis's body."""
    plant = MultibodyPlant(0.0)
    parent = plant.world_body()
    for i, axis in enumerate([*np.eye(3), *np.eye(3)[::-1]]):
        child = plant.AddRigidBody(f"body{i}", SpatialInertia.SolidSphereWithMass(0.5, 0.04))
        kind = PrismaticJoint if i < 3 else RevoluteJoint
        joint = plant.AddJoint(kind(f"joint{i}", parent.body_frame(), child.body_frame(), axis))
        plant.AddJointActuator(f"motor{i}", joint, 100.0)
        parent = child
    hand = plant.AddRigidBody("hand", SpatialInertia.SolidSphereWithMass(0.1, 0.02))
    plant.WeldFrames(parent.body_frame(), hand.body_frame())
    if finalize:
        plant.Finalize()
    return plant, parent


def make_wrench_sensor(*, wrist=None, tool=None, center=None, axes=None, period=PERIOD, time_constant=0.1):
    axes = RotationMatrix() if axes is None else axes
    tool = [TOOL, HAND] if tool is None else tool
    return systems.WrenchSensor(PLANT, wrist or JOINT, tool, center or FRAME, axes, period, time_constant)


def primitive(history=0):
    times = PERIOD * np.arange(50)
    means = np.column_stack([0.1 * np.sin(times), 0.1 * times])
    reference = ReferenceTrajectory(times, means, np.tile(1e-3 * np.eye(2), (50, 1, 1)))
    return LcNsKmp(reference, horizon=8, history=history)


PLANT, TOOL = gantry()
_, OTHER_TOOL = gantry()
DRAFT, DRAFT_TOOL = gantry(finalize=False)  # a plant that is not finalized
WORLD, FRAME = PLANT.world_frame(), TOOL.body_frame()


@pytest.mark.parametrize(
    ("plant", "target", "tool", "gains", "message"),
    [
        (PLANT, FRAME, FRAME, GAINS, "can move: give a frame that is fixed in the world"),
        (PLANT, WORLD, OTHER_TOOL.body_frame(), GAINS, "tool_center is the frame body5 of another plant"),
        (PLANT, WORLD, TOOL, GAINS, "tool_center is a frame of the plant, such as body.body_frame"),
        (DRAFT, DRAFT.world_frame(), DRAFT_TOOL.body_frame(), GAINS, "must be finalized"),
        (None, WORLD, FRAME, GAINS, "a plant is a MultibodyPlant, not None"),
        (PLANT, WORLD, FRAME, STIFFNESS, "the gains of an impedance are ImpedanceGains"),
    ],
)
def test_impedance_refuses_wrong_arguments(plant, target, tool, gains, message):
    with pytest.raises(InputError, match=message):
        systems.CartesianImpedanceController(plant, target, tool, gains, period=PERIOD)


def test_impedance_refuses_a_stiffness_frame_of_another_plant():
    with pytest.raises(InputError, match="stiffness_frame is the frame body5 of another plant"):
        systems.CartesianImpedanceController(
            PLANT, WORLD, FRAME, GAINS, period=PERIOD, stiffness_frame=OTHER_TOOL.body_frame()
        )


def test_controller_and_wrench_refuse_frames_of_another_plant():
    with pytest.raises(InputError, match="of another plant"):
        systems.CartesianPositionController(PLANT, WORLD, OTHER_TOOL.body_frame(), posture=np.zeros(6))
    with pytest.raises(InputError, match="of another plant"):
        systems.JointTorqueWrench(PLANT, WORLD, OTHER_TOOL.body_frame(), period=PERIOD, time_constant=0.0)


BODY, OTHER = PLANT.GetBodyByName("body0"), OTHER_TOOL
JOINT, HAND = PLANT.GetJointByName("joint5"), PLANT.GetBodyByName("hand")
ZEROS = np.zeros(6)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: systems.ContactDetector(PLANT, [OTHER], [BODY], PERIOD), "the body body5 of another plant"),
        (lambda: systems.ContactDetector(PLANT, [TOOL], [], PERIOD), "obstacles is a list of at least one body"),
        (lambda: systems.ContactDetector(PLANT, TOOL, [BODY], PERIOD), "bodies is a list of at least one body"),
        (lambda: systems.ContactDetector(DRAFT, [DRAFT_TOOL], [DRAFT_TOOL], PERIOD), "must be finalized"),
        (lambda: systems.MeasuredPose(PLANT, OTHER, RigidTransform()), "the body body5 of another plant"),
        (lambda: systems.MeasuredPose(PLANT, FRAME, RigidTransform()), "body has bodies of the plant"),
        (lambda: systems.MeasuredPose(PLANT, TOOL, np.eye(4)), "X_WT is a RigidTransform"),
        (lambda: systems.RelativePoses(PLANT, [FRAME], BODY), "bodies has bodies of the plant"),
        (lambda: systems.RelativePoses(PLANT, [TOOL], OTHER), "reference has the body body5 of another plant"),
        (lambda: systems.ExternalTorqueSensor(PLANT, OTHER, ZEROS, ZEROS, period=PERIOD), "of another plant"),
        (lambda: systems.ExternalTorqueSensor(PLANT, WORLD.body(), ZEROS, ZEROS, period=PERIOD), "is the world"),
        (lambda: make_wrench_sensor(tool=[OTHER, HAND]), "tool has the body body5 of another plant"),
        (lambda: make_wrench_sensor(tool=TOOL), "tool is a list of at least one body"),
        (lambda: make_wrench_sensor(tool=[TOOL]), "welded to it: add hand"),
        (lambda: make_wrench_sensor(wrist="joint5"), "a wrist is a joint of the plant, not 'joint5'"),
        (lambda: make_wrench_sensor(center=WORLD), "the center world must be fixed to a body"),
        (lambda: make_wrench_sensor(axes=RigidTransform()), "R_WAxes is a RotationMatrix"),
    ],
)
def test_systems_refuse_wrong_bodies(build, message):
    with pytest.raises(InputError, match=message):
        build()


@pytest.mark.parametrize("limits", [np.inf * LIMITS, "a", None])
def test_gains_refuse_wrong_limits(limits):
    with pytest.raises(InputError, match="wrench limits"):
        systems.ImpedanceGains(STIFFNESS, limits, posture=np.zeros(6))


def test_gains_refuse_a_stiffness_of_text():
    with pytest.raises(InputError, match="a Cartesian stiffness is not an array of numbers"):
        systems.ImpedanceGains("a", LIMITS, posture=np.zeros(6))


@pytest.mark.parametrize("kind", [systems.SctInputMapping, systems.ActiveConstraintProjector, systems.SctStateMachine])
@pytest.mark.parametrize(
    ("template", "frames", "message"),
    [
        ("grid_clamp.yaml", HOLE, "a template is a SharedControlTemplate"),
        (None, None, "poses by name, not None"),
        (None, ["hole"], "poses by name"),
        (None, {"hole": np.zeros(6)}, "the frame hole is a RigidTransform"),
        (None, {"hole": np.eye(4)}, "the frame hole is a RigidTransform"),
        (None, {**HOLE, "world": RigidTransform([1.0, 0.0, 0.0])}, "world of a template can't be moved"),
    ],
)
def test_template_systems_refuse_wrong_arguments(kind, template, frames, message):
    with pytest.raises(InputError, match=message):
        kind(template or load_template("grid_clamp"), frames, PERIOD)


def test_state_machine_refuses_a_start_that_is_not_finite():
    machine = systems.SctStateMachine(load_template("grid_clamp"), HOLE, PERIOD)
    context = machine.CreateDefaultContext()
    machine.get_initial_pose_input_port().FixValue(context, np.full(6, np.nan))
    with pytest.raises(InputError, match="must be finite"):
        machine.ExecuteInitializationEvents(context)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((None, None, PERIOD), "is an LcNsKmp, not None"),
        ((primitive(), "a", PERIOD), "the gain is not an array of numbers"),
        ((primitive(3), None, PERIOD, [primitive(1)]), "shorter is a list of primitives with their gains"),
        ((primitive(3), None, PERIOD, [(None, np.ones(2))]), "is an LcNsKmp, not None"),
    ],
)
def test_primitive_system_refuses_wrong_arguments(arguments, message):
    with pytest.raises(InputError, match=message):
        systems.LcNsKmpSystem(*arguments)


@pytest.mark.parametrize(("outputs", "length"), [(1001, 1000), (1000, 1001)])
def test_history_refuses_sizes_beyond_its_limit(outputs, length):
    with pytest.raises(InputError, match="at most 1000000 numbers"):
        systems.HistoryBuffer(outputs, length, PERIOD)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: systems.RewardSystem(lambda pose: 0.0), "a reward needs a list of RewardTerm objects"),
        (lambda: systems.RewardSystem([lambda pose: 0.0]), "a reward needs a list of RewardTerm objects"),
        (lambda: systems.EpisodeMonitor(["success"], PERIOD), "a monitor needs a list of TerminationTerm objects"),
        (lambda: systems.Recorder(["pose"], 4, PERIOD), "signals are sizes by name"),
        (lambda: systems.Recorder({1: 6}, 4, PERIOD), "a signal needs a name, not 1"),
        (lambda: systems.ForceMonitor({}), "limits is not an array of numbers"),
        (lambda: systems.GripperCommand("a", [1.0], [1.0], period=PERIOD), "lower is not an array of numbers"),
        (lambda: systems.Residual("a"), "gain is not an array of numbers"),
        (lambda: systems.SensorDisturbance(PERIOD, "a"), "noise is not an array of numbers"),
        (lambda: systems.CommandWatchdog(PERIOD, timeout=None), "timeout must be a number, not None"),
        (lambda: systems.CommandWatchdog("a"), "a system's period must be a number, not 'a'"),
        (lambda: systems.CommandWatchdog(PERIOD, pose_size="6"), "pose_size must be a whole number"),
        (lambda: systems.HistoryLengthSchedule([1], PERIOD, dwell_steps=np.nan), "dwell_steps must be a whole"),
        (lambda: make_wrench_sensor(period="a"), "a system's period must be a number, not 'a'"),
        (lambda: make_wrench_sensor(time_constant=None), "time_constant must be a number, not None"),
        (
            lambda: systems.PolicySystem(lambda y: y, None, 2, PERIOD),
            "the size of an observation must be",
        ),
    ],
)
def test_systems_refuse_arguments_of_another_type(build, message):
    with pytest.raises(InputError, match=message):
        build()
