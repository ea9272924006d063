"""A digest of arrays and text: whether a file holds what was written, to the last bit."""

import hashlib
from collections.abc import Mapping

import numpy as np


def digest(arrays: Mapping[str, np.ndarray], text: str) -> str:
    """A digest of names, types, shapes and contents, and of a text."""
    found = hashlib.blake2b(text.encode())
    for key in sorted(arrays):
        found.update(f"{key} {arrays[key].dtype} {arrays[key].shape}".encode())
        found.update(arrays[key].tobytes())
    return found.hexdigest()
