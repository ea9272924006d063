"""What an importer found, and what it took for granted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations

POSE_NAMES = ("x [m]", "y [m]", "z [m]", "Rz [rad]", "Ry [rad]", "Rx [rad]")
UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
COMMANDED = ("command", "desired", "target", "equilibrium", "cmd", "action", "goal", "setpoint", "reference")
"""Words in a signal's name that mean what was asked for, and not what was measured."""


@dataclass
class Recorded:
    """Motions from somebody's file.

    Attributes:
        times: (N_m,) of each [s].
        outputs: (N_m, O) of each.
        names: of the outputs.
        assumed: what the file does not say, a sentence each.
    """

    times: list[np.ndarray]
    outputs: list[np.ndarray]
    names: tuple[str, ...]
    assumed: list[str] = field(default_factory=list)


def rotations_of(quaternions: np.ndarray, where: str) -> Rotation:
    """Rotations of quaternions (N, 4), [x y z w]; `where` names their file in messages.

    Raises:
        InputError: if one is no rotation: its length is not one, or it holds what is no number.
    """
    lengths = np.linalg.norm(quaternions, axis=1)
    wrong = np.flatnonzero(~(np.abs(lengths - 1.0) <= 0.01))  # as tf2 allows
    if len(wrong):
        raise InputError(
            f"{where} has a quaternion of length {lengths[wrong[0]]:.3g} at sample {wrong[0]}, and a rotation's is 1: "
            f"cut such samples out ({len(wrong)} of {len(lengths)})"
        )
    return Rotation.from_quat(quaternions)


def poses_in_target(
    positions: np.ndarray,
    rotations: Rotation,
    target: Sequence[float] | None,
    like: np.ndarray | None = None,
) -> np.ndarray:
    """Poses (N, 6), [x y z Rz Ry Rx], of positions (N, 3) [m] and rotations, in the target frame.

    Args:
        positions, rotations: in the recording's frame.
        target: [x y z] in metres and [rx ry rz] in degrees of the target in that frame; None keeps the recording's.
        like: poses of an earlier demonstration, (N', 6), to whose angles these are the nearest of all that mean the
            same: a whole turn between two demonstrations would be learned as their spread.
    """
    if target is not None:
        turn = Rotation.from_euler("xyz", np.asarray(target[3:], dtype=float), degrees=True)
        positions = turn.inv().apply(positions - np.asarray(target[:3], dtype=float))
        rotations = turn.inv() * rotations
    # Rz(a) Ry(b) Rx(c); a turn past half a circle goes on.
    angles = np.unwrap(rotations.as_euler("ZYX"), axis=0)
    if like is not None:
        angles -= 2.0 * np.pi * np.round((angles.mean(axis=0) - like[:, 3:].mean(axis=0)) / (2.0 * np.pi))
    return np.column_stack([positions, angles])


def from_zero(demonstrations: Demonstrations) -> list[str]:
    """A sentence where time that is counted from each demonstration's first sample is another than theirs."""
    starts = sorted(float(t[0]) for t in demonstrations.times)
    if not any(starts):
        return []
    where = f"{starts[0]:g}" if starts[0] == starts[-1] else f"{starts[0]:g} to {starts[-1]:g}"
    return [f"time is counted from each demonstration's first sample, where it was {where}"]


def is_commanded(name: str) -> bool:
    """Whether a signal's name says that it was asked for."""
    return any(word in name.lower() for word in COMMANDED)


def choose_signal(candidates: Sequence[str], given: str | None, where: str, option: str) -> tuple[str, list[str]]:
    """The signal that is imported and what was assumed of it.

    One that was named; else the only one; else the only one that was commanded, which a primitive should learn.

    Raises:
        InputError: if none of that says which.
    """
    if not candidates:
        raise InputError(f"{where} holds no poses, transforms or joint positions: nothing of it can be imported")
    if given is not None:
        if given not in candidates:
            raise InputError(f"{where} has no {given}: {option} is one of {', '.join(candidates)}")
        return given, []
    commanded = [name for name in candidates if is_commanded(name)]
    chosen = commanded if len(commanded) == 1 else list(candidates)
    if len(chosen) > 1:
        raise InputError(f"{where} has {', '.join(chosen)}, and does not say which is meant: name one with {option}")
    kind = "commanded, by its name" if is_commanded(chosen[0]) else "measured, as nothing in it says commanded"
    return chosen[0], [f"{chosen[0]} is what was {kind}"]
