"""Active constraints: projections of the end effector's pose onto what is allowed (thesis, equation 2.21).

Each is idempotent: what is allowed stays where it is. A state's constraints are applied in the order of the file, so
those on orientation that depend on the position come after those on the position.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from guiderail.models.templates.geometry import (
    WORLD,
    Frames,
    angle_between,
    bearing,
    chord_angle,
    interpolate,
    largest,
    matrix_deg,
    pose_in,
    with_position_in,
)
from guiderail.models.templates.kinds import ACTIVE_CONSTRAINTS, register, require, require_three

UNBOUNDED = 1e3  # [m] farther than any robot of ours reaches


class ActiveConstraint(ABC):
    """project_q of equation 2.21 for one constraint."""

    @abstractmethod
    def project(self, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        """The allowed pose for X_WE; X_WE itself where that is allowed."""

    def violation(self, X_WE: RigidTransform, frames: Frames) -> float:
        """How far X_WE is from its projection: the larger of metres and radians; zero where it is allowed."""
        X_WP = self.project(X_WE, frames)
        return max(math.dist(X_WP.translation(), X_WE.translation()), angle_between(X_WP.rotation(), X_WE.rotation()))

    @property
    def frame_names(self) -> tuple[str, ...]:
        """The objects' frames it needs."""
        frame = getattr(self, "frame", WORLD)
        return () if frame == WORLD else (frame,)


class FrameConstraint(ActiveConstraint):
    """A constraint on the pose in one frame F, as arrays: a template converts a pose once for all that share F."""

    frame: str

    @abstractmethod
    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The allowed rotation matrix (3, 3) and position (3,) [m]; what is allowed is returned as the same object."""

    def project(self, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        return ConstraintGroup((self,)).project(X_WE, frames)

    def violation(self, X_WE: RigidTransform, frames: Frames) -> float:
        return ConstraintGroup((self,)).violation(X_WE, frames)


@dataclass(frozen=True)
class ConstraintGroup:
    """Constraints in one and the same frame, at least one, applied in their order."""

    constraints: tuple[FrameConstraint, ...]

    def project(self, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        """The allowed pose for X_WE; X_WE itself where that is allowed."""
        frame = self.constraints[0].frame
        R_FE, p_FE = R, p = pose_in(frame, X_WE, frames)
        for constraint in self.constraints:
            R, p = constraint.project_in_frame(R, p)
        # What is allowed is returned untouched: the way through the frame and back would cost the last digits.
        if p is not p_FE:
            X_WE = with_position_in(frame, p, X_WE, frames)
        if R is not R_FE:
            X_WE = RigidTransform(axes(frame, frames).multiply(RotationMatrix(R)), X_WE.translation())
        return X_WE

    def violation(self, X_WE: RigidTransform, frames: Frames) -> float:
        """How far X_WE is from the worst of them, each by itself: the larger of metres and radians; 0 inside."""
        return largest(self._distances(*pose_in(self.constraints[0].frame, X_WE, frames)))

    def _distances(self, R_FE: np.ndarray, p_FE: np.ndarray) -> Iterator[float]:
        for constraint in self.constraints:
            R, p = constraint.project_in_frame(R_FE, p_FE)
            if p is not p_FE:
                yield math.dist(p, p_FE)
            if R is not R_FE:
                yield chord_angle(R, R_FE)


def grouped(constraints: Iterable[ActiveConstraint]) -> tuple[ActiveConstraint | ConstraintGroup, ...]:
    """The same constraints in the same order, those put together that follow one another in one frame."""
    groups: list[ActiveConstraint | ConstraintGroup] = []
    for constraint in constraints:
        last = groups[-1] if groups else None
        if not isinstance(constraint, FrameConstraint):
            groups.append(constraint)
        elif isinstance(last, ConstraintGroup) and last.constraints[0].frame == constraint.frame:
            groups[-1] = ConstraintGroup((*last.constraints, constraint))
        else:
            groups.append(ConstraintGroup((constraint,)))
    return tuple(groups)


class PositionConstraint(FrameConstraint):
    """A constraint on p_FE alone; the orientation is kept."""

    @abstractmethod
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        """The allowed position for p_FE [m]; a new array or the very same one where it is allowed."""

    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return R_FE, self.project_position(p_FE)


@register(ACTIVE_CONSTRAINTS, "half_space")
@dataclass(frozen=True)
class HalfSpace(PositionConstraint):
    """normal · p_FE ≥ offset_m."""

    normal: tuple[float, ...]  # in F
    offset_m: float  # along the normal
    frame: str = WORLD  # F: an object's, or `world`

    def __post_init__(self) -> None:
        require_three(self.normal, "normal")
        require(np.linalg.norm(self.normal) > 1e-6, f"normal must not be zero: {self.normal}.")

    @cached_property
    def _unit(self) -> np.ndarray:
        return np.array(self.normal) / np.linalg.norm(self.normal)

    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        short = self.offset_m - self._unit @ p_FE
        return p_FE if short <= 0 else p_FE + short * self._unit


@register(ACTIVE_CONSTRAINTS, "box")
@dataclass(frozen=True)
class Box(PositionConstraint):
    """lower_m ≤ p_FE ≤ upper_m, axis by axis."""

    lower_m: tuple[float, ...]  # least x, y and z in F
    upper_m: tuple[float, ...]  # greatest x, y and z in F
    frame: str = WORLD  # F: an object's, or `world`

    def __post_init__(self) -> None:
        require_three(self.lower_m, "lower_m")
        require_three(self.upper_m, "upper_m")
        require(np.all(np.less_equal(self.lower_m, self.upper_m)), "lower_m must not exceed upper_m.")

    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        inside = p_FE.tolist()
        # Three numbers at a time NumPy is many times slower, and every command asks each constraint several times.
        if all(low <= x <= high for low, x, high in zip(self.lower_m, inside, self.upper_m, strict=True)):
            return p_FE
        return np.clip(p_FE, self.lower_m, self.upper_m)


@register(ACTIVE_CONSTRAINTS, "cylinder")
@dataclass(frozen=True)
class Cylinder(PositionConstraint):
    """The distance from F's z axis is between min_radius_m and max_radius_m; z is free.

    With a min_radius_m the axis is kept out, with a max_radius_m the end effector is kept in.
    """

    frame: str  # F: an object's, or `world`
    min_radius_m: float = 0.0  # least distance
    max_radius_m: float = UNBOUNDED  # greatest distance

    def __post_init__(self) -> None:
        require(0 <= self.min_radius_m <= self.max_radius_m, "radii must satisfy 0 ≤ min_radius_m ≤ max_radius_m.")

    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        radius = math.hypot(p_FE[0], p_FE[1])
        if self.min_radius_m <= radius <= self.max_radius_m:
            return p_FE
        wanted = self.min_radius_m if radius < self.min_radius_m else self.max_radius_m
        direction = p_FE[:2] / radius if radius > 0 else np.array([-1.0, 0.0])
        return np.array([*settled(wanted, direction, self.min_radius_m, self.max_radius_m), p_FE[2]])


@register(ACTIVE_CONSTRAINTS, "sector")
@dataclass(frozen=True)
class Sector(PositionConstraint):
    """The azimuth of p_FE about F's z axis is between min_deg and max_deg; radius and z are kept."""

    frame: str  # F: an object's, or `world`
    min_deg: float  # least angle
    max_deg: float  # greatest angle

    def __post_init__(self) -> None:
        require(self.min_deg <= self.max_deg <= self.min_deg + 360, "angles must span 0 to 360 degrees.")

    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        least, most = math.radians(self.min_deg), math.radians(self.max_deg)
        azimuth = nearest_turn(math.atan2(p_FE[1], p_FE[0]), 0.5 * (least + most))
        if least <= azimuth <= most:
            return p_FE
        # A rounding error inside, so that projecting is idempotent.
        nudge = min(1e-12, 0.25 * (most - least))
        azimuth = least + nudge if azimuth < least else most - nudge
        radius = math.hypot(p_FE[0], p_FE[1])
        return np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), p_FE[2]])


def settled(wanted: float, direction: np.ndarray, least: float, most: float) -> np.ndarray:
    """wanted · direction, a rounding error inside [least, most], so that projecting is idempotent."""
    nudge = min(1e-12, 0.25 * (most - least))
    return (wanted + (nudge if wanted == least else -nudge)) * direction


@register(ACTIVE_CONSTRAINTS, "keep_above")
@dataclass(frozen=True)
class KeepAbove(FrameConstraint):
    """Points that are fixed to the end effector stay at or above height_m in F; it is lifted along F's z.

    Without points_m, the end effector's own origin is the point.
    """

    height_m: float  # along F's z axis
    frame: str = WORLD  # F: an object's, or `world`
    points_m: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 0.0),)  # p_EP

    def __post_init__(self) -> None:
        require(len(self.points_m) > 0 and all(len(p) == 3 for p in self.points_m), "points_m are (x, y, z) each.")

    @cached_property
    def _points(self) -> np.ndarray:
        return np.array(self.points_m).T

    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        short = self.height_m - (float((R_FE[2] @ self._points).min()) + p_FE[2])
        return R_FE, p_FE if short <= 0 else np.array([p_FE[0], p_FE[1], p_FE[2] + short])


@register(ACTIVE_CONSTRAINTS, "funnel")
@dataclass(frozen=True)
class Funnel(PositionConstraint):
    """p_FE stays under a cone: z ≤ height_m + slope · (radius − radius_m), so that going in leads down."""

    frame: str  # F: an object's, or `world`
    radius_m: float  # of its mouth
    height_m: float  # at radius_m and inside of it
    slope: float  # rise over run

    def __post_init__(self) -> None:
        require(self.radius_m >= 0 and self.slope >= 0, "radius_m and slope must not be negative.")

    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        radius = math.hypot(p_FE[0], p_FE[1])
        ceiling = self.height_m + self.slope * max(0.0, radius - self.radius_m)
        return p_FE if p_FE[2] <= ceiling else np.array([p_FE[0], p_FE[1], ceiling])


@register(ACTIVE_CONSTRAINTS, "fixed_orientation")
@dataclass(frozen=True)
class FixedOrientation(FrameConstraint):
    """R_FE is one given rotation."""

    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # R_FE
    frame: str = WORLD  # F: an object's, or `world`

    def __post_init__(self) -> None:
        require_three(self.rpy_deg, "rpy_deg")

    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return matrix_deg(self.rpy_deg), p_FE


class TiltConstraint(FrameConstraint):
    """The orientation is `rpy_deg` at rest, tilted towards F's z axis by an angle from an interval.

    The interval may depend on the distance to F's origin. The nearest such rotation is taken. With `turns_along`, the
    end effector turns about F's z axis as it moves around it, so that it always tilts about the same axis of its own;
    `rpy_deg` is then for a bearing along F's x axis. Without, it keeps its heading and tilts about another one.
    """

    rpy_deg: tuple[float, ...]
    turns_along: bool

    @abstractmethod
    def limits_deg(self, distance_m: float) -> tuple[float, float]:
        """The least and the greatest tilt [deg] at this distance."""

    def tilt(self, X_WE: RigidTransform, frames: Frames) -> float:
        """The tilt [rad] of the nearest rotation that is tilted towards F's axis and nothing else."""
        R_FE, p_FE = pose_in(self.frame, X_WE, frames)
        return self._tilt(self._heading(p_FE), R_FE)

    @staticmethod
    def _heading(p_FE: np.ndarray) -> np.ndarray:
        """R_FH: H has its z axis along F's, and its x axis along the bearing; y is the axis of a tilt."""
        x, y, _ = bearing(p_FE).tolist()
        return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])

    def _tilt(self, R_FH: np.ndarray, R_FE: np.ndarray) -> float:
        """Of R_FE = R_FH Ry(tilt) R_HRest, the angle for which that comes nearest (in the Frobenius norm)."""
        R = R_FH.T @ R_FE @ matrix_deg(self.rpy_deg).T
        if not self.turns_along:
            R = R @ R_FH
        return math.atan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2])

    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R_FH = self._heading(p_FE)
        least, most = (math.radians(limit) for limit in self.limits_deg(math.sqrt(p_FE @ p_FE)))
        tilt = nearest_turn(self._tilt(R_FH, R_FE), 0.5 * (least + most))
        tilt = min(max(tilt, least), most)
        c, s = math.cos(tilt), math.sin(tilt)
        R = R_FH @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return (R if self.turns_along else R @ R_FH.T) @ matrix_deg(self.rpy_deg), p_FE


def axes(frame: str, frames: Frames) -> RotationMatrix:
    """R_WF."""
    return RotationMatrix() if frame == WORLD else frames[frame].rotation()


def nearest_turn(angle: float, centre: float) -> float:
    """The same angle, a whole number of turns away, within half a turn of `centre`; not a number where it is none."""
    turns = (angle - centre) / math.tau
    return angle - math.tau * round(turns) if math.isfinite(turns) else math.nan


@register(ACTIVE_CONSTRAINTS, "tilt_limits")
@dataclass(frozen=True)
class TiltLimits(TiltConstraint):
    """Tilted towards F's axis by min_deg to max_deg, wherever it is."""

    frame: str  # F: an object's, or `world`
    min_deg: float  # least tilt
    max_deg: float  # greatest tilt
    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # R_FE at zero tilt
    turns_along: bool = False  # whether it turns about F's z axis as it moves around it

    def __post_init__(self) -> None:
        require_three(self.rpy_deg, "rpy_deg")
        require(-180 <= self.min_deg <= self.max_deg <= 180, "angles must satisfy −180 ≤ min_deg ≤ max_deg ≤ 180.")

    def limits_deg(self, distance_m: float) -> tuple[float, float]:
        return self.min_deg, self.max_deg


@register(ACTIVE_CONSTRAINTS, "tilt_by_distance")
@dataclass(frozen=True)
class TiltByDistance(TiltConstraint):
    """Tilted towards F's axis by an angle that is a function of the distance to F's origin."""

    frame: str  # F: an object's, or `world`
    distance_m: tuple[float, ...]  # increasing
    tilt_deg: tuple[float, ...]  # one for each distance, linear in between, constant beyond
    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # R_FE at zero tilt
    turns_along: bool = False  # whether it turns about F's z axis as it moves around it

    def __post_init__(self) -> None:
        require_three(self.rpy_deg, "rpy_deg")
        require(
            len(self.distance_m) == len(self.tilt_deg) >= 1 and np.all(np.diff(self.distance_m) > 0),
            "distance_m must increase, with one tilt_deg for each distance.",
        )
        require(min(self.tilt_deg) >= -180 and max(self.tilt_deg) <= 180, "tilt_deg must be between −180 and 180.")

    def limits_deg(self, distance_m: float) -> tuple[float, float]:
        tilt = interpolate(distance_m, self.distance_m, self.tilt_deg)
        return tilt, tilt


@register(ACTIVE_CONSTRAINTS, "arc")
@dataclass(frozen=True)
class Arc(FrameConstraint):
    """On a circle about F's z axis, the orientation turning along with it: a door handle.

    At angle 0 the end effector is on F's x axis with R_FE = rpy_deg.
    """

    frame: str  # F: an object's, or `world`
    radius_m: float  # of the circle
    height_m: float = 0.0  # of the circle, along F's z axis
    min_deg: float = -180.0  # least angle
    max_deg: float = 180.0  # greatest angle
    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # R_FE at angle 0

    def __post_init__(self) -> None:
        require(self.radius_m > 0, f"radius_m must be positive, not {self.radius_m}.")
        require_three(self.rpy_deg, "rpy_deg")
        require(-180 <= self.min_deg <= self.max_deg <= 180, "angles must satisfy −180 ≤ min_deg ≤ max_deg ≤ 180.")

    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        least, most = math.radians(self.min_deg), math.radians(self.max_deg)
        angle = nearest_turn(math.atan2(p_FE[1], p_FE[0]), 0.5 * (least + most))
        angle = min(max(angle, least), most)
        c, s = math.cos(angle), math.sin(angle)
        # Not by Drake's rotations, which refuse an angle that is no number.
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        return turned.dot(matrix_deg(self.rpy_deg)), np.array([self.radius_m * c, self.radius_m * s, self.height_m])
