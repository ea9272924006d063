"""Kernels k(ζ, ζ') of a kernelized movement primitive (thesis, section 2.2.7)."""

from typing import Protocol

import numpy as np

from guiderail.models.common.errors import InputError


class Kernel(Protocol):
    """A positive definite function of two inputs, evaluated on whole arrays at once."""

    #: True if k depends on ζ − ζ' only: a uniform clock then has the same kernel matrix in every window.
    stationary: bool

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """k between rows of `a` (N, I) or (N,) and `b` (M, I) or (M,): (N, M), in the precision of the inputs."""
        ...


def _squared_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    a, b = (x[:, None] if x.ndim == 1 else x for x in (np.asarray(a), np.asarray(b)))
    return ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=-1)


def _positive(name: str, value: float) -> float:
    if not (np.isfinite(value) and value > 0):
        raise InputError(f"{name} must be positive and finite, not {value}")
    return float(value)


class SquaredExponential:
    """k(ζ, ζ') = exp(−l ‖ζ − ζ'‖²), the thesis's own kernel (section 4.3.3)."""

    stationary = True

    def __init__(self, inverse_length: float = 2.0):
        """
        Args:
            inverse_length: l [1/input²], positive. The length scale in the usual convention is 1/√(2l).

        Raises:
            InputError: if l is not positive and finite.
        """
        self.inverse_length = _positive("the kernel's inverse_length", inverse_length)

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.exp(-self.inverse_length * _squared_distance(a, b))

    def __repr__(self) -> str:
        return f"SquaredExponential(inverse_length={self.inverse_length})"


class Matern52:
    """k(ζ, ζ') = (1 + s + s²/3) exp(−s) with s = √5 ‖ζ − ζ'‖ / length: twice differentiable only.

    For motions that the squared exponential kernel is too smooth for, such as those with a contact in the middle.
    """

    stationary = True

    def __init__(self, length: float = 0.5):
        """
        Args:
            length: length scale [input], positive.

        Raises:
            InputError: if the length is not positive and finite.
        """
        self.length = _positive("the kernel's length", length)

    def __call__(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        s = np.sqrt(5 * _squared_distance(a, b)) / self.length
        return (1 + s + s * s / 3) * np.exp(-s)

    def __repr__(self) -> str:
        return f"Matern52(length={self.length})"
