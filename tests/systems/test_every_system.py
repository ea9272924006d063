"""Rules that every LeafSystem of the project satisfies.

The systems of a file are exported, and each has a test file. `oracles.systems` has
the rules of ports, outputs and errors.
"""

import re
from pathlib import Path

import numpy as np
import pytest
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import LeafSystem

import guiderail.systems
from guiderail import systems
from guiderail.diagrams.stations.arm import controller_model
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.control.command_filters import BarrierFilter, KeepOut
from guiderail.models.control.wrench import MovingInertia, WrenchBound
from guiderail.models.laws import Law, StateProgress
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.templates import load_template
from oracles.prerequisites import changed_outputs
from oracles.systems import RULES, check_source, classes, system_names

FOLDER = Path(guiderail.systems.__file__).parent
TESTS = Path(__file__).parent
FILES = sorted(path for path in FOLDER.glob("*.py") if path.stem != "__init__")
PERIOD = 0.125
BOX = LinearConstraints.box([-1.0, -1.0], [1.0, 1.0])


NAMES = [name for path in FILES for name in system_names(path)]


class Repeat(Law):
    """Law that repeats the measured pose."""

    def command(self, state, action, pose, wrench):
        return pose


def primitive(history):
    times = PERIOD * np.arange(20)
    reference = ReferenceTrajectory(times, np.column_stack([times, times]), np.tile(0.01 * np.eye(2), (20, 1, 1)))
    return LcNsKmp(reference, history=history, horizon=4)


@pytest.fixture(scope="module")
def system_by_name():
    """Return one instance of each system by name, with all optional ports."""
    plant, arm = controller_model(BncWorkcell())
    template, frames = load_template("pouring"), {"mug_tip": RigidTransform()}
    body, other = arm.tool[0], plant.world_body()
    gains = systems.ImpedanceGains(np.eye(6), np.ones(6), np.zeros(7))
    condition = systems.TerminationTerm("success", {"u": 2}, lambda u: bool(u[0] > 0.0))
    term = systems.RewardTerm("cost", {"u": 2}, lambda u: float(np.nan_to_num(u[0])))
    instances = [
        systems.ActiveConstraintProjector(template, frames, PERIOD),
        systems.CartesianImpedanceController(plant, arm.target, arm.tool_center, gains, period=PERIOD),
        systems.CartesianPositionController(plant, arm.target, arm.tool_center, posture=np.zeros(7), period=PERIOD),
        systems.CommandDisturbance(2, PERIOD, loss_probability=0.5, delay=1),
        systems.CommandFilter(BarrierFilter(KeepOut([[5.0, 5.0]], [[6.0, 6.0]], BOX, margin=0.0)), PERIOD),
        systems.CommandWatchdog(PERIOD),
        systems.ConstraintViolation(LinearConstraints.box(np.zeros((3, 2)), np.ones((3, 2))), PERIOD),
        systems.ContinuousPose(np.zeros(6), PERIOD),
        systems.CenterOfPressure(0.5),
        systems.MeanContactPoint(0.5, period=PERIOD, time_constant=1.0),
        systems.ImageObservation(4, 3, 2),
        systems.ContactDetector(plant, [body], [other], PERIOD),
        systems.EnergyTank(np.ones(6), np.ones(6), WrenchBound(np.ones(6), 1.0, 1.0), capacity=1.0, period=PERIOD),
        systems.PhaseWrenchLimit(np.ones(8), np.ones(8), period=PERIOD),
        systems.EpisodeMonitor([condition], PERIOD),
        systems.ExternalTorqueSensor(plant, body, np.ones(7), np.ones(7), period=PERIOD),
        systems.HistoryBuffer(2, 3, PERIOD),
        systems.HistoryLengthSchedule([1, 2, 3], PERIOD),
        systems.ForceMonitor(np.ones(6)),
        systems.JointTorqueWrench(plant, arm.target, arm.tool_center, period=PERIOD, time_constant=0.0),
        systems.LawSystem(Repeat(2, 1), 3, PERIOD),
        systems.LcNsKmpSystem(primitive(2), None, PERIOD, [(primitive(1), np.ones(2))]),
        systems.MeanForce(2, 4, PERIOD),
        systems.MeasuredPose(plant, body, RigidTransform()),
        systems.PolicySystem(lambda observation: observation, 2, 2, PERIOD),
        systems.PoseWrench(),
        systems.ProgressClock(StateProgress((1.0, 1.0), 3), 2, PERIOD),
        systems.Recorder({"u": 2}, 4, PERIOD),
        systems.ReferenceGovernor(
            np.ones(6), np.ones(6), MovingInertia(1.0, 1.0), PERIOD, WrenchBound(np.ones(6), 1.0, 1.0)
        ),
        systems.RelativePoses(plant, [body], other),
        systems.Residual(np.ones(2)),
        systems.GripperCommand(np.zeros(2), np.ones(2), np.zeros(2), period=PERIOD),
        systems.PoseFromTransform(),
        systems.TransformFromPose(),
        systems.SpatialForceFromWrench(),
        systems.WrenchFromSpatialForce(),
        systems.RewardSystem([term]),
        systems.SctInputMapping(template, frames, PERIOD),
        systems.SctStateMachine(template, frames, PERIOD),
        systems.SensorDisturbance(PERIOD, np.ones(2), delay=1, configuration_size=2),
        systems.WrenchSensor(plant, arm.wrist, arm.tool, arm.tool_center, RotationMatrix(), PERIOD, 0.0),
        systems.WrenchTare(PERIOD, 3, 5),
    ]
    return {type(instance).__name__: instance for instance in instances}


@pytest.fixture(params=NAMES)
def system(request, system_by_name):
    return system_by_name[request.param]


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_systems_of_a_file_are_exported_and_tested(path):
    assert system_names(path)
    for name in system_names(path):
        assert issubclass(getattr(systems, name), LeafSystem)
        assert (TESTS / f"test_{re.sub(r'(?<!^)(?=[A-Z])', '_', name).lower()}.py").is_file()


def test_support_modules_define_no_system():
    for path in (FOLDER / "support").glob("*.py"):
        assert not system_names(path), path


def test_public_classes_are_exported():
    public = {c.name for path in FILES for c in classes(path) if not c.name.startswith("_")}
    assert public <= set(systems.__all__)
    assert set(systems.__all__) <= set(dir(systems))
    for name in systems.__all__:
        assert getattr(systems, name) is not None
    with pytest.raises(AttributeError, match="Nothing"):
        systems.Nothing  # noqa: B018


def test_these_tests_cover_every_system(system_by_name):
    assert sorted(system_by_name) == sorted(NAMES)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.__name__)
def test_system_satisfies_the_rules(rule, system):
    rule(system)


@pytest.mark.parametrize(
    ("name", "source", "output"),
    [
        ("Residual", "action", "desired_pose"),
        ("ImageObservation", "image", "observation"),
        ("CartesianImpedanceController", "max_wrench", "impedance_wrench"),
        ("PhaseWrenchLimit", "max_wrench", "phase_max_wrench"),
        ("ReferenceGovernor", "max_wrench", "reference_pose"),
        ("ActiveConstraintProjector", "frame_poses", "desired_pose"),
        ("SctInputMapping", "frame_poses", "requested_pose"),
        ("SctInputMapping", "state", "requested_pose"),
        ("ActiveConstraintProjector", "state", "desired_pose"),
        ("SctStateMachine", "state 0", "transition_distance"),
        ("EpisodeMonitor", "u", "termination"),
        ("RewardSystem", "u", "reward"),
        ("GripperCommand", "state 0", "desired_position"),
        ("JointTorqueWrench", "positions", "update"),
        ("HistoryBuffer", "output", "update"),
    ],
)
def test_changes_of_sources_have_an_effect(system_by_name, name, source, output):
    """Without an effect, the comparison above could not notice a missing prerequisite."""
    assert (source, output) in changed_outputs(system_by_name[name])[1]


@pytest.mark.parametrize(
    ("name", "output"),
    [
        ("ActiveConstraintProjector", "last_desired_pose"),
        ("CartesianPositionController", "joint_positions"),
        ("HistoryBuffer", "history"),
        ("JointTorqueWrench", "wrench"),
        ("LawSystem", "desired_pose"),
        ("PolicySystem", "action"),
        ("SctStateMachine", "state"),
        ("WrenchSensor", "wrench"),
    ],
)
def test_output_has_no_direct_feedthrough(system_by_name, name, output):
    """Feedback of these outputs causes no algebraic loop."""
    port = system_by_name[name].GetOutputPort(output)
    assert not system_by_name[name].HasDirectFeedthrough(port.get_index())


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.py")), ids=lambda path: path.stem)
def test_source_gives_prerequisites_and_raises_input_errors(path):
    check_source(path)
