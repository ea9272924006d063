"""Ports and hooks for loggers and visualizers: `before_build`, `contact_results` and the monitor of a simulation."""

import gymnasium
import numpy as np
import pytest
from pydrake.multibody.plant import ContactResults
from pydrake.systems.analysis import Simulator, SimulatorStatus
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput, VectorLogSink

import guiderail  # noqa: F401 (registers the environments)
from guiderail.diagrams.envs.make import make_env, make_skill
from guiderail.diagrams.envs.scene import View, contact_forces
from guiderail.systems import EpisodeMonitor, TerminationTerm


def log_pose(builder):
    LogVectorOutput(builder.GetSubsystemByName("station").get_pose_output_port(), builder, 0.02).set_name("log")


def test_logger_added_before_build_records_an_episode():
    env = gymnasium.make("guiderail/GridClamp-v0", guidance="sct", before_build=log_pose, action_repeat=1).unwrapped
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(3))
    log = env.diagram.diagram.GetSubsystemByName("log")
    assert isinstance(log, VectorLogSink)
    data = log.FindLog(env.simulator.get_context()).data()
    np.testing.assert_array_equal(data[:, 1:].T, env.trace.measured)
    assert data.shape == (6, 6)  # the start, then the end of each step


def test_diagram_with_additional_systems_is_not_shared():
    first = make_env("GridClamp", guidance="sct", before_build=log_pose)
    first.close()
    assert not make_env("GridClamp", guidance="sct").diagram.diagram.HasSubsystemNamed("log")


def test_skill_takes_additional_systems():
    skill = make_skill("GridClamp", lambda observation: np.zeros(3), guidance="sct", before_build=log_pose)
    assert skill.diagram.HasSubsystemNamed("log")


@pytest.mark.parametrize(
    ("task", "options"),
    [
        ("GridClamp", {"station": "gantry"}),
        ("GridClamp", {"station": "arm"}),
        ("GridClamp", {"station": "gantry", "sensing": "robot"}),
        ("NarrowPassage", {}),
        ("Pouring", {}),
    ],
)
def test_station_exports_contact_results(task, options):
    env = make_env(task, **options)
    env.reset(seed=0)
    env.step(np.zeros(env.action_space.shape))
    port = env.diagram.contact_results
    results = port.Eval(port.get_system().GetMyContextFromRoot(env.simulator.get_context()))
    assert isinstance(results, ContactResults)


def press(env, on_step):
    """Press the clamp onto the grid until it collides or the episode ends."""
    env.reset(seed=0)
    for _ in range(60):
        _, _, terminated, truncated, _ = env.step(np.array([0.3, 0.0, -1.0]))
        on_step(env.simulator.get_context())
        if terminated or truncated:
            return


def test_contact_forces_are_sorted_and_plausible():
    env = make_env("GridClamp", guidance="sct", action_repeat=5)
    port, largest = env.diagram.contact_results, []

    def measure(context):
        found = contact_forces(port.Eval(port.get_system().GetMyContextFromRoot(context)))
        norms = np.linalg.norm(found[:, 3:], axis=1)
        assert (np.diff(norms) <= 0.0).all()
        largest.append(norms.max(initial=0.0))

    press(env, measure)
    assert 0.5 < max(largest) < 30.0
    assert env.trace.signals["contact_force"].max() < 5 * max(largest)  # at most five pegs


def test_view_draws_contacts(monkeypatch):
    monkeypatch.setenv("DRAKE_ALLOW_NETWORK", "meshcat")
    env = make_env("GridClamp", guidance="sct", action_repeat=5)
    view = View(env.diagram.query, contact_results=env.diagram.contact_results)
    press(env, view.publish)
    assert view.meshcat.HasPath("/drake/contact_forces/hydroelastic")


def test_monitor_ends_a_simulation_with_its_reason():
    builder = DiagramBuilder()
    source = builder.AddSystem(ConstantVectorSource(np.zeros(1)))
    period = 0.02
    terms = [TerminationTerm("success", {"x": 1}, lambda x: bool(x[0] > 0.0), steps=3)]
    monitor = builder.AddSystem(EpisodeMonitor(terms, period))
    builder.Connect(source.get_output_port(), monitor.get_signal_input_port("x"))
    LogVectorOutput(source.get_output_port(), builder, period / 4)  # steps within a control step
    simulator = Simulator(builder.Build())
    simulator.set_monitor(monitor.monitor)
    assert simulator.AdvanceTo(1.0).reason() == SimulatorStatus.ReturnReason.kReachedBoundaryTime
    context = simulator.get_mutable_context()
    source.get_mutable_source_value(source.GetMyMutableContextFromRoot(context)).SetFromVector([1.0])
    status = simulator.AdvanceTo(2.0)
    assert status.reason() == SimulatorStatus.ReturnReason.kReachedTerminationCondition
    assert "success" in status.FormatMessage()
    assert context.get_time() == pytest.approx(1.0 + 2 * period)  # the step that ends at 1 s is the first of three
