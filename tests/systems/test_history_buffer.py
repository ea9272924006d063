import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, LeafSystem
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import nearest_pose
from guiderail.models.primitives import Demonstrations, LcNsKmp, ReferenceTrajectory
from guiderail.systems.movement_primitive import HistoryBuffer, LcNsKmpSystem


class Counter(LeafSystem):
    """Output the number of the current period, as a movement primitive outputs the command of its step."""

    def __init__(self, period):
        super().__init__()
        self.period = period
        self.state = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("count", self.state)
        self.DeclarePeriodicDiscreteUpdateEvent(period, 0.0, self.advance)

    def advance(self, context, state):
        state.set_value([round(context.get_time() / self.period)])


def test_history_of_length_one_is_the_last_output():
    system = HistoryBuffer(1, 1, 0.1)
    simulator = Simulator(system)
    port = system.get_output_input_port().FixValue(simulator.get_mutable_context(), [3.0])
    system.get_initial_output_input_port().FixValue(simulator.get_mutable_context(), [3.0])
    simulator.Initialize()
    assert system.get_history_output_port().Eval(simulator.get_context()) == [3.0]
    port.GetMutableData().set_value([4.0])
    simulator.AdvanceTo(0.15)
    assert system.get_history_output_port().Eval(simulator.get_context()) == [4.0]


@pytest.fixture
def system():
    return HistoryBuffer(num_outputs=2, length=3, period=0.1)


def history(system, context):
    """Return the history (3, 2), the oldest output first."""
    return system.get_history_output_port().Eval(context).reshape(3, 2)


def test_history_without_initialization_is_refused(system):
    context = system.CreateDefaultContext()
    with pytest.raises(InputError, match=r"call Simulator\.Initialize\(\)"):
        history(system, context)


@pytest.mark.parametrize("inputs", [{"initial_output": np.nan}, {"output": 1.0, "initial_output": np.inf}])
def test_output_that_fills_the_history_must_be_finite(system, inputs):
    simulator = Simulator(system)
    for name, value in inputs.items():
        system.GetInputPort(name).FixValue(simulator.get_mutable_context(), [0.0, value])
    with pytest.raises(InputError, match="must be finite"):
        simulator.Initialize()


def test_initialization_fails_without_initial_output(system):
    """The first command would otherwise be far from the tool."""
    with pytest.raises(RuntimeError, match=r"initial_output.* is not connected"):
        Simulator(system).Initialize()


def test_history_is_filled_with_initial_output(system):
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_output_input_port().FixValue(context, [1.0, -2.0])
    system.get_initial_output_input_port().FixValue(context, [5.0, 6.0])
    simulator.Initialize()
    np.testing.assert_array_equal(history(system, context), [[5.0, 6.0]] * 3)
    simulator.AdvanceTo(0.15)
    np.testing.assert_array_equal(history(system, context), [[5.0, 6.0], [5.0, 6.0], [1.0, -2.0]])


def test_newest_output_replaces_the_oldest(system):
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    port = system.get_output_input_port().FixValue(context, [0.0, 0.0])
    system.get_initial_output_input_port().FixValue(context, [0.0, 0.0])
    simulator.Initialize()
    for k in range(1, 5):
        port.GetMutableData().set_value([k, -k])
        simulator.AdvanceTo(0.1 * k + 0.05)
    np.testing.assert_array_equal(history(system, context), [[2, -2], [3, -3], [4, -4]])


@pytest.mark.parametrize("period", [1 / 3, 0.007])
def test_each_command_is_stored_exactly_once(period):
    builder = DiagramBuilder()
    counter = builder.AddSystem(Counter(period))
    buffer = builder.AddSystem(HistoryBuffer(1, 2, period))
    builder.Connect(counter.get_output_port(), buffer.get_output_input_port())
    builder.Connect(counter.get_output_port(), buffer.get_initial_output_input_port())
    simulator = Simulator(builder.Build())
    context = buffer.GetMyContextFromRoot(simulator.get_context())
    simulator.Initialize()
    for n in range(1, 400):
        simulator.AdvanceTo((n + 0.5) * period)
        # After instant n, the newest stored command is n − 1.
        assert buffer.get_history_output_port().Eval(context)[-1] == n - 1


def test_initialization_fills_the_history_again(system):
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    pristine = system.CreateDefaultContext()
    system.get_output_input_port().FixValue(context, [1.0, 1.0])
    port = system.get_initial_output_input_port().FixValue(context, [1.0, 1.0])
    simulator.Initialize()
    simulator.AdvanceTo(1.05)
    context.SetTimeStateAndParametersFrom(pristine)
    port.GetMutableData().set_value([7.0, 8.0])
    simulator.Initialize()
    np.testing.assert_array_equal(history(system, context), [[7.0, 8.0]] * 3)


@pytest.mark.parametrize("seed", range(5))
def test_angles_of_a_history_have_no_full_turn_jumps(seed):
    """Poses of a motion of several turns are measured within ±π, and the history follows the motion."""
    rng = np.random.default_rng(seed)
    near = rng.uniform(-7.0, 7.0, 6)
    buffer = HistoryBuffer(6, 4, 0.1, near)
    simulator = Simulator(buffer)
    context = simulator.get_mutable_context()
    motion = near + rng.uniform(-3.0, 3.0, 6) + np.linspace(0.0, 1.0, 40)[:, None] * rng.uniform(-15.0, 15.0, 6)
    measured = np.column_stack([motion[:, :3], np.remainder(motion[:, 3:] + np.pi, 2 * np.pi) - np.pi])
    buffer.get_initial_output_input_port().FixValue(context, measured[0])
    port = buffer.get_output_input_port().FixValue(context, measured[0])
    simulator.Initialize()
    last = nearest_pose(motion[0], near)
    np.testing.assert_allclose(buffer.get_history_output_port().Eval(context)[-6:], last, atol=1e-9)
    # The same full turns and the same pair of angles for the whole motion, so that the history has no jumps.
    sign, offset = np.ones(6), last - motion[0]
    if not np.allclose(offset, 2 * np.pi * np.round(offset / (2 * np.pi)), atol=1e-6):
        sign[4], offset = -1.0, last - motion[0] * [1, 1, 1, 1, -1, 1]
    for k, pose in enumerate(measured[1:], 1):
        port.GetMutableData().set_value(pose)
        simulator.AdvanceTo(0.1 * k + 0.05)
        newest = buffer.get_history_output_port().Eval(context)[-6:]
        np.testing.assert_allclose(newest, sign * motion[k] + offset, atol=1e-9)


def test_first_commands_start_at_the_measured_angle_beyond_pi():
    """The demonstrations are at Rx = +3.14, and the start is measured at −3.12, 23 mrad away."""
    rng, s = np.random.default_rng(0), np.linspace(0.0, 1.0, 60)
    sway = 0.02 * rng.standard_normal(5)
    outputs = [np.column_stack([0.1 * s, a * s, 0 * s, 0 * s, 0 * s, 3.14 + a * np.sin(s)]) for a in sway]
    reference = ReferenceTrajectory.from_demonstrations(
        Demonstrations(0.02 * np.arange(60), outputs), components=3, floor=0.002
    )
    builder = DiagramBuilder()
    kmp = builder.AddSystem(LcNsKmpSystem(LcNsKmp(reference, history=5, horizon=8), None, 0.02))
    buffer = builder.AddSystem(HistoryBuffer(6, 5, 0.02, reference.means[0]))
    action = builder.AddSystem(ConstantVectorSource(np.zeros(6)))
    pose = builder.AddSystem(ConstantVectorSource([0.0, 0.0, 0.0, 0.0, 0.0, -3.12]))
    builder.Connect(action.get_output_port(), kmp.get_null_space_action_input_port())
    builder.Connect(pose.get_output_port(), buffer.get_initial_output_input_port())
    builder.Connect(kmp.get_command_output_port(), buffer.get_output_input_port())
    builder.Connect(buffer.get_history_output_port(), kmp.get_history_input_port())
    simulator = Simulator(builder.Build())
    context = kmp.GetMyContextFromRoot(simulator.get_context())
    last = 2 * np.pi - 3.12
    for step in range(10):
        simulator.AdvanceTo((step + 0.5) * 0.02)
        angle = kmp.get_command_output_port().Eval(context)[5]
        assert abs(angle - last) < 0.02
        last = angle
