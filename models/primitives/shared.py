"""Movement primitives that many diagrams of a process use: a step that one of them factored is factored for all."""

from __future__ import annotations

import hashlib
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from guiderail.models.primitives.constraints import LinearConstraints
from guiderail.models.primitives.kernels import SquaredExponential
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.reference import ReferenceTrajectory

# Only while somebody uses one: a primitive's factored steps take megabytes.
_USED: WeakValueDictionary[tuple[Any, ...], LcNsKmp] = WeakValueDictionary()


def shared_primitive(
    reference: ReferenceTrajectory, constraints: LinearConstraints, inverse_length: float, **arguments: Any
) -> LcNsKmp:
    """The primitive of these numbers: the one that is in use, or a new one.

    A primitive answers the same whatever it was asked before; what it remembers are factored steps. Nobody who gets
    one from here may change it.

    Args:
        reference, constraints: of `LcNsKmp`.
        inverse_length: of its squared exponential kernel.
        arguments: numbers and names, of `LcNsKmp`.

    Raises:
        InputError: as `LcNsKmp` does.
    """
    arrays = (reference.times, reference.means, reference.covariances, constraints.G, constraints.c)
    digest = hashlib.blake2b(digest_size=16)
    for array in arrays:
        digest.update(repr(array.shape).encode() + np.ascontiguousarray(array, dtype=float).tobytes())
    key = (digest.digest(), float(inverse_length), *sorted(arguments.items()))
    found = _USED.get(key)
    if found is None:
        kernel = SquaredExponential(inverse_length=inverse_length)
        found = LcNsKmp(reference, kernel=kernel, constraints=constraints, **arguments)
        _USED[key] = found
    return found
