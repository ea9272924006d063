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
    """System with sources of the state's and of the task's limit."""

    def __init__(self, limit=HIGH, task=None, bound=HIGH):
        builder = DiagramBuilder()
        self.source = builder.AddSystem(ConstantVectorSource(limit))
        self.system = builder.AddSystem(PhaseWrenchLimit(bound, RATE, period=PERIOD))
        builder.Connect(self.source.get_output_port(), self.system.get_state_max_wrench_input_port())
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


@pytest.mark.parametrize(("limit", "expected"), [(HIGH, HIGH), (LOW, LOW), (np.full(8, np.inf), HIGH)])
def test_bound_starts_at_the_limit_of_the_first_state(limit, expected):
    rig = Rig(limit)
    np.testing.assert_array_equal(rig.bound, expected)
    np.testing.assert_array_equal(rig.run(3), [expected] * 3)


def test_first_update_applies_the_limit_of_its_state_at_once():
    """A state machine may set its first state at the same instant at which this system is initialized."""
    rig = Rig(HIGH)
    rig.set(rig.source, LOW)
    np.testing.assert_array_equal(rig.run(1)[0], LOW)


@pytest.mark.parametrize(("first", "last"), [(HIGH, LOW), (LOW, HIGH)])
def test_bound_changes_at_the_largest_rate(first, last):
    rig = Rig(first)
    rig.run(2)
    rig.set(rig.source, last)
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


@pytest.mark.parametrize("invalid", [-1.0, -1e-9, np.nan])
def test_invalid_number_keeps_the_last_bound(invalid):
    rig = Rig(LOW)
    rig.run(2)
    rig.set(rig.source, np.r_[np.full(4, invalid), HIGH[4:]])
    bounds = rig.run(60)
    np.testing.assert_array_equal(bounds[:, :4], np.tile(LOW[:4], (60, 1)))
    np.testing.assert_array_equal(bounds[-1, 4:], HIGH[4:])


def test_invalid_number_is_zero_at_the_start():
    rig = Rig(np.r_[np.nan, -1.0, HIGH[2:]])
    np.testing.assert_array_equal(rig.bound, np.r_[0.0, 0.0, HIGH[2:]])


def test_initialization_resets_the_bound():
    rig = Rig(LOW)
    rig.run(2)
    rig.set(rig.source, HIGH)
    rig.simulator.Initialize()
    np.testing.assert_array_equal(rig.bound, HIGH)


def test_limit_that_nothing_reads_is_refused():
    rig = Rig()
    with pytest.raises(InputError, match="connect its output phase_max_wrench to the controller's input max_wrench"):
        rig.simulator.AdvanceTo(2.5 * PERIOD)
