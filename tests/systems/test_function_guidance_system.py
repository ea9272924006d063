import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.models.common.errors import InputError
from guiderail.systems.function_guidance_system import FunctionGuidanceSystem

PERIOD = 0.25


def simulate(law, action=(0.5,), pose=(1.0, 2.0), wrench=(3.0,)):
    """Return a simulator of the system, a function that sets an input, and a function that reads an output."""
    builder = DiagramBuilder()
    system = builder.AddSystem(FunctionGuidanceSystem(law, len(action), len(pose), len(wrench), PERIOD))
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
    with pytest.raises(InputError, match="function must return 2 numbers, not"):
        simulate(lambda action, pose, wrench: value)


def test_function_cannot_modify_the_inputs():
    def law(action, pose, wrench):
        action[:], pose[:], wrench[:] = 9.0, 9.0, 9.0
        return pose

    _, _, read = simulate(law)
    assert read("held_action") == [0.5]


def test_system_has_no_direct_feedthrough():
    assert not FunctionGuidanceSystem(lambda action, pose, wrench: pose, 1, 2, 3, PERIOD).HasAnyDirectFeedthrough()


@pytest.mark.parametrize("sizes", [(0, 1, 1), (1, 0, 1), (1, 1, 0)])
def test_constructor_refuses_arguments_out_of_range(sizes):
    with pytest.raises(InputError, match="_size must be a whole number of at least 1"):
        FunctionGuidanceSystem(lambda action, pose, wrench: pose, *sizes, PERIOD)
    with pytest.raises(InputError, match="guidance needs a function"):
        FunctionGuidanceSystem(5, 1, 1, 1, PERIOD)
    with pytest.raises(InputError, match="period"):
        FunctionGuidanceSystem(lambda action, pose, wrench: pose, 1, 1, 1, 0.0)


def test_measured_pose_at_initialization_must_be_finite():
    with pytest.raises(InputError, match="measured pose must be finite"):
        simulate(lambda action, pose, wrench: pose, pose=(1.0, np.nan))
