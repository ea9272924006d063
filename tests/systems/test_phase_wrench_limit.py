"""Wrench limit of each phase as a system; `tests/diagrams/tasks/test_phase_limits.py` tests the physics."""

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import ConstantVectorSource

from guiderail.models.common.errors import InputError
from guiderail.systems import PhaseWrenchLimit

PERIOD = 0.01
RATE = np.array([100.0] * 3 + [10.0] * 3 + [100.0, 10.0])
HIGH = np.array([9.0, 9.0, 15.0, 1.0, 1.0, 1.0, np.linalg.norm([9.0, 9.0, 15.0]), np.sqrt(3.0)])
LOW = np.array([2.0, 2.0, 3.0, 0.5, 0.5, 0.5, np.linalg.norm([2.0, 2.0, 3.0]), np.sqrt(0.75)])


class Rig:
    """System with sources of the state and of the task's limit."""

    def __init__(self, state=0.0, task=None, limits=(HIGH, LOW)):
        builder = DiagramBuilder()
        self.source = builder.AddSystem(ConstantVectorSource([state]))
        self.system = builder.AddSystem(PhaseWrenchLimit(np.array(limits), RATE, period=PERIOD))
        builder.Connect(self.source.get_output_port(), self.system.get_state_input_port())
        if task is not None:
            self.task = builder.AddSystem(ConstantVectorSource(task))
            builder.Connect(self.task.get_output_port(), self.system.get_max_wrench_input_port())
        self.simulator = Simulator(builder.Build())
        self.simulator.Initialize()
        self.context, self.step = self.simulator.get_mutable_context(), 0

    @property
    def bound(self):
        port = self.system.get_phase_max_wrench_output_port()
        return port.Eval(self.system.GetMyContextFromRoot(self.context)).copy()

    def set(self, source, values):
        source_context = source.GetMyMutableContextFromRoot(self.context)
        source.get_mutable_source_value(source_context).SetFromVector(values)

    def run(self, steps):
        """Run control steps; return the bound after each step, (steps, 8)."""
        bounds = []
        for _ in range(steps):
            self.step += 1
            self.simulator.AdvanceTo(self.step * PERIOD)
            bounds.append(self.bound)
        return np.array(bounds)


@pytest.mark.parametrize(("state", "expected"), [(0.0, HIGH), (1.0, LOW)])
def test_bound_starts_at_the_limit_of_the_first_state(state, expected):
    rig = Rig(state)
    np.testing.assert_array_equal(rig.bound, expected)
    np.testing.assert_array_equal(rig.run(3), [expected] * 3)


def test_first_update_applies_the_limit_of_its_state_at_once():
    """A state machine may set its first state at the same instant at which this system is initialized."""
    rig = Rig(0.0)
    rig.set(rig.source, [1.0])
    np.testing.assert_array_equal(rig.run(1)[0], LOW)


@pytest.mark.parametrize(("first", "last"), [(HIGH, LOW), (LOW, HIGH)])
def test_bound_changes_at_the_largest_rate(first, last):
    rig = Rig(limits=(first, last))
    rig.run(2)
    rig.set(rig.source, [1.0])
    bounds = np.vstack([first, rig.run(40)])
    changes = np.abs(np.diff(bounds, axis=0)) / (RATE * PERIOD)
    assert changes.max() <= 1.0 + 1e-9
    moving = changes.max(axis=1) > 0.0
    # Each step except the last has the largest rate.
    np.testing.assert_allclose(changes.max(axis=1)[moving][:-1], 1.0)
    np.testing.assert_array_equal(bounds[-1], last)
    assert (bounds >= np.minimum(HIGH, LOW) - 1e-12).all()
    assert (bounds <= np.maximum(HIGH, LOW) + 1e-12).all()
    # A wrench within the limits of the axes is within the limits of the norms. The energy tank uses only the axes.
    assert (np.linalg.norm(bounds[:, :3], axis=1) <= bounds[:, 6] + 1e-9).all()
    assert (np.linalg.norm(bounds[:, 3:6], axis=1) <= bounds[:, 7] + 1e-9).all()


def test_lower_limit_of_the_task_applies_at_once():
    rig = Rig(task=np.full(8, 100.0))
    np.testing.assert_array_equal(rig.run(2)[-1], HIGH)
    rig.set(rig.task, np.full(8, 0.3))
    np.testing.assert_array_equal(rig.run(1)[0], np.full(8, 0.3))
    mixed = np.r_[np.full(3, 4.0), np.full(5, 50.0)]
    rig.set(rig.task, mixed)
    np.testing.assert_array_equal(rig.run(1)[0], np.minimum(HIGH, mixed))


@pytest.mark.parametrize("state", [-1.0, -0.5, 0.5, 2.0, np.nan, np.inf])
def test_unknown_state_has_the_lowest_limits(state):
    mixed = np.r_[LOW[:3], HIGH[3:6], LOW[6], HIGH[7]]
    rig = Rig(state, limits=(np.r_[HIGH[:3], LOW[3:6], HIGH[6], LOW[7]], mixed))
    np.testing.assert_array_equal(rig.run(2)[-1], LOW)


def test_each_of_1100_states_has_its_own_limit():
    limits = np.tile(LOW, (1100, 1))
    limits[-1] = HIGH
    np.testing.assert_array_equal(Rig(1099.0, limits=limits).bound, HIGH)
    np.testing.assert_array_equal(Rig(1098.0, limits=limits).bound, LOW)


def test_limits_are_copied_and_may_be_lists():
    limits = np.array([HIGH, LOW])
    system = PhaseWrenchLimit(limits, RATE.tolist(), period=PERIOD)
    limits[:] = 0.0
    context = system.CreateDefaultContext()
    system.get_state_input_port().FixValue(context, [0.0])
    np.testing.assert_array_equal(system.get_phase_max_wrench_output_port().Eval(context), HIGH)
    PhaseWrenchLimit([HIGH.tolist()], RATE, period=PERIOD)


def test_initialization_resets_the_bound():
    rig = Rig(1.0)
    rig.run(2)
    rig.set(rig.source, [0.0])
    rig.simulator.Initialize()
    np.testing.assert_array_equal(rig.bound, HIGH)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"limits": np.ones(8)}, "must have the shape"),
        ({"limits": np.ones((0, 8))}, "must have the shape"),
        ({"limits": np.ones((2, 6))}, "must have the shape"),
        ({"limits": np.full((2, 8), np.inf)}, "finite and not negative"),
        ({"limits": np.full((2, 8), np.nan)}, "finite and not negative"),
        ({"limits": np.full((2, 8), -1e-9)}, "finite and not negative"),
        ({"limits": np.r_[np.zeros((1, 8)), [[0.0] * 7 + [np.inf]]]}, "finite and not negative"),
        ({"limits": np.r_[[[-1e-9] + [0.0] * 7], np.zeros((1, 8))]}, "finite and not negative"),
        ({"max_rate": np.zeros(8)}, "8 positive, finite numbers"),
        ({"max_rate": np.r_[np.ones(7), 0.0]}, "8 positive, finite numbers"),
        ({"max_rate": np.r_[np.nan, np.ones(7)]}, "8 positive, finite numbers"),
        ({"max_rate": np.full(8, np.inf)}, "8 positive, finite numbers"),
        ({"max_rate": np.ones(6)}, "8 positive, finite numbers"),
        ({"period": 0.0}, "period must be positive"),
    ],
)
def test_constructor_refuses_arguments_out_of_range(change, words):
    arguments = {"limits": np.zeros((2, 8)), "max_rate": RATE, "period": PERIOD}
    PhaseWrenchLimit(**arguments)
    PhaseWrenchLimit(**arguments | {"max_rate": np.full(8, 1e-3)})
    with pytest.raises(InputError, match=words):
        PhaseWrenchLimit(**arguments | change)
