"""Kernels k(ζ, ζ') of a kernelized movement primitive (thesis, section 2.2.7), and their registry."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from guiderail.models.common.arrays import as_number
from guiderail.models.common.errors import InputError, brief, naming_failures
from guiderail.models.common.registry import Registry, check_callable, did_you_mean


class Kernel(Protocol):
    """Positive definite function of two inputs, evaluated on whole arrays at once."""

    #: True if k depends on ζ − ζ' only; on a uniform clock, the kernel matrix is then the same in every window.
    stationary: bool

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return k (N, M) between rows of `a` (N,) or (N, I) and `b` (M,) or (M, I), in the arguments' precision."""
        ...


KERNELS: Registry[Callable[..., Kernel]] = Registry("kernel", plugin="kernel", check=check_callable)
"""Registry of kernels; the names are the values of an environment's option `kernel`.

An entry is called with `length_scale=` and its further parameters, all of them numbers, and returns a kernel.
"""
register_kernel = KERNELS.register
DEFAULT_KERNEL = "squared_exponential"
DEFAULT_LENGTH_SCALE = 0.5
_SMALLEST, _LARGEST = 1e-100, 1e100  # bounds of a length scale; far outside of them, kernels overflow or are NaN
_CHECKED = 48  # number of inputs at which `check_kernel` evaluates a kernel
_SHIFTS = (0.37, -0.83, 2.9)  # shifts of inputs by which `check_kernel` tests stationarity, relative to their range
_ROUNDING = 1e-9  # largest accepted rounding error of a kernel, relative to its largest value


def make_kernel(
    name: str = DEFAULT_KERNEL,
    length_scale: float = DEFAULT_LENGTH_SCALE,
    parameters: Mapping[str, float] | None = None,
) -> Kernel:
    """Build a registered kernel; the last 100 kernels are cached and shared.

    Args:
        name: Registered name of the kernel.
        length_scale: Length scale ℓ, in the unit of the input, positive.
        parameters: Further parameters of the kernel by name.

    Raises:
        InputError: If there is no such kernel, a parameter is missing or unknown, or a value is not a number or is out
            of range.
    """
    factory = KERNELS.get(name)
    parameters = parameters or {}
    signature = inspect.signature(factory)
    accepted = [key for key in signature.parameters if key != "length_scale"]
    for key in parameters:
        if key not in accepted:
            raise InputError(f"the kernel {name!r} has no parameter {brief(key)}: {did_you_mean(key, accepted)}")
    try:
        signature.bind(length_scale=length_scale, **parameters)
    except TypeError as error:
        raise InputError(
            f"the kernel {name!r} can't be made of length_scale and parameters ({error}): register a class with the "
            "argument length_scale, whose instances take two arrays of inputs"
        ) from error
    for key, value in {"length_scale": length_scale, **parameters}.items():
        as_number(value, f"the kernel's {key}")
    return _build(factory, length_scale, tuple(sorted(parameters.items())))


@lru_cache(maxsize=100)
def _build(factory: Callable[..., Kernel], length_scale: float, parameters: tuple[tuple[str, Any], ...]) -> Kernel:
    with naming_failures(f"constructing the kernel {getattr(factory, '__name__', brief(factory))}"):
        return factory(length_scale=length_scale, **dict(parameters))


def kernel_name(kernel: Kernel) -> str | None:
    """Return the name under which the class of `kernel` is registered, or None."""
    return KERNELS.name_of(type(kernel))


def check_kernel(kernel: Any, inputs: np.ndarray) -> None:
    """Check that a kernel is positive definite on a subset of `inputs` (n,) or (n, I), and stationary as declared.

    The subset has at most 48 inputs: the first inputs, and further inputs at equal distances.

    Raises:
        InputError: If `kernel` is not a kernel; if its matrix has the wrong shape or type, is not finite, not symmetric
            or not positive definite; or if the kernel is declared stationary and is not.
    """
    if isinstance(kernel, type) or not callable(kernel):
        raise InputError(f"a kernel is an object such as SquaredExponential(0.5), not {brief(kernel)}")
    name = f"the kernel {kernel_name(kernel) or type(kernel).__name__}"
    if not isinstance(getattr(kernel, "stationary", None), bool | np.bool_):
        raise InputError(f"{name} has no attribute stationary, True or False: add it to the class")
    n = len(inputs)
    first = np.arange(min(n, _CHECKED // 3))
    steps = np.unique(np.r_[first, np.linspace(0, n - 1, min(n, _CHECKED - len(first))).astype(int)])
    x = inputs[steps].astype(np.longdouble)
    K = _checked_matrix(kernel, name, x, x)
    rounding = max(_ROUNDING, 10 * len(x) * np.finfo(K.dtype).eps)
    K = K.astype(float)
    largest = np.abs(K).max()
    if not np.allclose(K, K.T, rtol=0.0, atol=rounding * largest):
        raise InputError(f"{name} is not symmetric: k(a, b) must be k(b, a) at all inputs")
    if not (K.diagonal() > 0.0).all():
        at, value = x[np.argmin(K.diagonal())], K.diagonal().min()
        raise InputError(f"{name} is not positive definite: k(a, a) must be positive, and is {value:g} at a = {at}")
    eigenvalues = np.linalg.eigvalsh(K)
    if not eigenvalues[0] >= -rounding * eigenvalues[-1]:
        raise InputError(
            f"{name} is not positive definite: the smallest eigenvalue of its matrix at {len(x)} inputs is "
            f"{eigenvalues[0]:.3g}, and the largest one {eigenvalues[-1]:.3g}"
        )
    part = _checked_matrix(kernel, name, x[:2], x).astype(float)
    if not np.allclose(part, K[:2], rtol=0.0, atol=rounding * largest):
        raise InputError(f"{name} changes if evaluated at fewer inputs: k(a, b) must depend on a and b only")
    if kernel.stationary:
        extent = np.where(np.ptp(x, axis=0) > 0.0, np.ptp(x, axis=0), 1.0)
        for shift in _SHIFTS:
            moved = x + shift * extent
            if not np.allclose(_checked_matrix(kernel, name, moved, moved), K, rtol=0.0, atol=rounding * largest):
                raise InputError(
                    f"{name} declares stationary = True, but its values change when all inputs are shifted: declare "
                    "stationary = False"
                )


def _checked_matrix(kernel: Kernel, name: str, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the kernel matrix of two arrays of inputs; raise an InputError unless it has finite real numbers."""
    with naming_failures(f"evaluating {name}"):
        K: Any = kernel(a, b)
    shape = (len(a), len(b))
    if not (isinstance(K, np.ndarray) and K.shape == shape and K.dtype.kind == "f"):
        got = f"an array of {K.dtype} of shape {K.shape}" if isinstance(K, np.ndarray) else type(K).__name__
        raise InputError(f"{name} must return an array of real numbers of shape {shape}, not {got}")
    if not np.isfinite(K).all():
        raise InputError(f"{name} returns values that are not finite")
    return K


@dataclass(frozen=True)
class _StationaryKernel:
    length_scale: float = DEFAULT_LENGTH_SCALE
    stationary = True

    def __post_init__(self) -> None:
        if not _SMALLEST <= as_number(self.length_scale, "the kernel's length_scale") <= _LARGEST:
            raise InputError(
                f"the kernel's length_scale must be positive, {_SMALLEST:g} to {_LARGEST:g}, not {self.length_scale}"
            )


@register_kernel("squared_exponential")
@dataclass(frozen=True)
class SquaredExponential(_StationaryKernel):
    """The thesis's kernel k(ζ, ζ') = exp(−‖ζ − ζ'‖² / (2 ℓ²)) (section 4.3.3).

    The thesis writes it as exp(−l ‖ζ − ζ'‖²): l = 1 / (2 ℓ²), and its l = 2 is ℓ = 0.5.

    Args:
        length_scale: Length scale ℓ, in the unit of the input, positive.
    """

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return k between the rows of `a` and `b`, as `Kernel` declares it."""
        return np.exp(-(0.5 / self.length_scale**2) * _squared_distance(a, b))


@register_kernel("matern52")
@dataclass(frozen=True)
class Matern52(_StationaryKernel):
    """The Matérn kernel k(ζ, ζ') = (1 + s + s²/3) exp(−s) with s = √5 ‖ζ − ζ'‖ / ℓ.

    Random motions with this covariance are only twice differentiable. The kernel suits motions for which the squared
    exponential kernel is too smooth, such as motions with a contact in the middle.

    Args:
        length_scale: Length scale ℓ, in the unit of the input, positive.
    """

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return k between the rows of `a` and `b`, as `Kernel` declares it."""
        s = np.sqrt(5 * _squared_distance(a, b)) / self.length_scale
        return (1 + s + s * s / 3) * np.exp(-s)


def _squared_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = (x[:, None] if x.ndim == 1 else x for x in (np.asarray(a), np.asarray(b)))
    return ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=-1)
