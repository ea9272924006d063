"""Kernels k(ζ, ζ') of a kernelized movement primitive (thesis, section 2.2.7), and their registry."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Protocol

import numpy as np

from guiderail.models.common.arrays import as_number
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import Registry, did_you_mean


class Kernel(Protocol):
    """Positive definite function of two inputs, evaluated on whole arrays at once."""

    #: True if k depends on ζ − ζ' only: a uniform clock then has the same kernel matrix in every window.
    stationary: bool

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return k (N, M) between the rows of `a` (N,) or (N, I) and `b` (M,) or (M, I), in their precision."""
        ...


KERNELS: Registry[Callable[..., Kernel]] = Registry("kernel", entry_points="guiderail.kernels")
"""Registry of kernels; their names are the values of an environment's option `kernel`.

An entry is called with `length_scale=` and its own further parameters, all of them numbers, and returns a kernel.
"""
register_kernel = KERNELS.register
DEFAULT_KERNEL = "squared_exponential"
DEFAULT_LENGTH_SCALE = 0.5
_SMALLEST, _LARGEST = 1e-100, 1e100  # bounds of a length scale: far beyond them, kernels overflow or are NaN


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
        InputError: If there is no such kernel, a parameter is missing or not one of the kernel's, or a value is not one
            number or out of range.
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
    return factory(length_scale=length_scale, **dict(parameters))


def kernel_name(kernel: Kernel) -> str | None:
    """Return the name that the class of `kernel` is registered by, or None."""
    return next((name for name in KERNELS.names() if KERNELS.get(name) is type(kernel)), None)


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

    Raises:
        InputError: If the length scale is not in [1e-100, 1e100].
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

    Raises:
        InputError: If the length scale is not in [1e-100, 1e100].
    """

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return k between the rows of `a` and `b`, as `Kernel` declares it."""
        s = np.sqrt(5 * _squared_distance(a, b)) / self.length_scale
        return (1 + s + s * s / 3) * np.exp(-s)


def _squared_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = (x[:, None] if x.ndim == 1 else x for x in (np.asarray(a), np.asarray(b)))
    return ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=-1)
