"""Policy as a system: observation, order of events, and equality of simulator and environment."""

import numpy as np
import pytest
from pydrake.common.value import Value
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder, EventStatus, LeafSystem
from pydrake.systems.primitives import ConstantValueSource, ZeroOrderHold
from pydrake.systems.sensors import ImageRgba8U

from guiderail.diagrams.envs.make import make_env
from guiderail.systems.policy_system import PolicyError, PolicySystem

PERIOD = 2.0**-5


class Counter(LeafSystem):
    """Output the number of started periods: n + 1 after the discrete updates of time n · PERIOD."""

    def __init__(self):
        super().__init__()
        count = self.DeclareDiscreteState(1)
        self.DeclareStateOutputPort("count", count)
        self.DeclarePeriodicDiscreteUpdateEvent(PERIOD, 0.0, self._increment)

    def _increment(self, context, discrete_state):
        discrete_state.set_value(context.get_discrete_state(0).value() + 1)
        return EventStatus.Succeeded()


class Loop:
    """Counter that a policy observes, and a zero-order hold of the action."""

    def __init__(self, policy, action_repeat=1):
        builder = DiagramBuilder()
        counter = builder.AddSystem(Counter())
        self.system = builder.AddSystem(PolicySystem(policy, 1, 1, action_repeat * PERIOD))
        self.hold = builder.AddSystem(ZeroOrderHold(PERIOD, 1))
        builder.Connect(counter.get_output_port(), self.system.get_observation_input_port())
        builder.Connect(self.system.get_action_output_port(), self.hold.get_input_port())
        self.simulator = Simulator(builder.Build())
        self.context = self.simulator.get_mutable_context()
        self.pristine = self.context.Clone()
        self.simulator.Initialize()

    def reset(self):
        self.context.SetTimeStateAndParametersFrom(self.pristine)
        self.simulator.Initialize()

    def read(self, system):
        return float(system.get_output_port().Eval(system.GetMyContextFromRoot(self.context))[0])

    def run(self, steps):
        """Run control steps; return the action during each step."""
        actions = []
        for _ in range(steps):
            # In the middle of a step, all events of its first instant have been handled.
            n = int(self.context.get_time() / PERIOD + 0.5)
            self.simulator.AdvanceTo((n + 0.5) * PERIOD)
            actions.append(self.read(self.hold))
        return actions


def scaled_policy(observation):
    """Return the observation divided by 16, which is exact in binary."""
    return observation / 16.0


def test_action_is_set_before_discrete_updates_of_its_instant():
    """The policy observes the counter before the instant, and the hold samples the new action at the instant."""
    assert Loop(scaled_policy).run(5) == [0.0, 1 / 16, 2 / 16, 3 / 16, 4 / 16]


def test_action_is_constant_until_the_next_action_period():
    calls = []
    loop = Loop(lambda observation: calls.append(observation) or scaled_policy(observation), action_repeat=4)
    assert loop.run(10) == [0.0] * 4 + [4 / 16] * 4 + [8 / 16] * 2
    assert [observation.tolist() for observation in calls] == [[0.0], [4.0], [8.0]]


def test_action_is_zero_before_the_first_update_and_after_reset():
    loop = Loop(lambda observation: np.ones(1))
    assert loop.read(loop.system) == 0.0
    assert loop.run(3) == [1.0] * 3
    loop.reset()
    assert loop.read(loop.system) == 0.0
    assert loop.run(2) == [1.0] * 2


def test_policy_observes_arrays_as_in_an_environment():
    """A vector is float32. An image has no alpha channel and is a copy."""
    observations = []

    def policy(observation):
        observations.append(observation)
        return np.zeros(1)

    Loop(policy).run(1)
    image = ImageRgba8U(4, 3)
    image.mutable_data[:] = np.arange(48, dtype=np.uint8).reshape(3, 4, 4)
    builder = DiagramBuilder()
    camera = builder.AddSystem(ConstantValueSource(Value(image)))
    system = builder.AddSystem(PolicySystem(policy, Value(ImageRgba8U()), 1, PERIOD))
    builder.Connect(camera.get_output_port(), system.get_observation_input_port())
    simulator = Simulator(builder.Build())
    simulator.AdvanceTo(0.5 * PERIOD)
    assert observations[0].dtype == np.float32
    assert observations[1].dtype == np.uint8
    np.testing.assert_array_equal(observations[1], image.data[:, :, :3])


def test_action_is_clipped_to_the_action_space():
    assert Loop(lambda observation: np.array([3.0])).run(1) == [1.0]


@pytest.mark.parametrize(
    "action", [[np.nan], [np.inf], [0.0, 0.0], 0.0, [[0.0]], [], None, "forward", (np.zeros(1), None)]
)
def test_policy_error_is_raised_when_the_action_is_invalid(action):
    loop = Loop(lambda observation: action)
    with pytest.raises(PolicyError, match="the robot must stop"):
        loop.run(1)
    assert loop.read(loop.system) == 0.0


@pytest.mark.parametrize("action_repeat", [1, 5])
def test_simulator_and_environment_have_bitwise_equal_results(action_repeat):
    """The policy depends on the complete observation of the narrow passage under sKGRL."""
    steps = 30

    def policy(observation):
        return np.sin(np.array([[3.0], [-5.0]]) * observation.sum() + [[0.3], [1.1]])[:, 0]

    env = make_env("NarrowPassage", guidance="skgrl", action_repeat=action_repeat)
    observation, info = env.reset(seed=7)
    while info["control_steps"] < steps:
        observation, *_, info = env.step(policy(observation))
    commanded, measured = (np.array(rows)[:steps] for rows in (env.trace.commanded, env.trace.measured))

    task = make_env("NarrowPassage", guidance="skgrl", action_repeat=action_repeat).diagram
    builder = DiagramBuilder()
    diagram = builder.AddSystem(task.diagram)
    system = PolicySystem(policy, task.observation_space.shape[0], 2, action_repeat * task.control_period)
    builder.AddSystem(system)
    builder.Connect(diagram.GetOutputPort("observation"), system.get_observation_input_port())
    builder.Connect(system.get_action_output_port(), diagram.GetInputPort("action"))
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    task.randomize(context, np.random.Generator(np.random.PCG64(7)), {})
    simulator.Initialize()
    for n in range(steps):
        simulator.AdvanceTo((n + 1) * task.control_period)
        task_context = diagram.GetMyContextFromRoot(context)
        np.testing.assert_array_equal(diagram.GetOutputPort("desired_pose").Eval(task_context), commanded[n])
        np.testing.assert_array_equal(diagram.GetOutputPort("pose").Eval(task_context), measured[n])
    assert np.abs(np.diff(commanded, axis=0)).max() > 0.0
