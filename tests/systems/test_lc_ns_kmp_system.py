import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource, VectorLogSink, ZeroOrderHold

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, UnsolvableError
from guiderail.systems.movement_primitive import HistoryBuffer, LcNsKmpSystem
from oracles.prerequisites import changed_outputs

PERIOD = 0.02


def primitive(history=3, upper=0.5):
    t = PERIOD * np.arange(50)
    reference = ReferenceTrajectory(t, np.column_stack([t, np.sin(t)]), np.tile(0.01 * np.eye(2), (50, 1, 1)))
    constraints = LinearConstraints.box([-np.inf, -np.inf], [upper, np.inf])
    return LcNsKmp(reference, history=history, horizon=8, constraints=constraints)


def unsolvable(*arguments):
    """Replace a solver that finds no solution."""
    raise UnsolvableError("no solution")


def failing_at(step, predict):
    """Return a `predict` that finds no solution in this control step."""
    return lambda index, *arguments: unsolvable() if index == step else predict(index, *arguments)


def simulate(p, gain=None, action=(0.0, 0.0)):
    """Return the system of a primitive, its simulator, the context, and the value of the null-space action."""
    system = LcNsKmpSystem(p, gain, PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    return system, simulator, context, system.get_null_space_action_input_port().FixValue(context, action)


def names(system, kind):
    """Return the names of the input or output ports of a system."""
    count = getattr(system, f"num_{kind}_ports")()
    return [getattr(system, f"get_{kind}_port")(i).get_name() for i in range(count)]


def test_window_of_three_outputs_has_covariances_of_nine_entries():
    times, means, covariances = PERIOD * np.arange(50), np.zeros((50, 3)), np.tile(np.eye(3), (50, 1, 1))
    reference = ReferenceTrajectory(times, means, covariances)
    p = LcNsKmp(reference, history=0, horizon=8, constraints=LinearConstraints.none(3))
    assert LcNsKmpSystem(p, None, PERIOD).get_reference_window_input_port().size() == 9 * (3 + 9)


def test_command_is_the_prediction_at_the_control_step():
    p = primitive()
    gain = np.array([3.0, 5.0])
    system = LcNsKmpSystem(p, gain, PERIOD)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    past = p.reference.means[2:5]
    system.get_null_space_action_input_port().FixValue(context, [0.5, -1.0])
    system.get_history_input_port().FixValue(context, past.ravel())
    np.testing.assert_array_equal(system.gain, gain)
    system.gain[:] = 0.0  # a copy
    simulator.Initialize()
    for step in (0, 7, 29, 30):  # in floating point, 29 * PERIOD / PERIOD < 29
        simulator.AdvanceTo(PERIOD * (step + 0.5))
        expected = p.predict(step, gain * [0.5, -1.0], past).output
        np.testing.assert_array_equal(system.get_command_output_port().Eval(context), expected)
        violation = system.get_constraint_violation_output_port().Eval(context)[0]
        assert violation == pytest.approx(expected[0] - 0.5, abs=1e-12)


def test_command_is_computed_once_per_control_step():
    calls = []
    p = primitive(history=0)
    predict, p.predict = p.predict, lambda step, *arguments: calls.append(step) or predict(step, *arguments)
    system, simulator, context, _ = simulate(p)
    simulator.Initialize()
    for k in range(1, 41):
        simulator.AdvanceTo(k * PERIOD / 4 + 1e-6)
        system.get_command_output_port().Eval(context)
        system.get_fallback_output_port().Eval(context)
    assert calls == list(range(11))


def loop(history):
    """Return a diagram of KGRL or, with a history, sKGRL, connected as in a guidance diagram, and the primitive."""
    builder = DiagramBuilder()
    p = primitive(history)
    system = builder.AddSystem(LcNsKmpSystem(p, np.array([20.0, 20.0]), PERIOD))
    hold = builder.AddSystem(ZeroOrderHold(PERIOD, 2))
    builder.Connect(hold.get_output_port(), system.get_null_space_action_input_port())
    builder.ExportInput(hold.get_input_port(), "action")
    if history:
        buffer = builder.AddSystem(HistoryBuffer(2, history, PERIOD))
        start = builder.AddSystem(ConstantVectorSource(p.reference.means[0]))
        builder.Connect(system.get_command_output_port(), buffer.get_output_input_port())
        builder.Connect(start.get_output_port(), buffer.get_initial_output_input_port())
        builder.Connect(buffer.get_history_output_port(), system.get_history_input_port())
    builder.ExportOutput(system.get_command_output_port(), "desired_pose")
    return builder.Build(), p


@pytest.mark.parametrize("history", [0, 3])
def test_closed_loop_is_the_recursion_of_algorithm_3(history):
    diagram, p = loop(history)
    simulator = Simulator(diagram)
    context = simulator.get_mutable_context()
    action = diagram.GetInputPort("action").FixValue(context, np.zeros(2))
    simulator.Initialize()
    rng = np.random.default_rng(1)
    past = np.tile(p.reference.means[0], (history, 1))
    for n in range(50):
        u = rng.uniform(-1, 1, 2)
        action.GetMutableData().set_value(u)
        simulator.AdvanceTo((n + 1) * PERIOD)
        expected = p.predict(n, 20.0 * u, past if history else None).output
        np.testing.assert_array_equal(diagram.GetOutputPort("desired_pose").Eval(context), expected)
        assert expected[0] <= 0.5 + 1e-9
        past = np.vstack([past, expected])[1:] if history else past


def test_last_command_is_repeated_when_there_is_no_solution():
    p = primitive(history=0)
    p.predict = failing_at(5, p.predict)
    system = LcNsKmpSystem(p, None, PERIOD)
    builder = DiagramBuilder()
    builder.AddSystem(system)
    zero = builder.AddSystem(ConstantVectorSource(np.zeros(2)))
    builder.Connect(zero.get_output_port(), system.get_null_space_action_input_port())
    sinks = [builder.AddSystem(VectorLogSink(size, PERIOD)) for size in (2, 1)]
    builder.Connect(system.get_command_output_port(), sinks[0].get_input_port())
    builder.Connect(system.get_fallback_output_port(), sinks[1].get_input_port())
    diagram = builder.Build()
    simulator = Simulator(diagram)
    simulator.AdvanceTo(10 * PERIOD + 1e-6)
    # The log at instant n contains the values just before it: command n − 1.
    outputs, fallback = (sink.FindLog(simulator.get_context()).data()[:, 1:] for sink in sinks)
    np.testing.assert_array_equal(np.flatnonzero(fallback[0]), [5])
    np.testing.assert_array_equal(outputs[:, 5], outputs[:, 4])
    assert (outputs[:, 6] != outputs[:, 4]).any()


def test_fallback_satisfies_the_constraints_of_its_step():
    """The last command may violate the constraints of the next step, so each fallback is a projection."""
    upper = np.linspace(0.3, -0.4, 50)
    c = np.tile(LinearConstraints.box([-np.inf, -np.inf], [0.0, np.inf]).c, (50, 1)) - upper[:, None]
    G = np.tile(LinearConstraints.box([-np.inf, -np.inf], [0.0, np.inf]).G, (50, 1, 1))
    p = LcNsKmp(primitive().reference, history=0, horizon=8, constraints=LinearConstraints(G, c))
    p.predict = unsolvable
    system, simulator, context, _ = simulate(p)
    for step in range(50):
        simulator.AdvanceTo(step * PERIOD + 1e-6)
        assert system.get_command_output_port().Eval(context)[0] <= upper[step] + 1e-9
        assert system.get_constraint_violation_output_port().Eval(context)[0] <= 1e-9
        assert system.get_fallback_output_port().Eval(context)[0] == 1.0


def test_fallback_satisfies_moving_bounds_if_every_solver_fails(monkeypatch):
    lower = np.column_stack([np.linspace(-1.0, 1.0, 50), np.full(50, -1.0)])
    p = LcNsKmp(primitive().reference, history=0, horizon=8, constraints=LinearConstraints.box(lower, lower + 0.5))
    system, simulator, context, _ = simulate(p)
    p.predict = unsolvable
    monkeypatch.setattr("guiderail.models.primitives.constraints.solve_least_norm", unsolvable)
    for step in range(50):
        simulator.AdvanceTo(step * PERIOD + 1e-6)
        assert system.get_constraint_violation_output_port().Eval(context)[0] <= 1e-9
        assert system.get_fallback_output_port().Eval(context)[0] == 1.0


def test_fallback_depends_on_the_last_command():
    p = primitive(history=0)
    p.predict = unsolvable
    stale, effects = changed_outputs(LcNsKmpSystem(p, None, PERIOD), inputs=("null_space_action",))
    assert not stale
    assert ("state 1", "command") in effects


def test_initialization_restores_step_and_initial_command():
    p = primitive(history=0)
    predict = p.predict
    system, simulator, context, action = simulate(p)
    simulator.AdvanceTo(20.5 * PERIOD)
    p.predict = unsolvable
    context.SetTime(0.0)
    action.GetMutableData()  # invalidates the cache
    simulator.Initialize()
    np.testing.assert_array_equal(system.get_command_output_port().Eval(context), p.reference.means[0])
    p.predict = predict
    action.GetMutableData()
    np.testing.assert_array_equal(system.get_command_output_port().Eval(context), predict(0, np.zeros(2)).output)
    context.SetTime(29 * PERIOD)  # in floating point, 29 * PERIOD / PERIOD < 29
    simulator.Initialize()
    np.testing.assert_array_equal(system.get_command_output_port().Eval(context), predict(29, np.zeros(2)).output)


def test_fallback_after_a_later_initialization_is_last_command():
    p = primitive(history=0)
    predict = p.predict
    system, simulator, context, action = simulate(p)
    simulator.AdvanceTo(7.5 * PERIOD)
    simulator.Initialize()
    p.predict = unsolvable
    action.GetMutableData()  # invalidates the cache
    np.testing.assert_array_equal(system.get_command_output_port().Eval(context), predict(6, np.zeros(2)).output)


def test_fallback_of_the_second_step_is_the_first_command():
    p = primitive(history=0)
    predict, p.predict = p.predict, failing_at(1, p.predict)
    system, simulator, context, _ = simulate(p, np.full(2, 20.0), [0.5, -1.0])
    simulator.AdvanceTo(1.5 * PERIOD)
    expected = predict(0, np.array([10.0, -20.0])).output
    assert (expected != p.reference.means[0]).any()
    np.testing.assert_array_equal(system.get_command_output_port().Eval(context), expected)


def test_connected_reference_window_replaces_the_reference():
    p, action = primitive(history=0), np.array([0.5, -1.0])
    system, simulator, context, _ = simulate(p, action=action)
    rng = np.random.default_rng(3)
    means, factors = 0.1 * rng.normal(size=(9, 2)), 0.1 * rng.normal(size=(9, 2, 2))
    covariances = factors @ np.swapaxes(factors, 1, 2) + 0.01 * np.eye(2)
    window = np.concatenate([means.ravel(), covariances.ravel()])
    system.get_reference_window_input_port().FixValue(context, window)
    simulator.AdvanceTo(4.5 * PERIOD)
    expected = p.predict_window(4, means, covariances, action).output
    np.testing.assert_array_equal(system.get_command_output_port().Eval(context), expected)


@pytest.mark.parametrize("length", [2.0, 4.0, 0.0, 1.5, np.nan])
def test_history_length_is_refused_when_no_primitive_matches(length):
    system = LcNsKmpSystem(primitive(history=3), None, PERIOD, shorter=[(primitive(history=1), np.ones(2))])
    context = system.CreateDefaultContext()
    system.get_null_space_action_input_port().FixValue(context, np.zeros(2))
    system.get_history_input_port().FixValue(context, np.zeros(6))
    system.get_history_length_input_port().FixValue(context, [length])
    with pytest.raises(InputError, match="only with 1, 3"):
        system.get_command_output_port().Eval(context)


def test_history_length_selects_the_primitive():
    longest, short = primitive(history=3), primitive(history=1)
    gains = {3: np.array([3.0, 5.0]), 1: np.array([7.0, -2.0])}
    system = LcNsKmpSystem(longest, gains[3], PERIOD, shorter=[(short, gains[1])])
    inputs = ["null_space_action", "history", "history_length", "motion_time", "reference_window"]
    assert names(system, "input") == inputs
    assert system.get_history_length_input_port().size() == 1
    past, action = longest.reference.means[2:5], np.array([0.5, -1.0])
    context = system.CreateDefaultContext()
    system.get_null_space_action_input_port().FixValue(context, action)
    system.get_history_input_port().FixValue(context, past.ravel())
    for p in (longest, short, longest):
        system.get_history_length_input_port().FixValue(context, [float(p.history)])
        expected = p.predict(0, gains[p.history] * action, past[-p.history :]).output
        np.testing.assert_array_equal(system.get_command_output_port().Eval(context), expected)


def test_constructor_refuses_inconsistent_primitives():
    with pytest.raises(InputError, match="other constraints"):
        LcNsKmpSystem(primitive(), None, PERIOD, shorter=[(primitive(1, upper=0.4), np.ones(2))])


@pytest.mark.parametrize("time", [np.nan, np.inf])
def test_motion_time_is_refused_when_it_is_not_finite(time):
    system = LcNsKmpSystem(primitive(history=0), None, PERIOD)
    context = system.CreateDefaultContext()
    system.get_null_space_action_input_port().FixValue(context, [0.0, 0.0])
    system.get_motion_time_input_port().FixValue(context, [time])
    with pytest.raises(InputError, match="motion_time must be finite"):
        system.get_command_output_port().Eval(context)


def test_violation_is_finite_without_constraints():
    system = LcNsKmpSystem(LcNsKmp(primitive().reference, horizon=8), None, PERIOD)
    context = system.CreateDefaultContext()
    system.get_null_space_action_input_port().FixValue(context, [0.0, 0.0])
    assert system.get_constraint_violation_output_port().Eval(context)[0] == -1e30


@pytest.mark.parametrize(
    ("gain", "period", "words"),
    [(np.ones(3), PERIOD, "gain"), ([np.nan, 1], PERIOD, "gain"), ([np.inf, 1], PERIOD, "gain"), (None, 0.0, "period")],
)
def test_constructor_refuses_arguments_out_of_range(gain, period, words):
    with pytest.raises(InputError, match=words):
        LcNsKmpSystem(primitive(), gain, period)


def test_connected_motion_time_determines_the_step():
    p, action = primitive(history=0), np.array([0.5, -1.0])
    system, simulator, context, _ = simulate(p, action=action)
    time = system.get_motion_time_input_port().FixValue(context, [4 * PERIOD])
    simulator.AdvanceTo(7.5 * PERIOD)
    for step in (4, 5, 2, 29):  # in floating point, 29 * PERIOD / PERIOD < 29
        time.GetMutableData().set_value([step * PERIOD])
        command = system.get_command_output_port().Eval(context)
        np.testing.assert_array_equal(command, p.predict(step, action).output)


@pytest.mark.parametrize("start", [3.1, -3.1])
def test_history_a_full_turn_from_the_reference_is_refused_unless_near_is_given(start):
    """Its commands would be between the reference and the robot, far from both."""
    means = np.zeros((20, 6))
    means[:, 5] = 3.1
    reference = ReferenceTrajectory(PERIOD * np.arange(20), means, np.tile(0.01 * np.eye(6), (20, 1, 1)))
    pose = np.array([0.0, 0.0, 0.0, 0.0, 0.0, start])
    for near in (None, means[0]):
        builder = DiagramBuilder()
        kmp = builder.AddSystem(LcNsKmpSystem(LcNsKmp(reference, history=3, horizon=4), None, PERIOD))
        history = builder.AddSystem(HistoryBuffer(6, 3, PERIOD, near=near))
        source = builder.AddSystem(ConstantVectorSource(pose))
        zero = builder.AddSystem(ConstantVectorSource(np.zeros(6)))
        for port in (history.get_output_input_port(), history.get_initial_output_input_port()):
            builder.Connect(source.get_output_port(), port)
        builder.Connect(zero.get_output_port(), kmp.get_null_space_action_input_port())
        builder.Connect(history.get_history_output_port(), kmp.get_history_input_port())
        simulator = Simulator(builder.Build())
        simulator.Initialize()
        context = kmp.GetMyContextFromRoot(simulator.get_context())
        if near is None and start < 0.0:
            with pytest.raises(InputError, match=r"starts 6\.20 rad from the reference"):
                kmp.get_command_output_port().Eval(context)
        else:
            assert abs(kmp.get_command_output_port().Eval(context)[5] - 3.1) < 0.1
