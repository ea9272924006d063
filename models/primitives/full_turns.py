"""Full turns of angles and rotation vectors, by which outputs of the same orientation differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, cast

import numpy as np

Orientation = Literal["euler_zyx", "rotation_vector"]

# Orientation by the names of the last three of six outputs, in lower case and without units. `guiderail dataset import`
# names Euler angles Rz, Ry and Rx.
_ANGLE_NAMES = {
    ("psi_z", "psi_y", "psi_x"): "euler_zyx",
    ("rz", "ry", "rx"): "euler_zyx",
    ("r_x", "r_y", "r_z"): "rotation_vector",
}


_SURE = 1.0  # largest rotation [rad] between two samples at which a change of about a full turn is a jump


def orientation_of_names(names: Sequence[str]) -> Orientation | None:
    """Return the representation of the orientation that belongs to the names of six outputs.

    Accepted names are those of `poses.POSE_NAMES`, and "Rz [rad]", "Ry [rad]", "Rx [rad]" for Euler angles, as
    `guiderail dataset import` writes them. The result is None for other names or another number of names.
    """
    plain = _plain(names)
    return cast("Orientation | None", _ANGLE_NAMES.get(plain[3:])) if len(plain) == 6 else None


def without_jumps(outputs: Sequence[np.ndarray], names: Sequence[str]) -> tuple[np.ndarray, ...]:
    """Remove full turns by which angles and rotation vectors jump from sample to sample, or between the first samples.

    Outputs are angles if their unit is rad. The last three of six outputs are a rotation vector if their names say so
    (`orientation_of_names`, and "rx", "ry", "rz"). Outputs without a jump are returned unchanged.

    Args:
        outputs: M arrays (N_m, O); their first samples are compared with that of the first array.
        names: Names of the O outputs.
    """
    plain = _plain(names)
    is_pose = len(plain) == 6
    has_vector = is_pose and (orientation_of_names(names) == "rotation_vector" or plain[3:] == ("rx", "ry", "rz"))
    has_angles = orientation_of_names(names) == "euler_zyx"
    is_angle = ["[rad]" in name or (has_angles and o > 2) for o, name in enumerate(names)]
    result: list[np.ndarray] = []
    for y in outputs:
        first, changed = (result[0] if result else y)[0], y
        if has_vector:
            if _has_jump(y[:, 3:], first[3:]):
                changed = np.column_stack([y[:, :3], continued_vectors(y[:, 3:], first[3:])])
        elif any(is_angle):
            steps = np.diff(y, axis=0, prepend=first[None])
            turns = np.where(np.abs(np.abs(steps) - 2 * math.pi) <= _SURE, np.sign(steps), 0.0) * is_angle
            if turns.any():
                changed = y - 2 * math.pi * np.cumsum(turns, axis=0)
        result.append(changed)
    return tuple(result)


def continued_angles(angles: np.ndarray, near: np.ndarray | None) -> np.ndarray:
    """Remove full-turn jumps from angles (N, 3), on the branch of `near`."""
    angles = np.unwrap(angles, axis=0)
    start = np.zeros(3) if near is None else near
    return angles - 2 * np.pi * np.round((angles[0] - start) / (2 * np.pi))


def continued_vectors(vectors: np.ndarray, near: np.ndarray | None) -> np.ndarray:
    """Replace each rotation vector (N, 3) by the equivalent r + 2πk r/‖r‖ nearest to its predecessor."""
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
    before = np.concatenate([near[None], vectors[:-1]])
    is_far = np.abs(np.linalg.norm(vectors - before, axis=1) - 2 * math.pi) <= _SURE
    pairs = zip(vectors[is_far], before[is_far], strict=True)
    return any(np.linalg.norm(continued_vectors(one[None], last)[0] - last) <= _SURE for one, last in pairs)


def _plain(names: Sequence[str]) -> tuple[str, ...]:
    """Return names in lower case and without units."""
    return tuple(name.partition("[")[0].strip().lower() for name in names)
