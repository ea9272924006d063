from dataclasses import replace

import numpy as np
import pytest
from pydrake.math import RigidTransform
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource, LogVectorOutput

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import transform_to_pose
from guiderail.models.templates import load_template
from guiderail.systems.shared_control_template import SctStateMachine
from guiderail.systems.wrench_limits import PhaseWrenchLimit

PERIOD = 2.0**-7
FRAMES = {"mug_tip": RigidTransform([0.0, 0.1, 0.0])}


def pose_at(distance):
    """Return a pose at this distance [m] in front of the mug."""
    return np.array([0.0, 0.1 - distance, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def template():
    return load_template("pouring")


class Rig:
    """State machine that starts at a distance from the mug [m]."""

    def __init__(self, template, start):
        self.system = SctStateMachine(template, FRAMES, PERIOD)
        self.simulator = Simulator(self.system)
        self.context = self.simulator.get_mutable_context()
        self.system.get_initial_pose_input_port().FixValue(self.context, pose_at(start))
        self.pose = self.system.get_pose_input_port().FixValue(self.context, pose_at(start))
        self.simulator.Initialize()
        self.steps = 0

    def step(self, distance):
        """Set the distance from the mug [m], run the events of the next instant, and return the state."""
        self.pose.GetMutableData().set_value(pose_at(distance))
        self.steps += 1
        self.simulator.AdvanceTo((self.steps + 0.5) * PERIOD)
        return self.state()

    def state(self):
        return int(self.system.get_state_output_port().Eval(self.context)[0])


@pytest.mark.parametrize(("start", "state"), [(0.4, 0), (0.2, 1), (0.05, 2)])
def test_state_machine_begins_in_the_state_of_the_initial_pose(template, start, state):
    assert Rig(template, start).state() == state


def test_first_state_is_not_that_of_the_commanded_pose(template):
    """At initialization the commanded pose may still be that of the last episode."""
    rig = Rig(template, 0.2)
    rig.pose.GetMutableData().set_value(pose_at(0.4))
    rig.simulator.Initialize()
    assert rig.state() == 1


def test_state_machine_returns_with_hysteresis(template):
    rig = Rig(template.without_active_constraints(), 0.4)
    assert [rig.step(d) for d in (0.26, 0.24, 0.26, 0.28, 0.24, 0.10, 0.07, 0.10, 0.40)] == [0, 1, 1, 0, 1, 1, 2, 2, 2]


def test_state_machine_makes_at_most_one_transition_per_instant(template):
    rig = Rig(template.without_active_constraints(), 0.4)
    assert [rig.step(0.05) for _ in range(3)] == [1, 2, 2]


def test_transition_waits_until_the_constraints_are_reachable(template):
    """The rotation of an upright thermos to the tilt of pouring takes longer than a period."""
    rig = Rig(template, 0.2)
    X_WE = RigidTransform(pose_at(0.05)[:3])
    tilted = template.project(2, X_WE, FRAMES)
    assert not template.can_enter(2, X_WE, FRAMES, PERIOD)
    assert [rig.step(0.05) for _ in range(3)] == [1, 1, 1]
    rig.pose.GetMutableData().set_value(transform_to_pose(tilted))
    rig.steps += 1
    rig.simulator.AdvanceTo((rig.steps + 0.5) * PERIOD)
    assert rig.state() == 2


def test_distance_and_progress_equal_those_of_the_template(template):
    rig = Rig(template, 0.4)
    rig.step(0.24)
    X_WE = RigidTransform(pose_at(0.24)[:3])
    assert rig.system.get_transition_distance_output_port().Eval(rig.context)[0] == pytest.approx(0.24)
    progress = rig.system.get_progress_output_port().Eval(rig.context)[0]
    assert progress == pytest.approx(template.progress(1, X_WE, FRAMES))
    # The progress increases by 5 per meter from a distance of 0.40 m and is continuous at the transition.
    assert progress == pytest.approx(5.0 * (0.40 - 0.24))


def limited(template, **limits):
    """Return the template with limits of force and torque in its second state."""
    first, second, *others = template.states
    return replace(template, states=(first, replace(second, **limits), *others))


class Reader(LeafSystem):
    """System that reads its input in its initialization, as a controller does."""

    def __init__(self):
        super().__init__()
        port = self.DeclareVectorInputPort("max_wrench", 8)
        self._state = self.DeclareDiscreteState(8)
        self.DeclareInitializationDiscreteUpdateEvent(
            lambda context, state: state.set_value(self._state, port.Eval(context))
        )


def add_machine(builder, template, start=0.2):
    machine = builder.AddNamedSystem("machine", SctStateMachine(template, FRAMES, PERIOD))
    pose = builder.AddSystem(ConstantVectorSource(pose_at(start)))
    builder.Connect(pose.get_output_port(), machine.get_pose_input_port())
    builder.Connect(pose.get_output_port(), machine.get_initial_pose_input_port())
    return machine


@pytest.mark.parametrize(("start", "state"), [(0.4, 0), (0.2, 1)])
def test_limit_is_that_of_the_state_from_the_start_on(template, start, state):
    template = limited(template, max_force_n=12.0)
    builder = DiagramBuilder()
    machine, reader = add_machine(builder, template, start), builder.AddSystem(Reader())
    builder.Connect(machine.get_max_wrench_output_port(), reader.get_input_port())
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    context = machine.GetMyContextFromRoot(simulator.get_context())
    limit = machine.get_max_wrench_output_port().Eval(context)
    np.testing.assert_array_equal(limit, template.max_wrench(state))
    assert np.isinf(limit[6]) == (state == 0)
    assert not machine.HasDirectFeedthrough(machine.get_max_wrench_output_port().get_index())


@pytest.mark.parametrize("limits", [{"max_force_n": 12.0}, {"max_torque_nm": 1.0}])
@pytest.mark.parametrize("is_cached", [True, False])
def test_limit_that_nothing_reads_is_refused_at_each_initialization(template, limits, is_cached):
    builder = DiagramBuilder()
    machine = add_machine(builder, limited(template, **limits))
    simulator = Simulator(builder.Build())
    if not is_cached:
        simulator.get_mutable_context().DisableCaching()
    sentence = r"connect the output max_wrench of 'machine' to the controller's input max_wrench"
    for _ in range(2):
        with pytest.raises(InputError, match=sentence):
            simulator.Initialize()
        # What a person evaluates does not count.
        machine.get_max_wrench_output_port().Eval(machine.GetMyContextFromRoot(simulator.get_context()))


@pytest.mark.parametrize("is_cached", [True, False])
def test_limit_that_a_system_reads_is_accepted(template, is_cached):
    builder = DiagramBuilder()
    machine, reader = add_machine(builder, limited(template, max_force_n=12.0)), builder.AddSystem(Reader())
    builder.Connect(machine.get_max_wrench_output_port(), reader.get_input_port())
    simulator = Simulator(builder.Build())
    if not is_cached:
        simulator.get_mutable_context().DisableCaching()
    for _ in range(2):
        simulator.Initialize()
    simulator.AdvanceTo(3 * PERIOD)


def test_limit_of_a_nested_diagram_is_read_by_a_phase_wrench_limit(template):
    inner, builder = DiagramBuilder(), DiagramBuilder()
    machine = add_machine(inner, limited(template, max_force_n=12.0))
    inner.ExportOutput(machine.get_max_wrench_output_port(), "max_wrench")
    nested = builder.AddSystem(inner.Build())
    limit = builder.AddSystem(PhaseWrenchLimit(np.full(8, 40.0), np.full(8, 100.0), period=PERIOD))
    builder.Connect(nested.GetOutputPort("max_wrench"), limit.get_state_max_wrench_input_port())
    LogVectorOutput(limit.get_phase_max_wrench_output_port(), builder, PERIOD)
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(4 * PERIOD)
    context = limit.GetMyContextFromRoot(simulator.get_context())
    assert limit.get_phase_max_wrench_output_port().Eval(context)[6] < 12.0
