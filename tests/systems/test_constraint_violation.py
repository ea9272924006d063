import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.constraint_violation import ConstraintViolation


def violation(system, pose):
    context = system.CreateDefaultContext()
    system.get_pose_input_port().FixValue(context, pose)
    return system.get_violation_output_port().Eval(context)[0]


def test_is_the_worst_of_all_constraints():
    system = ConstraintViolation(LinearConstraints.box([-1.0, -1.0], [1.0, 1.0]), 0.1)
    assert violation(system, [0.0, 0.0]) == -1.0
    assert violation(system, [0.5, -0.75]) == -0.25
    assert violation(system, [1.5, -3.0]) == 2.0


def test_says_unconstrained_where_nothing_is():
    assert (
        violation(ConstraintViolation(LinearConstraints.none(2), 0.1), [1.0, 2.0]) == ConstraintViolation.UNCONSTRAINED
    )


def test_does_not_take_nan_for_unconstrained():
    assert np.isnan(violation(ConstraintViolation(LinearConstraints.box([0.0], [1.0]), 0.1), [np.nan]))


def test_follows_constraints_that_change_from_step_to_step():
    bounds = np.arange(4.0)[:, None]  # y <= 0, 1, 2, 3
    system = ConstraintViolation(LinearConstraints.box(np.full((4, 1), -np.inf), bounds), 0.1)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_pose_input_port().FixValue(context, [2.0])
    simulator.Initialize()
    seen = []
    for n in range(6):
        # Before the events of an instant it still judges by the step that is just over.
        simulator.AdvanceTo((n + 1) * 0.1)
        seen.append(system.get_violation_output_port().Eval(context)[0])
    np.testing.assert_array_equal(seen, [2.0, 1.0, 0.0, -1.0, -1.0, -1.0])


def test_refuses_what_makes_no_sense():
    with pytest.raises(InputError):
        ConstraintViolation(LinearConstraints.none(2), 0.0)
