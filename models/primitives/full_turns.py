"""Removal of full-turn jumps from angles and rotation vectors: a full turn changes numbers but not orientations."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Literal, cast

import numpy as np

from guiderail.models.common.errors import InputError, brief

Orientation = Literal["euler_zyx", "rotation_vector"]

# Orientation by the names of the last three of six outputs, in lower case and without units. `guiderail dataset import`
# names Euler angles Rz, Ry and Rx.
_ANGLE_NAMES = {
    ("psi_z", "psi_y", "psi_x"): "euler_zyx",
    ("rz", "ry", "rx"): "euler_zyx",
    ("r_x", "r_y", "r_z"): "rotation_vector",
}
# Unit at the end of an output's name.
_DEGREES = re.compile(
    r"(?:[\[(]\s*(?:deg|degrees?|\u00b0)\s*[\])]|_deg)\s*$", re.IGNORECASE
)  # unit of an output's name
_UR_NAMES = ("rx", "ry", "rz")  # names of a rotation vector on a Universal Robots arm
# Largest absolute value of angles without a unit that may be wrapped [rad]; beyond it they may be in degrees.
_MAX_WRAPPED = 2 * math.pi + 0.1
_MAX_ROTATION = 1.0  # largest rotation between two samples at which a change of about a full turn is a jump [rad]


def orientation_of_names(names: Sequence[str]) -> Orientation | None:
    """Return the representation of the orientation in six outputs with the given names.

    An orientation in degrees is refused, because all guidance computes with radians. Names of orientations are those
    of `poses.POSE_NAMES`, and "Rz [rad]", "Ry [rad]", "Rx [rad]" for Euler angles, as
    `guiderail dataset import` writes them. The result is None for other names and for another number of names.
    """
    plain = _plain([_DEGREES.sub("", name) for name in names])
    if len(plain) != 6:
        return None
    orientation = cast("Orientation | None", _ANGLE_NAMES.get(plain[3:]))
    if orientation is not None or plain[3:] == _UR_NAMES:
        for name in names[3:]:
            if _DEGREES.search(name):
                raise InputError(
                    f"the orientation {brief(name)} is in degrees: convert it to radians, and name it with [rad]"
                )
    return orientation


def without_jumps(outputs: Sequence[np.ndarray], names: Sequence[str]) -> tuple[np.ndarray, ...]:
    """Remove full-turn jumps of angles and rotation vectors between samples, and between the arrays' first samples.

    An output is an angle if its name contains the unit "[rad]". The last three of six outputs are Euler angles or a
    rotation vector if they have such names (`orientation_of_names`, or "rx", "ry", "rz" for a rotation vector). If the
    names state no unit and a value exceeds a full turn, the numbers may be degrees and are kept. Outputs without a jump
    are returned unchanged.

    Args:
        outputs: M arrays (N_m, O); their first samples are compared with that of the first array.
        names: Names of the O outputs.
    """
    plain = _plain(names)
    orientation = orientation_of_names(names)
    has_vector = orientation == "rotation_vector" or (len(plain) == 6 and plain[3:] == _UR_NAMES)
    has_angles = orientation == "euler_zyx"
    if (has_vector or has_angles) and not all("[rad]" in name for name in names[3:]):
        largest = max(float(np.abs(y[:, 3:]).max(initial=0.0)) for y in outputs)
        has_vector, has_angles = has_vector and largest <= _MAX_WRAPPED, has_angles and largest <= _MAX_WRAPPED
    is_angle = ["[rad]" in name or (has_angles and o > 2) for o, name in enumerate(names)]
    result: list[np.ndarray] = []
    for y in outputs:
        first, changed = (result[0] if result else y)[0], y
        if has_vector:
            if _has_jump(y[:, 3:], first[3:]):
                changed = np.column_stack([y[:, :3], continued_vectors(y[:, 3:], first[3:])])
        elif any(is_angle):
            steps = np.diff(y, axis=0, prepend=first[None])
            turns = np.where(np.abs(np.abs(steps) - 2 * math.pi) <= _MAX_ROTATION, np.sign(steps), 0.0) * is_angle
            if turns.any():
                changed = y - 2 * math.pi * np.cumsum(turns, axis=0)
        result.append(changed)
    return tuple(result)


def continued_angles(angles: np.ndarray, near: np.ndarray | None) -> np.ndarray:
    """Remove full-turn jumps from angles (N, 3), starting on the branch nearest to `near` (3,), zero if None [rad]."""
    angles = np.unwrap(angles, axis=0)
    start = np.zeros(3) if near is None else near
    return angles - 2 * np.pi * np.round((angles[0] - start) / (2 * np.pi))


def continued_vectors(vectors: np.ndarray, near: np.ndarray | None) -> np.ndarray:
    """Replace each rotation vector (N, 3) by the equivalent r + 2πk r/‖r‖ nearest to the last, at first to `near`."""
    vectors = np.array(vectors)
    last = np.zeros(3) if near is None else near
    for i, r in enumerate(vectors):
        angle = np.linalg.norm(r)
        # A rotation near zero has no axis of its own: use the previous one.
        axis = r / angle if angle > 1e-9 else last / max(float(np.linalg.norm(last)), 1e-300)
        turns = np.round((axis @ last - angle) / (2 * np.pi))
        vectors[i] = last = (angle + 2 * np.pi * turns) * axis
    return vectors


def _has_jump(vectors: np.ndarray, near: np.ndarray) -> bool:
    """Return True if a rotation vector (N, 3) is a full turn away from its predecessor, the first one from `near`."""
    previous = np.concatenate([near[None], vectors[:-1]])
    is_far = np.abs(np.linalg.norm(vectors - previous, axis=1) - 2 * math.pi) <= _MAX_ROTATION
    pairs = zip(vectors[is_far], previous[is_far], strict=True)
    return any(np.linalg.norm(continued_vectors(r[None], last)[0] - last) <= _MAX_ROTATION for r, last in pairs)


def _plain(names: Sequence[str]) -> tuple[str, ...]:
    """Return names in lower case and without units."""
    return tuple(name.partition("[")[0].strip().lower() for name in names)
