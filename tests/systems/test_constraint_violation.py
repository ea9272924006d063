import numpy as np
from pydrake.systems.analysis import Simulator

from guiderail.models.primitives import LinearConstraints
from guiderail.systems.command_checks import ConstraintViolation


def violation(system, pose):
    """Return the constraint violation of a pose in the first control step."""
    context = system.CreateDefaultContext()
    system.get_pose_input_port().FixValue(context, pose)
    return system.get_violation_output_port().Eval(context)[0]


def test_violation_is_the_maximum_over_all_constraints():
    system = ConstraintViolation(LinearConstraints.box([-1.0, -1.0], [1.0, 1.0]), 0.1)
    assert violation(system, [0.0, 0.0]) == -1.0
    assert violation(system, [0.5, -0.75]) == -0.25
    assert violation(system, [1.5, -3.0]) == 2.0


def test_violation_has_its_lower_limit_without_constraints():
    assert ConstraintViolation.UNCONSTRAINED == -1e30
    assert violation(ConstraintViolation(LinearConstraints.none(2), 0.1), [1.0, 2.0]) == -1e30
    far = ConstraintViolation(LinearConstraints.box([-1.0005e30], [np.inf]), 0.1)
    assert violation(far, [0.0]) == -1e30


def test_violation_is_nan_when_the_pose_is_nan():
    assert np.isnan(violation(ConstraintViolation(LinearConstraints.box([0.0], [1.0]), 0.1), [np.nan]))


def test_violation_uses_the_constraints_of_the_control_step():
    bounds = np.arange(50.0)[:, None]  # y <= 0, 1, 2, ...
    system = ConstraintViolation(LinearConstraints.box(np.full((50, 1), -np.inf), bounds), 0.1)
    simulator = Simulator(system)
    context = simulator.get_mutable_context()
    system.get_pose_input_port().FixValue(context, [2.0])
    simulator.Initialize()
    violations = []
    for n in range(52):
        # Before the events of an instant, the constraints of the previous step apply.
        simulator.AdvanceTo((n + 1) * 0.1)
        violations.append(system.get_violation_output_port().Eval(context)[0])
    np.testing.assert_array_equal(violations, 2.0 - np.minimum(np.arange(52.0), 49.0))


def test_system_has_no_state_when_constraints_are_constant():
    system = ConstraintViolation(LinearConstraints.box([0.0], [1.0]), 0.1)
    assert system.CreateDefaultContext().num_discrete_state_groups() == 0
