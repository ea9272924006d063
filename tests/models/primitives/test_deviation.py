"""Constraints in another unit than the reference are refused."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory

STEPS = 20
LINE = np.column_stack([np.full(STEPS, 0.35), np.linspace(0.1, 0.9, STEPS)])
BOUNDS = np.array([[0.25, -np.inf], [0.45, np.inf]])


def primitive(constraints, scale=1.0, means=LINE):
    covariances = np.tile((0.04 * scale) ** 2 * np.eye(2), (STEPS, 1, 1))
    reference = ReferenceTrajectory(0.02 * np.arange(STEPS), scale * means, covariances)
    return LcNsKmp(reference, constraints=constraints, lambda_=6.0 / scale**2, beta=6.0 / scale**2)


def test_primitive_refuses_constraints_in_millimeters():
    with pytest.raises(InputError, match=r"250 outside of constraint 0 at step 0.*in one unit"):
        primitive(LinearConstraints.box(*(1e3 * BOUNDS)))


def test_primitive_refuses_millimeters_at_one_step():
    lower, upper = (np.tile(bound, (STEPS, 1)) for bound in BOUNDS)
    lower[7, 0], upper[7, 0] = 250.0, 450.0
    with pytest.raises(InputError, match="outside of constraint 0 at step 7"):
        primitive(LinearConstraints.box(lower, upper))


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_primitive_accepts_constraints_in_the_same_unit(scale):
    assert primitive(LinearConstraints.box(*(scale * BOUNDS)), scale).num_steps == STEPS
    outside = LinearConstraints.box([5.0 * scale, -np.inf], [np.inf, np.inf])  # the reference is outside
    assert primitive(outside, scale).num_steps == STEPS


def test_constraint_may_exclude_a_constant_reference():
    constraints = LinearConstraints.box([500.0, -np.inf], [np.inf, np.inf])
    assert primitive(constraints, means=np.full((STEPS, 2), 0.35)).num_steps == STEPS
