"""Rules that every LeafSystem of the project satisfies.

- A file defines one exported system with the name of the file, and the system has a test file.
- Each port has a typed and documented getter, and the docstring of the class lists all ports.
- Outputs declare their prerequisites and depend only on inputs, parameters and discrete state.
- The source raises only `InputError`, `PolicyError`, `DivergedError` and `AttributeError`.
"""

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.systems.framework import CacheIndex, DiscreteStateIndex, InputPort, LeafSystem, OutputPort, ValueProducer

import guiderail.systems
from guiderail import systems
from guiderail.diagrams.stations.arm import controller_model
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.control.command_filters import BarrierFilter
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.control.wrench import WrenchBound
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.stepper import StateProgress
from guiderail.models.templates import load_template
from oracles.prerequisites import changed_outputs

FOLDER = Path(guiderail.systems.__file__).parent
TESTS = Path(__file__).parent
FILES = sorted(path for path in FOLDER.glob("*.py") if path.stem != "__init__")
PERIOD = 0.125
BOX = LinearConstraints.box([-1.0, -1.0], [1.0, 1.0])


def classes(path):
    """Return the syntax trees of the classes of a file."""
    return [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)]


def system_names(path):
    """Return the names of the classes of a file that derive from LeafSystem."""
    return [c.name for c in classes(path) if any(isinstance(b, ast.Name) and b.id == "LeafSystem" for b in c.bases)]


NAMES = [name for path in FILES for name in system_names(path)]


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
    condition = systems.TerminationTerm("success", {"u": 2}, lambda u: False)
    term = systems.RewardTerm("cost", {"u": 2}, lambda u: 0.0)
    instances = [
        systems.ActiveConstraintProjector(template, frames, PERIOD),
        systems.CartesianImpedanceController(plant, arm.target, arm.tool_center, gains, period=PERIOD),
        systems.CartesianPositionController(plant, arm.target, arm.tool_center, posture=np.zeros(7), period=PERIOD),
        systems.CommandDisturbance(2, PERIOD, loss_probability=0.5, delay=1),
        systems.CommandFilter(BarrierFilter(KeepOut([[5.0, 5.0]], [[6.0, 6.0]], BOX, margin=0.0)), PERIOD),
        systems.CommandWatchdog(PERIOD),
        systems.ConstraintViolation(LinearConstraints.box(np.zeros((3, 2)), np.ones((3, 2))), PERIOD),
        systems.CenterOfPressure(0.5),
        systems.ImageObservation(4, 3, 2),
        systems.ContactDetector(plant, [body], [other], PERIOD),
        systems.EnergyTank(np.ones(6), np.ones(6), WrenchBound(np.ones(6), 1.0, 1.0), capacity=1.0, period=PERIOD),
        systems.PhaseWrenchLimit(np.ones((2, 8)), np.ones(8), period=PERIOD),
        systems.EpisodeMonitor([condition], PERIOD),
        systems.ExternalTorqueSensor(plant, body, np.ones(7), np.ones(7), period=PERIOD),
        systems.FunctionGuidanceSystem(lambda action, pose, wrench: pose, 1, 2, 3, PERIOD),
        systems.HistoryBuffer(2, 3, PERIOD),
        systems.HistoryLengthSchedule([1, 2], PERIOD),
        systems.ImpedanceMonitor(np.ones(6)),
        systems.JointTorqueWrench(plant, arm.target, arm.tool_center, period=PERIOD, time_constant=0.0),
        systems.LcNsKmpSystem(primitive(2), None, PERIOD, [(primitive(1), np.ones(2))]),
        systems.MeanForce(2, 4, PERIOD),
        systems.MeasuredPose(plant, body, RigidTransform()),
        systems.PolicySystem(lambda observation: observation, 2, 2, PERIOD),
        systems.PoseWrench(),
        systems.ProgressClock(StateProgress((1.0, 1.0), 3), 2, PERIOD),
        systems.Recorder({"u": 2}, 4, PERIOD),
        systems.ReferenceGovernor(np.ones(6), np.ones(6), 1.0, PERIOD, WrenchBound(np.ones(6), 1.0, 1.0)),
        systems.RelativePoses(plant, [body], other),
        systems.Residual(np.ones(2)),
        systems.RewardSystem([term]),
        systems.SafetyFilter(KeepOut([[5.0, 5.0]], [[6.0, 6.0]], BOX, margin=0.0), PERIOD),
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


def ports(system):
    """Yield kind ("input" or "output"), name and port of each port of a system."""
    for kind in ("input", "output"):
        for index in range(getattr(system, f"num_{kind}_ports")()):
            port = getattr(system, f"get_{kind}_port")(index)
            yield kind, port.get_name(), port


def getters(system, kind):
    """Return the getters of ports of a kind that the class of the system defines, by name."""
    return {name: getattr(system, name) for name in vars(type(system)) if re.fullmatch(rf"get_\w+_{kind}_port", name)}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_file_has_one_exported_and_tested_system(path):
    (name,) = system_names(path)
    assert re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower() == path.stem
    assert issubclass(getattr(systems, name), LeafSystem)
    assert (TESTS / f"test_{path.stem}.py").is_file()


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


def test_importing_one_system_does_not_import_the_others():
    program = "import sys; from guiderail.systems import Recorder; print('sklearn' in sys.modules)"
    finished = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert finished.stdout.strip() == "False"


def test_these_tests_cover_every_system(system_by_name):
    assert sorted(system_by_name) == sorted(NAMES)


def test_every_port_has_a_documented_getter(system):
    for kind, name, port in ports(system):
        methods = getters(system, kind)
        method = methods.get(f"get_{name}_{kind}_port")
        if method is not None:
            result = method()
        else:
            # Ports whose names are constructor arguments share a getter with the argument `name`.
            (method,) = (m for m in methods.values() if "name" in inspect.signature(m).parameters)
            result = method(name)
        assert result is port
        assert inspect.signature(method).return_annotation is (InputPort if kind == "input" else OutputPort)
        assert inspect.getdoc(method)


def test_documented_ports_are_the_declared_ports(system):
    (block,) = re.findall(r"\.\. pydrake_system::\n\n((?:    .*\n)+)", inspect.getdoc(type(system)) + "\n")
    assert re.search(r"name: (\w+)", block)[1] == type(system).__name__
    for kind in ("input", "output"):
        documented = re.search(rf"{kind}_ports:\n((?: *- .*\n)+)", block)
        lines = re.findall(r"- (.*)", documented[1]) if documented else []
        actual = [name for k, name, _ in ports(system) if k == kind]
        named = [line.split(" (")[0] for line in lines if not line.startswith("one per ")]
        assert actual[: len(named)] == named
        assert len(actual) == len(named) or len(named) < len(lines)


def test_output_depends_only_on_declared_prerequisites(system):
    """Default prerequisites would cause an evaluation at every plant step and false direct feedthrough."""
    nothing, parameters = system.nothing_ticket(), system.all_parameters_ticket()
    probe = system.DeclareCacheEntry(
        "probe", ValueProducer(allocate=lambda: Value(0), calc=lambda context, value: None), {nothing}
    )
    entries = [system.get_cache_entry(CacheIndex(i)) for i in range(int(probe.cache_index()))]
    declared = {int(e.ticket()): e for e in entries if int(e.ticket()) > int(system.configuration_ticket())}
    sources = {int(nothing), int(parameters)}
    sources |= {int(port.ticket()) for kind, _, port in ports(system) if kind == "input"}
    states = range(system.CreateDefaultContext().num_discrete_state_groups())
    sources |= {int(system.discrete_state_ticket(DiscreteStateIndex(i))) for i in states}
    outputs = [e for e in entries if e.description().startswith("output port ")]
    assert len(outputs) == system.num_output_ports()
    pending = list(outputs)
    while pending:
        entry = pending.pop()
        assert not entry.has_default_prerequisites(), entry.description()
        for ticket in map(int, entry.prerequisites()):
            if ticket in declared:
                pending.append(declared[ticket])
            else:
                assert ticket in sources, f"{entry.description()} depends on ticket {ticket}"


def test_outputs_follow_every_source(system):
    """A missing prerequisite is a stale output after a change of this source on the same context."""
    stale, _ = changed_outputs(system)
    assert not stale


@pytest.mark.parametrize(
    ("name", "source", "output"),
    [
        ("Residual", "action", "desired_pose"),
        ("ImageObservation", "image", "observation"),
        ("CartesianImpedanceController", "max_wrench", "impedance_wrench"),
        ("PhaseWrenchLimit", "max_wrench", "phase_max_wrench"),
        ("ReferenceGovernor", "max_wrench", "reference_pose"),
        ("ActiveConstraintProjector", "parameter 0", "desired_pose"),
        ("SctInputMapping", "parameter 0", "requested_pose"),
    ],
)
def test_changes_of_sources_have_an_effect(system_by_name, name, source, output):
    """Without an effect, the comparison above could not notice a missing prerequisite."""
    assert (source, output) in changed_outputs(system_by_name[name])[1]


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.py")), ids=lambda path: path.stem)
def test_source_gives_prerequisites_and_raises_input_errors(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            name = node.func.attr
            if name in ("DeclareVectorOutputPort", "DeclareAbstractOutputPort", "DeclareCacheEntry"):
                assert "prerequisites_of_calc" in {keyword.arg for keyword in node.keywords}, f"line {node.lineno}"
        if isinstance(node, ast.Raise) and isinstance(node.exc, ast.Call):
            exceptions = ("InputError", "PolicyError", "DivergedError", "AttributeError")
            assert node.exc.func.id in exceptions, f"line {node.lineno}"
