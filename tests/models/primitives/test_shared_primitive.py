import gc

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import LcNsKmp, LinearConstraints, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.lc_ns_kmp import get_shared_primitive

STEPS = 30
KERNEL = SquaredExponential(0.5)


def reference(height=1.0):
    times = np.linspace(0.0, 1.0, STEPS)
    means = np.stack([np.sin(times), height * times], axis=1)
    return ReferenceTrajectory(times, means, np.tile(0.01 * np.eye(2), (STEPS, 1, 1)))


def box(half=0.9):
    return LinearConstraints.box([-half, -half], [half, half])


def test_equal_arguments_share_a_primitive_in_use():
    first = get_shared_primitive(reference(), box(), KERNEL, history=2, lambda_=6)
    assert get_shared_primitive(reference(), box(), KERNEL, lambda_=6.0, history=2) is first


@pytest.mark.parametrize(
    "other",
    [
        lambda: get_shared_primitive(reference(1.1), box(), KERNEL, history=2),
        lambda: get_shared_primitive(reference(), box(0.8), KERNEL, history=2),
        lambda: get_shared_primitive(reference(), box(), SquaredExponential(0.4), history=2),
        lambda: get_shared_primitive(reference(), box(), KERNEL, history=3),
        lambda: get_shared_primitive(reference(), box(), KERNEL, history=2, solver="osqp"),
    ],
)
def test_different_arguments_make_another_primitive(other):
    assert other() is not get_shared_primitive(reference(), box(), KERNEL, history=2)


def test_shared_primitive_predicts_as_its_own():
    shared = get_shared_primitive(reference(), box(), KERNEL, history=2)
    past, action = np.array([[0.0, 0.0], [0.01, 0.01]]), np.array([3.0, -2.0])
    shared.predict(7, -action, past)  # earlier steps do not matter
    own = LcNsKmp(reference(), kernel=KERNEL, constraints=box(), history=2)
    np.testing.assert_array_equal(shared.predict(5, action, past).output, own.predict(5, action, past).output)


def test_unused_primitive_is_released():
    from guiderail.models.primitives.lc_ns_kmp import _SHARED

    get_shared_primitive(reference(1.7), box(), KERNEL)
    gc.collect()
    assert not [primitive for primitive in _SHARED.values() if primitive.reference.means[-1, 1] == 1.7]


def test_invalid_arguments_are_refused():
    with pytest.raises(InputError, match="lambda_"):
        get_shared_primitive(reference(), box(), KERNEL, lambda_=-1.0)
