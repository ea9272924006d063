"""Reference window from the chunks of a base policy: replanning, covariances, and the window before the first chunk."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.systems.movement_primitive import LcNsKmpSystem
from guiderail.systems.policy_system import PolicyError
from guiderail_lerobot.chunk_reference import ChunkReference

PERIOD, HORIZON, STEPS = 0.02, 4, 30


def reference():
    times = PERIOD * np.arange(STEPS)
    means = np.stack([np.sin(times), np.cos(times)], axis=1)
    return ReferenceTrajectory(times, means, np.tile(0.01 * np.eye(2), (STEPS, 1, 1)))


def two_members(observation):
    """Return two chunks, (2, 6, 2), whose first points are 0.1 below and above the observation."""
    chunk = np.outer(np.arange(6.0), [1.0, 10.0]) + observation[:2]
    return np.stack([chunk - 0.1, chunk + 0.1])


def make(policy=two_members, **arguments):
    options = {"horizon": HORIZON, "replan_steps": 3, "covariance_floor": 0.5, "period": PERIOD}
    return ChunkReference(policy, 3, reference(), **(options | arguments))


def windows(system, observations):
    """Return means (n, H+1, O) and covariances (n, H+1, O, O) after each control instant."""
    simulator = Simulator(system)
    context, result = simulator.get_mutable_context(), []
    port = system.get_observation_input_port().FixValue(context, observations[0])
    simulator.Initialize()
    for step, observation in enumerate(observations):
        port.GetMutableData().set_value(observation)
        simulator.AdvanceTo(PERIOD * (step + 0.5))
        result.append(system.get_reference_window_output_port().Eval(context).copy())
    split = np.split(np.array(result), [(HORIZON + 1) * 2], axis=1)
    return split[0].reshape(-1, HORIZON + 1, 2), split[1].reshape(-1, HORIZON + 1, 2, 2)


def test_window_is_that_of_the_reference_before_the_first_chunk():
    system = make()
    window = system.get_reference_window_output_port().Eval(system.CreateDefaultContext())
    means, covariances = np.split(window, [(HORIZON + 1) * 2])
    assert (means.reshape(-1, 2) == reference().means[: HORIZON + 1]).all()
    assert (covariances.reshape(-1, 2, 2) == reference().covariances[: HORIZON + 1]).all()


def test_window_advances_along_a_chunk_until_replanning():
    observations = np.arange(12.0).reshape(4, 3)
    means, covariances = windows(make(), observations)
    points = np.minimum(np.arange(7), 5)[:, None] * [1.0, 10.0]  # the last point of a chunk is repeated
    for step in range(3):  # chunk of the first observation
        assert np.allclose(means[step], points[step : step + HORIZON + 1] + observations[0, :2])
    assert np.allclose(means[3], points[: HORIZON + 1] + observations[3, :2])
    assert np.allclose(covariances, (0.5 * 0.01 + 0.02) * np.eye(2))


@pytest.mark.parametrize("policy", [None, two_members])
def test_initialization_restarts_the_window(policy):
    system, observations = make(policy), np.arange(15.0).reshape(5, 3)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    port, output = system.get_observation_input_port(), system.get_reference_window_output_port()
    episodes = []
    for _ in range(2):
        context.SetTime(0.0)
        port.FixValue(context, observations[0])
        simulator.Initialize()
        episodes.append([output.Eval(context).copy()])
        for step, observation in enumerate(observations):
            port.FixValue(context, observation)
            simulator.AdvanceTo(PERIOD * (step + 0.5))
            episodes[-1].append(output.Eval(context).copy())
    np.testing.assert_array_equal(*episodes)


def test_simulation_stops_when_the_policy_returns_no_chunk():
    system = make(lambda observation: np.full((1, 2, 2), np.nan))
    with pytest.raises(PolicyError, match="finite chunks"):
        windows(system, np.zeros((1, 3)))


@pytest.mark.parametrize(
    "argument", [{"horizon": -1}, {"replan_steps": 0}, {"covariance_floor": 0.0}, {"covariance_floor": np.nan}]
)
def test_argument_is_refused_when_it_is_out_of_range(argument):
    with pytest.raises(InputError):
        make(**argument)


def test_primitive_commands_the_chunk_inside_its_constraints():
    """An action moves the command, and every command satisfies the constraints."""
    bound = np.array([0.5, np.inf])
    primitive = LcNsKmp(
        reference(), lambda_=1e-3, beta=1e-3, horizon=HORIZON, constraints=LinearConstraints.box(-bound, bound)
    )
    builder = DiagramBuilder()
    chunk = builder.AddNamedSystem("chunk", make(lambda observation: np.tile(observation[:2], (1, 6, 1))))
    kmp = builder.AddNamedSystem("kmp", LcNsKmpSystem(primitive, np.full(2, 1e3), PERIOD))
    builder.Connect(chunk.get_reference_window_output_port(), kmp.get_reference_window_input_port())
    builder.ExportInput(chunk.get_observation_input_port(), "observation")
    builder.ExportInput(kmp.get_null_space_action_input_port(), "action")
    diagram = builder.Build()
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    observation = diagram.GetInputPort("observation").FixValue(context, [0.1, 0.2, 0.0])
    action = diagram.GetInputPort("action").FixValue(context, np.zeros(2))
    command = lambda: kmp.get_command_output_port().Eval(kmp.GetMyContextFromRoot(context))  # noqa: E731
    simulator.AdvanceTo(0.5 * PERIOD)
    without_action = command()
    assert np.allclose(without_action, [0.1, 0.2], atol=2e-3)
    action.GetMutableData().set_value([0.0, -1.0])
    assert command()[0] == pytest.approx(without_action[0])
    assert command()[1] < without_action[1] - 1e-3
    random = np.random.default_rng(0)
    for step in range(40):
        observation.GetMutableData().set_value(random.uniform(-3.0, 3.0, 3))
        action.GetMutableData().set_value(random.uniform(-1.0, 1.0, 2))
        simulator.AdvanceTo(PERIOD * (step + 1.5))
        assert abs(command()[0]) <= 0.5 + 1e-9


def test_window_is_refused_when_it_does_not_fit_the_primitive():
    primitive = LcNsKmp(reference(), horizon=HORIZON, lambda_=1e-3, beta=1e-3)
    with pytest.raises(InputError, match="shapes"):
        primitive.predict_window(0, np.zeros((4, 2)), np.tile(np.eye(2), (4, 1, 1)))
    with pytest.raises(InputError, match="finite"):
        primitive.predict_window(0, np.full((5, 2), np.nan), np.tile(np.eye(2), (5, 1, 1)))
    for covariance in (np.zeros((2, 2)), -np.eye(2), np.diag([1.0, 0.0])):
        window = np.zeros((5, 2)), np.tile(covariance, (5, 1, 1))
        with pytest.raises(InputError, match="positive definite"):
            primitive.predict_window(0, *window)
