import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Matern52, SquaredExponential
from guiderail.models.primitives.kernels import make_kernel

A, B = np.array([[0.0, 0.0], [0.3, -0.4]]), np.array([[0.0, 0.5], [1.0, 2.0], [0.3, -0.4]])
DISTANCE = np.array([[np.linalg.norm(a - b) for b in B] for a in A])


def test_squared_exponential_matches_its_closed_form():
    np.testing.assert_allclose(SquaredExponential(0.4)(A, B), np.exp(-(DISTANCE**2) / (2 * 0.4**2)), rtol=1e-14)


def test_matern52_matches_its_closed_form():
    s = np.sqrt(5) * DISTANCE / 0.7
    np.testing.assert_allclose(Matern52(0.7)(A, B), (1 + s + s**2 / 3) * np.exp(-s), rtol=1e-14)
    assert Matern52()(A, A).diagonal().tolist() == [1.0, 1.0]
    assert Matern52().length_scale == 0.5


@pytest.mark.parametrize("kernel", [SquaredExponential, Matern52])
@pytest.mark.parametrize("scale", [0.0, -1.0, np.nan, np.inf, 1e-160, 1e-320, 1e200])
def test_kernel_refuses_an_invalid_length_scale(kernel, scale):
    with pytest.raises(InputError, match="positive"):
        kernel(scale)


@pytest.mark.parametrize("scale", ["a", [1.0], None])
def test_length_scale_is_one_number(scale):
    for make in (Matern52, lambda scale: make_kernel(length_scale=scale)):
        with pytest.raises(InputError, match="the kernel's length_scale must be a number, not"):
            make(scale)
