"""The commands of the law equal those of the diagram of KGRL and sKGRL, and satisfy the constraints."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.models.common.errors import InputError
from guiderail.models.control.motion_constraints import MotionConstraintFilter, MotionConstraints
from guiderail.models.laws import PrimitiveLaw, Stepper
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, UnsolvableError
from guiderail.systems.movement_primitive import HistoryBuffer, LcNsKmpSystem

PERIOD, STEPS = 0.02, 40
GAIN = np.array([20.0, 30.0])


def primitive(history=3, upper=0.5):
    t = PERIOD * np.arange(STEPS)
    reference = ReferenceTrajectory(t, np.column_stack([t, np.sin(t)]), np.tile(0.01 * np.eye(2), (STEPS, 1, 1)))
    constraints = LinearConstraints.box([-np.inf, -0.1], [upper, 0.6])
    return LcNsKmp(reference, history=history, horizon=8, constraints=constraints)


def fail(*_):
    raise UnsolvableError("no solution")


def make_stepper(p, pose=None, gain=None, **parameters):
    """Return a stepper of a primitive, by default at the first mean of its reference."""
    return Stepper(PrimitiveLaw(p, gain, **parameters), p.reference.means[0] if pose is None else pose)


def commands_of_diagram(p, action, pose, steps):
    """Return the commands (steps, 2) of a diagram with a constant action."""
    builder = DiagramBuilder()
    kmp = builder.AddSystem(LcNsKmpSystem(p, GAIN, PERIOD))
    source = builder.AddSystem(ConstantVectorSource(action))
    builder.Connect(source.get_output_port(), kmp.get_null_space_action_input_port())
    if p.history:
        buffer = builder.AddSystem(HistoryBuffer(2, p.history, PERIOD))
        initial = builder.AddSystem(ConstantVectorSource(pose))
        builder.Connect(buffer.get_history_output_port(), kmp.get_history_input_port())
        builder.Connect(kmp.get_command_output_port(), buffer.get_output_input_port())
        builder.Connect(initial.get_output_port(), buffer.get_initial_output_input_port())
    simulator = Simulator(builder.Build())
    context, commands = kmp.GetMyContextFromRoot(simulator.get_context()), []
    for step in range(steps):
        simulator.AdvanceTo(PERIOD * (step + 0.5))
        commands.append(kmp.get_command_output_port().Eval(context).copy())
    return np.array(commands)


@pytest.mark.parametrize("history", [0, 3])
@pytest.mark.parametrize("action", [[0.0, 0.0], [1.0, -1.0]])
def test_commands_equal_the_commands_of_the_diagram(history, action):
    p, pose = primitive(history), np.array([0.01, -0.02])
    stepper = make_stepper(p, pose, GAIN)
    commands = np.array([stepper.step(action).pose for _ in range(STEPS + 5)])
    np.testing.assert_array_equal(commands, commands_of_diagram(p, action, pose, STEPS + 5))


def test_violation_of_every_command_is_at_most_zero():
    stepper = make_stepper(primitive(upper=0.3), gain=[1e5, 1e5])
    commands = [stepper.step([1.0, 1.0]) for _ in range(STEPS)]
    assert max(command.violation for command in commands) <= 1e-9
    assert commands[-1].violation == pytest.approx(0.0, abs=1e-9)
    assert not any(command.fallback for command in commands)


def test_fallback_repeats_the_last_allowed_command(monkeypatch):
    p = primitive(history=0)
    stepper = make_stepper(p)
    last = stepper.step([0.0, 0.0]).pose
    monkeypatch.setattr(p, "predict", fail)
    command = stepper.step([1.0, 1.0])
    assert command.fallback
    np.testing.assert_array_equal(command.pose, last)
    assert stepper.num_steps == 2


def test_stepper_copies_its_commands(monkeypatch):
    p = primitive(history=0)
    motion = MotionConstraintFilter(MotionConstraints(p.constraints, max_speed=[1.0, 1.0]), PERIOD)
    for filtered in (None, motion):
        first, second = make_stepper(p, command_filter=filtered), make_stepper(p, command_filter=filtered)
        for _ in range(2):
            expected = first.step([0.0, 0.0]).pose
            changed = second.step([0.0, 0.0]).pose
            np.testing.assert_array_equal(changed, expected)
            changed += 0.01
        monkeypatch.setattr(p, "predict", fail)
        np.testing.assert_array_equal(*(stepper.step([0.0, 0.0]).pose for stepper in (second, first)))
        monkeypatch.undo()


def test_measured_history_follows_the_measured_pose():
    p = primitive()
    commanded, measured = make_stepper(p, [0.0, 0.0]), make_stepper(p, [0.0, 0.0], history_source="measured")
    pose = np.array([0.0, 0.05])
    first = [stepper.step([0.0, 0.0], [0.0, 0.0]).pose for stepper in (commanded, measured)]
    np.testing.assert_array_equal(*first)
    for _ in range(3):
        a, b = (stepper.step([0.0, 0.0], pose).pose for stepper in (commanded, measured))
    assert b[1] > a[1] + 0.01


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"pose": [0.0]}, "pose must be 2 finite numbers"),
        ({"pose": [0.0, np.nan]}, "pose must be 2 finite numbers"),
        ({"gain": [1.0, 2.0, 3.0]}, "gain must be 2 finite numbers"),
        ({"history_source": "guessed"}, "commanded or measured"),
    ],
)
def test_start_refuses_invalid_arguments(keywords, message):
    with pytest.raises(InputError, match=message):
        make_stepper(primitive(), **keywords)


def test_step_refuses_invalid_arguments_without_advancing():
    stepper = make_stepper(primitive(), history_source="measured")
    for action in ([0.0], [np.nan, 0.0], [np.inf, 0.0]):
        with pytest.raises(InputError, match="action must be 2 finite numbers"):
            stepper.step(action)
    stepper.step([0.0, 0.0])
    with pytest.raises(InputError, match="measured pose at every step"):
        stepper.step([0.0, 0.0])
    assert stepper.num_steps == 1


@pytest.mark.parametrize("history", [0, 1])
def test_filter_starts_with_the_velocity_of_two_outputs(history):
    p = primitive(history)
    motion = MotionConstraintFilter(MotionConstraints(p.constraints, max_acceleration=[1.0, 1.0]), PERIOD)
    first = make_stepper(p, [[0.0, 0.0], [0.01, 0.0]], command_filter=motion).step([0.0, 0.0]).pose
    assert abs(first[0] - 0.02) <= PERIOD**2 * (1 + 1e-9)
    with pytest.raises(InputError, match="pose must be 2 finite numbers"):
        make_stepper(p, [[0.0, 0.0], [0.01, 0.0]])


def test_motion_that_cannot_brake_is_stopped_with_a_fallback():
    p = primitive(0)
    wall = LinearConstraints(np.array([[0.0, -1.0]]), np.array([-0.02]))
    for speed, is_fallback in ((0.0004, False), (0.01, True)):
        motion = MotionConstraintFilter(MotionConstraints(wall, max_acceleration=[1.0, 1.0]), PERIOD)
        stepper = make_stepper(p, [[0.0, -speed], [0.0, 0.0]], command_filter=motion)
        commands = [stepper.step([0.0, 0.0]) for _ in range(3)]
        assert commands[0].fallback == is_fallback
        assert max(command.violation for command in commands) <= 1e-9
