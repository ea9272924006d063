from typing import NamedTuple

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import RigidTransform
from guiderail.models.laws import Command, Law, PrimitiveLaw, Stepper, TemplateLaw
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.templates import load_template
from guiderail.systems.law_system import LawSystem

PERIOD = 0.25


class FunctionLaw(Law):
    """Law without memory that commands the value of a function."""

    def __init__(self, function, *sizes):
        super().__init__(*sizes)
        self.function = function

    def command(self, state, action, pose, wrench):
        return self.function(action, pose, wrench)


class Integrator(Law):
    """Law that adds each action to the last command."""

    def command(self, last, action, pose, wrench):
        return last + action


class Filter(Law):
    """Law whose state is a named tuple: the last command, and a count and a matrix that `next` computes."""

    def start(self, pose):
        return Memory(pose, 0, np.zeros((2, 2)))

    def command(self, state, action, pose, wrench):
        return Command(state.last + state.matrix[0], memory=2 * action)

    def next(self, state, command, pose):
        return Memory(command.pose, state.count + 1, state.matrix + command.memory * state.count + pose)


class Memory(NamedTuple):
    last: np.ndarray
    count: int
    matrix: np.ndarray


def simulate(law, action=(0.5,), pose=(1.0, 2.0), wrench=(3.0,)):
    """Return a simulator of the system, a function that sets an input, and a function that reads an output.

    `law` is a law, or the function of a law without memory.
    """
    builder = DiagramBuilder()
    law = law if isinstance(law, Law) else FunctionLaw(law, len(pose), len(action))
    system = builder.AddSystem(LawSystem(law, len(wrench), PERIOD))
    sources = {}
    for name, value in (("action", action), ("pose", pose), ("wrench", wrench)):
        sources[name] = builder.AddSystem(ConstantVectorSource(value))
        builder.Connect(sources[name].get_output_port(), system.GetInputPort(name))
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    context = simulator.get_mutable_context()

    def set_input(name, value):
        sources[name].get_mutable_source_value(sources[name].GetMyMutableContextFromRoot(context)).set_value(value)

    def read(name):
        return system.GetOutputPort(name).Eval(system.GetMyContextFromRoot(context)).tolist()

    return simulator, set_input, read


def test_desired_pose_is_the_function_value_at_each_period():
    simulator, set_input, read = simulate(lambda action, pose, wrench: pose + action * wrench)
    assert read("desired_pose") == [2.5, 3.5]
    assert (read("held_action"), read("fallback")) == ([0.5], [0.0])
    simulator.AdvanceTo(PERIOD / 4)
    set_input("action", [1.0])
    simulator.AdvanceTo(PERIOD / 2)
    assert read("desired_pose") == [2.5, 3.5]
    simulator.AdvanceTo(1.5 * PERIOD)
    assert read("desired_pose") == [4.0, 5.0]
    assert read("held_action") == [1.0]


@pytest.mark.parametrize(
    "value", [[np.nan, 0.0], [np.inf, 0.0], [1.0], [[1.0, 2.0]], None, "far", np.array([1j, 0.0]), [[], 1.0]]
)
def test_desired_pose_is_repeated_when_the_value_is_invalid(value):
    simulator, set_input, read = simulate(lambda action, pose, wrench: pose + 1 if action[0] > 0 else value)
    simulator.AdvanceTo(0.5 * PERIOD)
    assert read("desired_pose") == [2.0, 3.0]
    set_input("action", [-1.0])
    set_input("pose", [7.0, 7.0])
    simulator.AdvanceTo(1.5 * PERIOD)
    assert (read("desired_pose"), read("fallback")) == ([2.0, 3.0], [1.0])
    set_input("action", [1.0])
    simulator.AdvanceTo(2.5 * PERIOD)
    assert (read("desired_pose"), read("fallback")) == ([8.0, 8.0], [0.0])


def test_first_fallback_is_the_measured_pose():
    _, _, read = simulate(lambda action, pose, wrench: [np.nan, 0.0])
    assert (read("desired_pose"), read("fallback")) == ([1.0, 2.0], [1.0])


@pytest.mark.parametrize("value", [None, [1.0], np.zeros((1, 2)), "far", np.array([1j, 0.0]), [[], 1.0]])
def test_initialization_fails_when_the_function_returns_no_pose(value):
    with pytest.raises(InputError, match="law must command 2 numbers, not"):
        simulate(lambda action, pose, wrench: value)


def test_function_cannot_modify_the_inputs():
    def law(action, pose, wrench):
        action[:], pose[:], wrench[:] = 9.0, 9.0, 9.0
        return pose

    _, _, read = simulate(law)
    assert read("held_action") == [0.5]


def test_constructor_refuses_what_is_not_a_law():
    with pytest.raises(InputError, match="guidance needs a Law"):
        LawSystem(5, 1, PERIOD)


@pytest.mark.parametrize(("name", "method"), [("command", lambda self, action, pose: pose), ("next", lambda self: 0)])
def test_law_is_refused_when_a_method_lacks_parameters(name, method):
    law = type("Wrong", (Integrator,), {name: method})(2)
    with pytest.raises(InputError, match=f"{name} of Wrong must have the parameters"):
        LawSystem(law, 1, PERIOD)


def test_law_without_command_is_refused():
    with pytest.raises(InputError, match="Law needs a method command"):
        LawSystem(Law(2), 1, PERIOD)


@pytest.mark.parametrize("state", [(np.zeros(2), 1), {"pose": np.zeros(2)}, [0.0, 0.0], None])
def test_law_is_refused_when_its_state_is_no_array_or_named_tuple(state):
    law = type("Wrong", (Integrator,), {"start": lambda self, pose: state})(2)
    with pytest.raises(InputError, match="the state of a law is an array, or a named tuple of arrays and numbers, not"):
        LawSystem(law, 1, PERIOD)


def test_state_of_another_size_than_the_first_is_refused():
    law = type("Wrong", (Integrator,), {"next": lambda self, last, command, pose: np.zeros(3)})(2)
    simulator, _, _ = simulate(law, action=(0.5, 0.0))
    with pytest.raises(InputError, match="the state of a law has the size of its first state, 2, not 3"):
        simulator.AdvanceTo(1.5 * PERIOD)


def test_state_may_contain_the_state_of_another_law():
    class Outer(NamedTuple):
        inner: Memory
        number: int

    class Nested(Filter):
        def start(self, pose):
            return Outer(super().start(pose), 0)

        def command(self, state, action, pose, wrench):
            return super().command(state.inner, action, pose, wrench)

        def next(self, state, command, pose):
            assert isinstance(state.inner.count, int)
            return Outer(super().next(state.inner, command, pose), state.number + 1)

    commands = []
    for law in (Filter(2), Nested(2)):
        simulator, _, read = simulate(law, action=(0.5, 0.25))
        simulator.AdvanceTo(3.5 * PERIOD)
        commands.append(read("desired_pose"))
    assert commands[0] == commands[1]


def test_warning_names_a_law_that_commands_nan_at_its_first_step(caplog):
    simulate(lambda action, pose, wrench: [np.nan, 0.0])
    assert "FunctionLaw commands no finite pose at its first step" in caplog.text


def test_measured_pose_at_initialization_must_be_finite():
    with pytest.raises(InputError, match="measured pose must be finite"):
        simulate(lambda action, pose, wrench: pose, pose=(1.0, np.nan))


def test_memory_begins_at_the_measured_pose_and_is_reset():
    simulator, set_input, read = simulate(Integrator(2), action=(0.5, 0.0))
    for _ in range(2):
        for step in range(3):
            simulator.AdvanceTo(simulator.get_context().get_time() + (0.5 if step == 0 else 1.0) * PERIOD)
            assert read("desired_pose") == [1.0 + 0.5 * (step + 1), 2.0]
        set_input("action", [0.5, 0.0])
        simulator.get_mutable_context().SetTime(0.0)
        simulator.Initialize()


def reference():
    t = PERIOD * np.arange(20)
    return ReferenceTrajectory(t, np.column_stack([t, np.sin(t)]), np.tile(0.01 * np.eye(2), (20, 1, 1)))


LAWS = {
    "integrator": lambda: Integrator(2),
    "filter": lambda: Filter(2),
    "primitive": lambda: PrimitiveLaw(
        LcNsKmp(reference(), history=3, horizon=4, constraints=LinearConstraints.box([-9, -9], [2, 2])),
        [20.0, 30.0],
        history_source="measured",
    ),
    "template": lambda: TemplateLaw(load_template("pouring"), {"mug_tip": RigidTransform([0.6, 0.0, 0.3])}, PERIOD),
}


@pytest.mark.parametrize("name", LAWS)
def test_commands_equal_those_of_a_stepper(name):
    law, rng = LAWS[name](), np.random.default_rng(0)
    pose = np.array([0.6, -0.3, 0.45, 0.0, 0.0, 0.0][: law.num_outputs])
    simulator, set_input, read = simulate(law, np.zeros(law.num_actions), pose, np.zeros(6))
    stepper = Stepper(LAWS[name](), pose)
    for step in range(12):
        action = rng.uniform(-1, 1, law.num_actions)
        set_input("action", action)
        set_input("pose", pose)
        simulator.AdvanceTo((step + 0.5) * PERIOD)
        command = stepper.step(action, pose, np.zeros(6))
        np.testing.assert_array_equal(read("desired_pose"), command.pose)
        assert read("fallback") == [command.fallback]
        pose = command.pose + rng.normal(scale=1e-3, size=len(pose))
