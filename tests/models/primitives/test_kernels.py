import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Kmp, LcNsKmp, Matern52, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.kernels import check_kernel, make_kernel

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
def test_kernel_refuses_a_length_scale_of_wrong_type(scale):
    for make in (Matern52, lambda scale: make_kernel(length_scale=scale)):
        with pytest.raises(InputError, match="the kernel's length_scale must be a number, not"):
            make(scale)


def function_kernel(function, stationary=True):
    """Return a kernel of scalar inputs that evaluates a function of two arrays of one shape."""

    class FunctionKernel:
        def __call__(self, a, b):
            return function(*np.broadcast_arrays(np.reshape(a, (-1, 1)), np.reshape(b, (1, -1))))

    FunctionKernel.stationary = stationary
    return FunctionKernel()


def decay(a, b):
    return np.exp(-((a - b) ** 2))


INVALID_KERNELS = [
    (lambda a, b: np.cos(5 * (a - b)) - 0.5, "is not positive definite: the smallest eigenvalue of its matrix"),
    (lambda a, b: abs(a - b), r"is not positive definite: k\(a, a\) must be positive, and is 0"),
    (lambda a, b: -decay(a, b), r"is not positive definite: k\(a, a\) must be positive, and is -1"),
    (lambda a, b: 0 * a, r"is not positive definite: k\(a, a\) must be positive, and is 0"),
    (lambda a, b: decay(a, b) * (1 + a - b), "is not symmetric"),
    (lambda a, b: decay(a, b) * (1 + a) * (1 + b), "declares stationary = True, but its values change"),
    (lambda a, b: decay(a, b) * np.nan, "returns values that are not finite"),
    (lambda a, b: decay(a, b) * (1 + 0j), "array of real numbers .* not an array of complex"),
    (lambda a, b: (a == b).astype(int), "array of real numbers .* not an array of int"),
    (lambda a, b: np.zeros(3), r"must return an array of real numbers of shape .* not an array of .* \(3,\)"),
    (lambda a, b: decay(a, b).tolist(), "must return an array of real numbers .* not list"),
    (lambda a, b: None, "must return an array of real numbers .* not NoneType"),
    (lambda a, b: {}["scale"], r"failed: test_kernels\.py, line \d+: KeyError: 'scale'"),
    (lambda a, b: decay(a, b) / len(a), "changes if evaluated at fewer inputs"),
]


@pytest.mark.parametrize(("function", "message"), INVALID_KERNELS)
@pytest.mark.parametrize("history", [0, 3])
def test_primitive_refuses_invalid_kernel_functions(function, message, history):
    means, covariances = np.zeros((60, 1)), 0.1 * np.ones((60, 1, 1))
    reference = ReferenceTrajectory(np.linspace(0.0, 2.0, 60), means, covariances)
    with pytest.raises(InputError, match=f"the kernel FunctionKernel .*{message}"):
        LcNsKmp(reference, function_kernel(function), history=history)
    with pytest.raises(InputError, match=f"the kernel FunctionKernel .*{message}"):
        Kmp(reference.times, means, covariances, function_kernel(function))


def test_check_requires_a_declared_stationarity():
    check_kernel(function_kernel(lambda a, b: decay(a, b) * (1 + a) * (1 + b), stationary=False), np.linspace(0, 2, 60))
    for kernel in (function_kernel(decay, stationary=None), decay):
        with pytest.raises(InputError, match="has no attribute stationary, True or False"):
            check_kernel(kernel, np.linspace(0, 2, 60))
    for kernel in (SquaredExponential, 3):
        with pytest.raises(InputError, match="a kernel is an object such as"):
            check_kernel(kernel, np.linspace(0, 2, 60))


@pytest.mark.parametrize("kernel", [SquaredExponential, Matern52])
@pytest.mark.parametrize("scale", [1e-100, 1e-6, 0.01, 1.0, 1e3, 1e8, 1e100])
def test_check_accepts_the_kernels_of_the_package(kernel, scale):
    states = np.random.default_rng(0).normal(size=(50, 3))
    for inputs in (
        np.linspace(0, 2, 200),
        1e6 + np.linspace(0, 2, 200),
        np.linspace(0, 1e4, 2000),
        np.zeros(1),
        states,
    ):
        check_kernel(kernel(scale), inputs)
