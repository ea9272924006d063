"""Imported motions with the assumptions of the import, and conversions that several importers use."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.common.arrays import as_numbers, is_finite
from guiderail.models.common.errors import InputError, brief
from guiderail.models.primitives import Demonstrations
from guiderail.models.primitives.poses import SINGULAR

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
COMMANDED = ("command", "desired", "target", "equilibrium", "cmd", "action", "goal", "setpoint", "reference")
"""Words that distinguish the name of a commanded signal from that of a measured signal."""


Frames = tuple[str, str]
"""Names of the frame that poses are relative to and of the frame that they move, each "" if it is not stated."""
NO_FRAMES: Frames = ("", "")
# Words in the name of a signal or of its numbers that are changes, rates or forces and no positions.
_RATES = re.compile(
    r"(?:^|[^a-z])(d[xyz]|deltas?|increments?|relative|residual|errors?|vel|velocity|velocities|speeds?|twists?"
    r"|acc|accel|accelerations?|jerk|efforts?|torques?|forces?|wrench)(?:$|[^a-z])"
)


@dataclass
class Recorded:
    """Imported motions."""

    times: list[np.ndarray]  # times (N_m,) of each motion [s]
    outputs: list[np.ndarray]  # outputs (N_m, O) of each motion
    names: tuple[str, ...]  # names of the outputs
    # Assumptions about facts that the file does not state, one sentence each.
    assumptions: list[str] = field(default_factory=list)
    frames: Frames = NO_FRAMES  # frames of all motions


def rotations_of(quaternions: np.ndarray, where: str) -> Rotation:
    """Return the rotations of quaternions (N, 4), [x y z w]; `where` names their file for the message.

    Raises:
        InputError: If the length of a quaternion differs from 1 by more than 0.01, or is NaN.
    """
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(~(np.abs(lengths - 1.0) <= 0.01))  # the tolerance of tf2
    if len(wrong):
        raise InputError(
            f"{where} has a quaternion of length {lengths[wrong[0]]:.3g} at sample {wrong[0]}, instead of 1: "
            f"cut such samples out ({len(wrong)} of {len(lengths)})"
        )
    return Rotation.from_quat(quaternions)


def poses_in_target(
    positions: np.ndarray,
    rotations: Rotation,
    target: Sequence[float] | None,
    like: np.ndarray | None = None,
) -> np.ndarray:
    """Return poses (N, 6), [x y z Rz Ry Rx], in the target frame [m, rad].

    Args:
        positions: Positions (N, 3) in the recording's frame [m].
        rotations: Rotations (N,) in the recording's frame.
        target: Pose of the target in the recording's frame, (6,): [x y z] in meters, and the angles [rx ry rz] in
            degrees of rotations about the fixed axes x, y and z, in this order. None keeps the recording's frame.
        like: Poses of an earlier demonstration, (L, 6). Angles are shifted by full turns to bring their mean nearest to
            the mean of these poses. A full turn between two demonstrations would otherwise be learned as variance.

    Raises:
        InputError: If `target` is not six finite numbers, or Ry comes within 1° of ±90°, where Rz and Rx are not
            unique.
    """
    if target is not None:
        pose = as_numbers(target, "target")
        if pose.shape != (6,) or not is_finite(pose):
            raise InputError(f"target must be six finite numbers, [x y z rx ry rz], not {brief(target)}")
        target_rotation = Rotation.from_euler("xyz", pose[3:], degrees=True)
        positions = target_rotation.inv().apply(positions - pose[:3])
        rotations = target_rotation.inv() * rotations
    if np.abs(rotations.as_matrix()[:, 2, 0]).max(initial=0.0) > SINGULAR:
        raise InputError(
            "the angles [Rz Ry Rx] of this recording are singular, because Ry comes near ±90°: give a target frame "
            "(--target) that is turned by 90°"
        )
    # Angles [a b c] of Rz(a) Ry(b) Rx(c), continuous beyond ±π.
    angles = np.unwrap(rotations.as_euler("ZYX"), axis=0)
    if like is not None:
        angles -= 2.0 * np.pi * np.round((angles.mean(axis=0) - like[:, 3:].mean(axis=0)) / (2.0 * np.pi))
    return np.column_stack([positions, angles])


def describe_time_shift(demonstrations: Demonstrations) -> list[str]:
    """Return a remark that an export shifts times to start at zero; an empty list if all times start at zero."""
    starts = sorted(float(t[0]) for t in demonstrations.times)
    if not any(starts):
        return []
    where = f"{starts[0]:g}" if starts[0] == starts[-1] else f"{starts[0]:g} to {starts[-1]:g}"
    return [f"time is shifted to start at 0; the first samples were at {where} s"]


def describe_frames(frame: str, child: str) -> str:
    """Return the names of frames as part of a sentence."""
    base = f"the frame {brief(frame)}" if frame else "an unnamed frame"
    return f"{brief(child)} in {base}" if child else f"a tool in {base}"


def plain_frame(name: str) -> str:
    """Return the name of a frame without the leading slash of ROS 1."""
    return str(name).strip().lstrip("/")


def is_rate(name: str) -> bool:
    """Return True if the name of a signal states a change, a rate or a force, and no position."""
    return _RATES.search(re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name).lower().replace("_", " ")) is not None


def is_commanded(name: str) -> bool:
    """Return True if the name of a signal states that it was commanded."""
    return any(word in name.lower() for word in COMMANDED)


def choose_signal(candidates: Sequence[str], given: str | None, where: str, option: str) -> tuple[str, list[str]]:
    """Choose the signal to import; return its name, and the assumption of the choice.

    The choice is `given`. If `given` is None, it is the only candidate, or the only one of several candidates whose
    name states that it was commanded, because a primitive should learn commands. `where` and `option` are the names of
    the file and of the command-line option in error messages.

    Raises:
        InputError: If these rules do not determine one signal.
    """
    if not candidates:
        raise InputError(
            f"{where} holds no poses, transforms, joint positions or vectors of floats: nothing can be imported"
        )
    if given is not None:
        if given not in candidates:
            raise InputError(f"{where} has no {given}: {option} is one of {', '.join(candidates)}")
        return given, []
    commanded = [name for name in candidates if is_commanded(name)]
    chosen = commanded if len(commanded) == 1 else list(candidates)
    if len(chosen) == 1 and is_rate(chosen[0]):
        raise InputError(
            f"{where} has {chosen[0]}, whose name states changes, rates or forces instead of a motion: record "
            f"positions, or name it with {option} to import it as it is"
        )
    if len(chosen) > 1:
        raise InputError(
            f"{where} has {', '.join(chosen)}, and does not state which one to import: name one with {option}"
        )
    kind = (
        "the commanded motion, by its name"
        if is_commanded(chosen[0])
        else "the measured motion, as its name does not state that it is commanded"
    )
    return chosen[0], [f"{chosen[0]} is {kind}"]
