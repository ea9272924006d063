"""Poses as outputs of a primitive: six continuous numbers in a target frame (thesis, section 4.4.2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, cast

import numpy as np

from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives.demonstrations import Demonstrations
from guiderail.models.primitives.full_turns import Orientation, continued_angles, continued_vectors

# Importing scipy.spatial takes a fifth of a second, and a primitive does not need it.
if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

SINGULAR = math.sin(math.radians(89.0))  # largest |sin Ry| of Euler angles [Rz Ry Rx]

POSE_NAMES: dict[str, tuple[str, ...]] = {
    "euler_zyx": ("x [m]", "y [m]", "z [m]", "psi_z [rad]", "psi_y [rad]", "psi_x [rad]"),
    "rotation_vector": ("x [m]", "y [m]", "z [m]", "r_x [rad]", "r_y [rad]", "r_z [rad]"),
}
"""Names of the six outputs, by the representation of the orientation."""


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


def pose_demonstrations(
    times: Sequence[np.ndarray],
    positions: Sequence[np.ndarray],
    quaternions_wxyz: Sequence[np.ndarray],
    target_position: np.ndarray | None = None,
    target_quaternion_wxyz: np.ndarray | None = None,
    orientation: Orientation = "euler_zyx",
) -> Demonstrations:
    """Build demonstrations of six outputs from recorded end-effector poses.

    Args:
        times: M arrays (N_m,) [s].
        positions: p_WE, M arrays (N_m, 3) [m], in any common frame W.
        quaternions_wxyz: R_WE, M arrays (N_m, 4).
        target_position: p_WT (3,) [m]; each demonstration's last position by default (thesis, section 4.4.2).
        target_quaternion_wxyz: R_WT (4,); each demonstration's last orientation by default.
        orientation: As in `pose_outputs`.
    """
    outputs: list[np.ndarray] = []
    for p, q in zip(positions, quaternions_wxyz, strict=True):
        target_p = p[-1] if target_position is None else target_position
        target_q = q[-1] if target_quaternion_wxyz is None else target_quaternion_wxyz
        near = outputs[0][0, 3:] if outputs else None
        outputs.append(pose_outputs(p, q, target_p, target_q, orientation, near))
    return Demonstrations(times, outputs, POSE_NAMES[orientation])
