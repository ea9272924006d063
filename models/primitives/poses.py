"""Poses as outputs of a primitive: six continuous numbers in a target frame (thesis, section 4.4.2).

A full turn changes angles and rotation vectors but not orientations: jumps by full turns are removed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, cast

import numpy as np

from guiderail.models.common.errors import InputError, brief

# Importing scipy.spatial takes a fifth of a second, and a primitive does not need it.
if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

SINGULAR = math.sin(math.radians(89.0))  # largest |sin Ry| of Euler angles [Rz Ry Rx]

Orientation = Literal["euler_zyx", "rotation_vector"]
POSE_NAMES: dict[str, tuple[str, ...]] = {
    "euler_zyx": ("x [m]", "y [m]", "z [m]", "psi_z [rad]", "psi_y [rad]", "psi_x [rad]"),
    "rotation_vector": ("x [m]", "y [m]", "z [m]", "r_x [rad]", "r_y [rad]", "r_z [rad]"),
}
"""Names of the six outputs, by the representation of the orientation."""
# Orientation by the names of the last three of six outputs, in lower case and without units. `guiderail dataset import`
# names Euler angles Rz, Ry and Rx.
_ANGLE_NAMES = {
    ("psi_z", "psi_y", "psi_x"): "euler_zyx",
    ("rz", "ry", "rx"): "euler_zyx",
    ("r_x", "r_y", "r_z"): "rotation_vector",
}
# Unit at the end of an output's name.
_DEGREES = re.compile(r"(?:[\[(]\s*(?:deg|degrees?|\u00b0)\s*[\])]|_deg)\s*$", re.IGNORECASE)
_UR_NAMES = ("rx", "ry", "rz")  # names of a rotation vector on a Universal Robots arm
# Largest absolute value of angles without a unit that may be wrapped [rad]; beyond it they may be in degrees.
_MAX_WRAPPED = 2 * math.pi + 0.1
_MAX_ROTATION = 1.0  # largest rotation between two samples at which a change of about a full turn is a jump [rad]


def check_orientation(orientation: object) -> Orientation:
    """Check the name of an orientation's representation, and return it.

    Raises:
        InputError: If there is no such representation.
    """
    if not (isinstance(orientation, str) and orientation in POSE_NAMES):
        raise InputError(f"there is no orientation {brief(orientation)}: choose {' or '.join(POSE_NAMES)}")
    return cast(Orientation, orientation)


def pose_outputs(
    positions: np.ndarray,
    quaternions_wxyz: np.ndarray,
    target_position: np.ndarray,
    target_quaternion_wxyz: np.ndarray,
    orientation: Orientation = "euler_zyx",
    near: np.ndarray | None = None,
) -> np.ndarray:
    """Compute p_TE and R_TE of the end-effector E in the target frame T as outputs (N, 6) [m, rad].

    Args:
        positions: p_WE (N, 3) [m].
        quaternions_wxyz: R_WE (N, 4), of either sign and of any length except zero.
        target_position: p_WT (3,) [m].
        target_quaternion_wxyz: R_WT (4,).
        orientation: "euler_zyx", the thesis's [ψz ψy ψx], singular at ψy = ±90°; or "rotation_vector", which is
            regular there.
        near: Orientation (3,) [rad], zero by default. Outputs that differ by full turns represent the same orientation;
            the first outputs are those nearest to `near`. Demonstrations of one motion need the same `near`, because
            the mean of outputs that differ by full turns is meaningless.

    Raises:
        InputError: If a quaternion is zero, a number is not finite, or Euler angles are singular.
    """
    from scipy.spatial.transform import Rotation

    check_orientation(orientation)
    positions, quaternions = np.asarray(positions, dtype=float), np.asarray(quaternions_wxyz, dtype=float)
    p_WT, q_WT = np.asarray(target_position, dtype=float), np.asarray(target_quaternion_wxyz, dtype=float)
    if not all(np.isfinite(values).all() for values in (positions, quaternions, p_WT, q_WT)):
        raise InputError("poses contain NaN or infinity: cut those samples out")
    if np.linalg.norm(quaternions, axis=1).min() < 1e-6 or np.linalg.norm(q_WT) < 1e-6:
        raise InputError("a quaternion of length zero has no orientation")
    R_WT = Rotation.from_quat(q_WT, scalar_first=True)
    p_TE = R_WT.inv().apply(positions - p_WT)
    R_TE = R_WT.inv() * Rotation.from_quat(quaternions, scalar_first=True)
    if orientation == "euler_zyx":
        if np.abs(R_TE.as_matrix()[:, 2, 0]).max() > SINGULAR:
            raise InputError("ZYX Euler angles are singular in this motion: use orientation='rotation_vector'")
        return np.hstack([p_TE, continued_angles(R_TE.as_euler("ZYX"), near)])
    return np.hstack([p_TE, continued_vectors(R_TE.as_rotvec(), near)])


def pose_rotation(orientation_numbers: np.ndarray, orientation: Orientation = "euler_zyx") -> Rotation:
    """Return R_TE of the last three outputs of `pose_outputs`.

    Args:
        orientation_numbers: Orientation outputs, (3,) or (N, 3) [rad].
        orientation: As in `pose_outputs`.
    """
    from scipy.spatial.transform import Rotation

    if check_orientation(orientation) == "euler_zyx":
        return Rotation.from_euler("ZYX", orientation_numbers)
    return Rotation.from_rotvec(orientation_numbers)


def orientation_of_names(names: Sequence[str]) -> Orientation | None:
    """Return the representation of the orientation in six outputs with the given names.

    An orientation in degrees is refused, because all guidance computes with radians. Names of orientations are those
    of `POSE_NAMES`, and "Rz [rad]", "Ry [rad]", "Rx [rad]" for Euler angles, as
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
