"""Registries of the kinds of input mapping, active constraint and transition distance.

A kind is a frozen dataclass whose fields are the entries of a template file. The name of an entry with a unit contains
the unit. A kind is registered under its name in template files:

    @register(ACTIVE_CONSTRAINTS, "half_space")
    @dataclass(frozen=True)
    class HalfSpace(ActiveConstraint): ...

Frames: W is the world, E the end effector (or the tip of the object in its gripper), F an object. The bearing is the
horizontal direction from E to the object. A tilt is a rotation about the horizontal axis perpendicular to the bearing.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import is_dataclass
from functools import lru_cache
from numbers import Real
from typing import Any, ClassVar, TypeVar

import numpy as np

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.transforms import (
    RigidTransform,
    RotationMatrix,
    axis_angle,
    axis_angle_rotation,
    rpy_rotation,
)

INPUT_MAPPINGS: dict[str, type] = {}
ACTIVE_CONSTRAINTS: dict[str, type] = {}
TRANSITION_DISTANCES: dict[str, type] = {}

Kind = TypeVar("Kind", bound=type)


def register(registry: dict[str, type], name: str) -> Callable[[Kind], Kind]:
    """Return a decorator that makes a dataclass available to template files as a `kind` of a registry.

    Raises:
        InputError: When the decorator is applied, if another kind has the name, the name is not a text or is empty, or
            the decorated object is not a dataclass or lacks a method.
    """

    def add(kind: Kind) -> Kind:
        require(isinstance(name, str) and name, f"a kind is registered by a name, not {brief(name)}")
        is_class = isinstance(kind, type) and is_dataclass(kind)
        require(is_class, f"the kind {name!r} must be a dataclass, not {brief(kind)}: add @dataclass(frozen=True)")
        missing = ", ".join(sorted(getattr(kind, "__abstractmethods__", ())))
        require(not missing, f"the kind {name!r} lacks {missing}: implement what its base class declares")
        existing = registry.get(name, kind)
        is_same = (existing.__module__, existing.__qualname__) == (kind.__module__, kind.__qualname__)
        require(is_same, f"there is a kind {name!r} already, {existing.__name__}: choose another name")
        registry[name] = kind
        return kind

    return add


def require(condition: Any, sentence: str) -> None:
    """Raise an `InputError` with `sentence` unless `condition` holds; for a kind's `__post_init__`."""
    if not condition:
        raise InputError(sentence)


def require_finite(value: float, name: str) -> None:
    """Raise an `InputError` unless a number is finite."""
    require(isinstance(value, Real) and math.isfinite(value), f"{name} must be finite, not {brief(value)}.")


def require_three(values: tuple[float, ...], name: str) -> None:
    """Raise an `InputError` unless a position, direction or set of angles has three numbers."""
    require(len(values) == 3, f"{name} must be three numbers, not {brief(values)}.")


Frames = Mapping[str, RigidTransform]
WORLD = "world"


class StatePart:
    """Mapping, constraint or distance of a template's state; the field `frame`, if there is one, names its frame."""

    own_frames: ClassVar[tuple[str, ...]] = (WORLD,)  # names of frames that do not belong to objects

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Names of the object frames that the part refers to."""
        frame = getattr(self, "frame", WORLD)
        return () if frame in self.own_frames else (frame,)


NEAR_AXIS = 1e-9  # distance from F's z axis below which the bearing is undefined [m]


@lru_cache(maxsize=64)
def matrix_deg(rpy_deg: tuple[float, ...]) -> np.ndarray:
    """Return the rotation of roll, pitch and yaw angles (about fixed axes x, y, z) [deg], a read-only matrix (3, 3)."""
    roll, pitch, yaw = np.deg2rad(rpy_deg).tolist()
    matrix = rpy_rotation(roll, pitch, yaw).matrix()
    matrix.setflags(write=False)
    return matrix


def axes(frame: str, frames: Frames) -> np.ndarray:
    """Return R_WF (3, 3), the orientation of the frame F called `frame`."""
    return np.eye(3) if frame == WORLD else frames[frame].rotation().matrix()


def position_in(frame: str, X_WE: RigidTransform, frames: Frames) -> np.ndarray:
    """Return p_FE (3,) [m], the end effector's origin in the frame F called `frame`."""
    if frame == WORLD:
        return X_WE.translation()
    X_WF = frames[frame]
    return X_WF.rotation().matrix().T @ (X_WE.translation() - X_WF.translation())


def pose_in(frame: str, X_WE: RigidTransform, frames: Frames) -> tuple[np.ndarray, np.ndarray]:
    """Return R_FE (3, 3) and p_FE (3,) [m], the end effector's pose in the frame F called `frame`."""
    R_WE, p_FE = X_WE.rotation().matrix(), position_in(frame, X_WE, frames)
    return R_WE if frame == WORLD else frames[frame].rotation().matrix().T @ R_WE, p_FE


def with_position_in(frame: str, p_FE: np.ndarray, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
    """Return X_WE with the origin of E moved to p_FE [m] in the frame F called `frame`, and the same orientation."""
    if frame == WORLD:
        return RigidTransform(X_WE.rotation(), p_FE)
    X_WF = frames[frame]
    return RigidTransform(X_WE.rotation(), X_WF.translation() + X_WF.rotation().matrix() @ p_FE)


def bearing(p_FE: np.ndarray) -> np.ndarray:
    """Return the horizontal unit vector (3,) in F from E to F's origin; +x if E is on F's z axis."""
    horizontal = math.hypot(p_FE[0], p_FE[1])
    if horizontal < NEAR_AXIS:
        return np.array([1.0, 0.0, 0.0])
    return np.array([-p_FE[0] / horizontal, -p_FE[1] / horizontal, 0.0])


def tilt_axis(p_FE: np.ndarray) -> np.ndarray:
    """Return z × bearing (3,) in F: a positive rotation about this axis tilts an upright tool towards F's origin."""
    towards = bearing(p_FE)
    return np.array([-towards[1], towards[0], 0.0])


def angle_between(R_WA: RotationMatrix, R_WB: RotationMatrix) -> float:
    """Return the angle [rad] of the rotation from A to B, accurate for small angles too."""
    return chord_angle(R_WA.matrix(), R_WB.matrix())


def chord_angle(R_WA: np.ndarray, R_WB: np.ndarray) -> float:
    """Return the angle [rad] between two rotation matrices (3, 3), accurate for small angles too."""
    # ‖A − B‖ = 2√2 sin(θ/2) in the Frobenius norm; the formula with the trace loses half of the digits near zero.
    difference = R_WA - R_WB
    chord = math.sqrt(float(np.vdot(difference, difference)))
    return 2.0 * math.asin(min(1.0, chord / math.sqrt(8.0)))


def pose_distance(X_WA: RigidTransform, X_WB: RigidTransform) -> float:
    """Return the larger of the distance [m] and the angle [rad] between two poses."""
    return max(math.dist(X_WA.translation(), X_WB.translation()), angle_between(X_WA.rotation(), X_WB.rotation()))


def largest(violations: Iterable[float]) -> float:
    """Return the largest violation, at least 0; NaN if a violation is NaN, which `max` would hide."""
    worst = 0.0
    for violation in violations:
        if math.isnan(violation):
            return violation
        worst = max(worst, violation)
    return worst


def between(X_WA: RigidTransform, X_WB: RigidTransform, fraction: float) -> RigidTransform:
    """Return the pose at a fraction of the motion from A to B along a straight line and about a constant axis."""
    if fraction == 1.0:
        return X_WB
    p_WA, p_WB = X_WA.translation(), X_WB.translation()
    p_WX = p_WA + fraction * (p_WB - p_WA)
    R_WA = X_WA.rotation().matrix()
    axis, angle = axis_angle(RotationMatrix(R_WA.T @ X_WB.rotation().matrix()))
    return RigidTransform(R_WA @ axis_angle_rotation(axis, fraction * angle).matrix(), p_WX)
