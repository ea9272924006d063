"""Active constraints: projections of the end effector's pose into an allowed set (thesis, equation 2.21).

Each projection is idempotent up to rounding: an allowed pose is not changed. The constraints of a state are applied in
the order of the file. Therefore, constraints on the position must precede a constraint on the orientation that depends
on the position.

A new kind also needs its proof in `consistency.py`, and its export in packages/cpp (`templates.py`, `template.hpp`).
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from typing_extensions import override

from guiderail.models.common.transforms import RigidTransform
from guiderail.models.control import shapes
from guiderail.models.templates.parts import (
    ACTIVE_CONSTRAINTS,
    WORLD,
    Frames,
    StatePart,
    axes,
    bearing,
    chord_angle,
    largest,
    matrix_deg,
    pose_distance,
    pose_in,
    position_in,
    register,
    require,
    require_finite,
    require_three,
    with_position_in,
)

UNBOUNDED = 1e3  # radius beyond the reach of any robot [m]


class ActiveConstraint(StatePart, ABC):
    """One constraint of project_q (equation 2.21)."""

    @abstractmethod
    def project(self, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        """Return the projection of X_WE, equal to X_WE up to rounding if X_WE is allowed."""

    def violation(self, X_WE: RigidTransform, frames: Frames) -> float:
        """Return the distance between X_WE and its projection, the larger of position [m] and angle [rad]."""
        return pose_distance(self.project(X_WE, frames), X_WE)


class FrameConstraint(ActiveConstraint):
    """Constraint on the pose in one frame F, computed on arrays.

    The pose is converted to F once for consecutive constraints in the same frame, see `ConstraintGroup`.
    """

    frame: str

    @abstractmethod
    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the allowed rotation matrix (3, 3) and position (3,) [m]; an unchanged array is returned itself."""

    @override
    def project(self, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        return ConstraintGroup((self,)).project(X_WE, frames)

    @override
    def violation(self, X_WE: RigidTransform, frames: Frames) -> float:
        return ConstraintGroup((self,)).violation(X_WE, frames)


@dataclass(frozen=True)
class ConstraintGroup:
    """One or more constraints in the same frame, applied in order."""

    constraints: tuple[FrameConstraint, ...]

    def project(self, X_WE: RigidTransform, frames: Frames) -> RigidTransform:
        """Return the projection of X_WE, equal to X_WE up to rounding if X_WE is allowed."""
        frame = self.constraints[0].frame
        R_FE, p_FE = R, p = pose_in(frame, X_WE, frames)
        for constraint in self.constraints:
            R, p = constraint.project_in_frame(R, p)
        # An unchanged position or rotation is not converted back, because conversion would change the last digits.
        if p is not p_FE:
            X_WE = with_position_in(frame, p, X_WE, frames)
        if R is not R_FE:
            X_WE = RigidTransform(axes(frame, frames) @ R, X_WE.translation())
        return X_WE

    def violation(self, X_WE: RigidTransform, frames: Frames) -> float:
        """Return the largest violation of a single constraint, in position [m] or angle [rad]; 0 inside."""
        return largest(self._distances(*pose_in(self.constraints[0].frame, X_WE, frames)))

    def _distances(self, R_FE: np.ndarray, p_FE: np.ndarray) -> Iterator[float]:
        for constraint in self.constraints:
            R, p = constraint.project_in_frame(R_FE, p_FE)
            if p is not p_FE:
                yield math.dist(p, p_FE)
            if R is not R_FE:
                yield chord_angle(R, R_FE)


def group_constraints(constraints: Iterable[ActiveConstraint]) -> tuple[ActiveConstraint | ConstraintGroup, ...]:
    """Return the constraints in their order; consecutive constraints in the same frame form a group."""
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
    """Constraint on p_FE alone; the orientation is unchanged."""

    @abstractmethod
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        """Return the allowed position (3,) [m]: p_FE itself if it is allowed, otherwise a new array."""

    @override
    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return R_FE, self.project_position(p_FE)


@register(ACTIVE_CONSTRAINTS, "half_space")
@dataclass(frozen=True)
class HalfSpace(PositionConstraint):
    """Half-space n · p_FE ≥ offset_m for the unit vector n along `normal`."""

    normal: tuple[float, ...]  # vector in F, of any length except zero
    offset_m: float  # offset of the plane along the normal
    frame: str = WORLD  # F: frame of an object, or `world`

    def __post_init__(self) -> None:
        require_three(self.normal, "normal")
        require(np.linalg.norm(self.normal) > 1e-6, f"normal must not be zero: {self.normal}.")
        require_finite(self.offset_m, "offset_m")

    @cached_property
    def _unit(self) -> np.ndarray:
        return np.array(self.normal) / np.linalg.norm(self.normal)

    @override
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        shortfall = self.offset_m - self._unit @ p_FE
        return p_FE if shortfall <= 0 else p_FE + shortfall * self._unit


@register(ACTIVE_CONSTRAINTS, "box")
@dataclass(frozen=True)
class Box(PositionConstraint):
    """Box lower_m ≤ p_FE ≤ upper_m, axis by axis."""

    lower_m: tuple[float, ...]  # lower bounds of x, y and z in F
    upper_m: tuple[float, ...]  # upper bounds of x, y and z in F
    frame: str = WORLD  # F: frame of an object, or `world`

    def __post_init__(self) -> None:
        require_three(self.lower_m, "lower_m")
        require_three(self.upper_m, "upper_m")
        require(np.all(np.less_equal(self.lower_m, self.upper_m)), "lower_m must not exceed upper_m.")

    @override
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        # Plain Python, because NumPy is many times slower for three numbers and each command needs several projections.
        if all(low <= x <= high for low, x, high in zip(self.lower_m, p_FE.tolist(), self.upper_m, strict=True)):
            return p_FE
        return np.clip(p_FE, self.lower_m, self.upper_m)


@register(ACTIVE_CONSTRAINTS, "cylinder")
@dataclass(frozen=True)
class Cylinder(PositionConstraint):
    """Bounds on the distance from F's z axis; z is free.

    Positions nearer to the axis than `min_radius_m` and farther from it than `max_radius_m` are excluded.
    """

    frame: str  # F: frame of an object, or `world`
    min_radius_m: float = 0.0  # lower bound of the distance
    max_radius_m: float = UNBOUNDED  # upper bound of the distance

    def __post_init__(self) -> None:
        require(0 <= self.min_radius_m <= self.max_radius_m, "radii must satisfy 0 ≤ min_radius_m ≤ max_radius_m.")

    @override
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        radius = math.hypot(p_FE[0], p_FE[1])
        if self.min_radius_m <= radius <= self.max_radius_m:
            return p_FE
        nudge = _inward_nudge(self.min_radius_m, self.max_radius_m)
        bound = self.min_radius_m + nudge if radius < self.min_radius_m else self.max_radius_m - nudge
        direction = p_FE[:2] / radius if radius > 0 else np.array([-1.0, 0.0])
        return np.array([*(bound * direction), p_FE[2]])


@register(ACTIVE_CONSTRAINTS, "sector")
@dataclass(frozen=True)
class Sector(PositionConstraint):
    """Bounds on the azimuth of p_FE about F's z axis; radius and z are unchanged."""

    frame: str  # F: frame of an object, or `world`
    min_deg: float  # lower bound of the angle
    max_deg: float  # upper bound of the angle

    def __post_init__(self) -> None:
        require(self.min_deg <= self.max_deg <= self.min_deg + 360, "angles must span 0 to 360 degrees.")

    @override
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        lower, upper = math.radians(self.min_deg), math.radians(self.max_deg)
        azimuth = nearest_turn(math.atan2(p_FE[1], p_FE[0]), 0.5 * (lower + upper))
        if lower <= azimuth <= upper:
            return p_FE
        nudge = _inward_nudge(lower, upper)
        azimuth = lower + nudge if azimuth < lower else upper - nudge
        radius = math.hypot(p_FE[0], p_FE[1])
        return np.array([radius * math.cos(azimuth), radius * math.sin(azimuth), p_FE[2]])


def _inward_nudge(lower: float, upper: float) -> float:
    """Return the distance of a projection from the bounds of an interval, so that projecting is idempotent."""
    return min(1e-12, 0.25 * (upper - lower))


@register(ACTIVE_CONSTRAINTS, "keep_above")
@dataclass(frozen=True)
class KeepAbove(FrameConstraint):
    """Lower bound on the height of points of the end effector E; a projection lifts E along F's z axis."""

    height_m: float  # lower bound along F's z axis
    frame: str = WORLD  # F: frame of an object, or `world`
    points_m: tuple[tuple[float, ...], ...] = ((0.0, 0.0, 0.0),)  # points in E; the origin of E by default

    def __post_init__(self) -> None:
        require(len(self.points_m) > 0 and all(len(p) == 3 for p in self.points_m), "points_m are (x, y, z) each.")
        for value, name in ((self.height_m, "height_m"), *((value, "points_m") for p in self.points_m for value in p)):
            require_finite(value, name)

    @cached_property
    def _points(self) -> np.ndarray:
        return np.array(self.points_m).T

    @override
    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        shortfall = self.height_m - (float((R_FE[2] @ self._points).min()) + p_FE[2])
        return R_FE, p_FE if shortfall <= 0 else np.array([p_FE[0], p_FE[1], p_FE[2] + shortfall])


@register(ACTIVE_CONSTRAINTS, "funnel")
@dataclass(frozen=True)
class Funnel(PositionConstraint):
    """Upper bound on z that falls like a cone to F's z axis: z ≤ height_m + slope · max(0, radius − radius_m)."""

    frame: str  # F: frame of an object, or `world`
    radius_m: float  # radius within which the bound on z is constant
    height_m: float  # bound on z within radius_m
    slope: float  # rise of the bound per meter of radius

    def __post_init__(self) -> None:
        require(self.radius_m >= 0 and self.slope >= 0, "radius_m and slope must not be negative.")
        for name in ("radius_m", "height_m", "slope"):
            require_finite(getattr(self, name), name)

    @override
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        radius = math.hypot(p_FE[0], p_FE[1])
        ceiling = self.height_m + self.slope * max(0.0, radius - self.radius_m)
        return p_FE if p_FE[2] <= ceiling else np.array([p_FE[0], p_FE[1], ceiling])


@register(ACTIVE_CONSTRAINTS, "fixed_orientation")
@dataclass(frozen=True)
class FixedOrientation(FrameConstraint):
    """Constant orientation R_FE."""

    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # roll, pitch and yaw of R_FE
    frame: str = WORLD  # F: frame of an object, or `world`

    def __post_init__(self) -> None:
        require_three(self.rpy_deg, "rpy_deg")

    @override
    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return matrix_deg(self.rpy_deg), p_FE


class TiltConstraint(FrameConstraint):
    """Orientation `rpy_deg`, tilted towards F's z axis by an angle from an interval.

    The interval may depend on the distance to F's origin. The projection is the nearest rotation with an allowed tilt.
    With `turns_along`, the end effector turns about F's z axis as it moves around that axis, so that the tilt axis is
    constant in E; `rpy_deg` is the orientation at a bearing along F's x axis. Without `turns_along`, the heading is
    constant and the tilt axis changes.
    """

    rpy_deg: tuple[float, ...]
    turns_along: bool

    @abstractmethod
    def limits_deg(self, distance_m: float) -> tuple[float, float]:
        """Return the bounds of the tilt [deg] at a distance from F's origin."""

    def tilt(self, X_WE: RigidTransform, frames: Frames) -> float:
        """Return the tilt [rad] in [−π, π] of the nearest orientation that is only tilted towards F's z axis."""
        R_FE, p_FE = pose_in(self.frame, X_WE, frames)
        return self._tilt(self._heading(p_FE), R_FE)

    @staticmethod
    def _heading(p_FE: np.ndarray) -> np.ndarray:
        """Return R_FH of the heading frame H: x along the bearing, y along the tilt axis, z along F's z axis."""
        x, y, _ = bearing(p_FE).tolist()
        return np.array([[x, -y, 0.0], [y, x, 0.0], [0.0, 0.0, 1.0]])

    def _tilt(self, R_FH: np.ndarray, R_FE: np.ndarray) -> float:
        """Return the tilt [rad] for which R_FH Ry(tilt) R_HRest is nearest to R_FE in the Frobenius norm."""
        R = R_FH.T @ R_FE @ matrix_deg(self.rpy_deg).T
        if not self.turns_along:
            R = R @ R_FH
        return math.atan2(R[0, 2] - R[2, 0], R[0, 0] + R[2, 2])

    @override
    def project_in_frame(self, R_FE: np.ndarray, p_FE: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        R_FH = self._heading(p_FE)
        lower, upper = (math.radians(limit) for limit in self.limits_deg(math.sqrt(p_FE @ p_FE)))
        tilt = nearest_turn(self._tilt(R_FH, R_FE), 0.5 * (lower + upper))
        tilt = min(max(tilt, lower), upper)
        c, s = math.cos(tilt), math.sin(tilt)
        R = R_FH @ np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
        return (R if self.turns_along else R @ R_FH.T) @ matrix_deg(self.rpy_deg), p_FE


def nearest_turn(angle: float, center: float) -> float:
    """Return the equivalent angle within half a turn of `center` [rad]; NaN if an argument is not finite."""
    turns = (angle - center) / math.tau
    return angle - math.tau * round(turns) if math.isfinite(turns) else math.nan


@register(ACTIVE_CONSTRAINTS, "tilt_limits")
@dataclass(frozen=True)
class TiltLimits(TiltConstraint):
    """Constant bounds on the tilt towards F's axis."""

    frame: str  # F: frame of an object, or `world`
    min_deg: float  # lower bound of the tilt
    max_deg: float  # upper bound of the tilt
    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # R_FE at zero tilt
    turns_along: bool = False  # True if E turns about F's z axis as it moves around it

    def __post_init__(self) -> None:
        require_three(self.rpy_deg, "rpy_deg")
        require(-180 <= self.min_deg <= self.max_deg <= 180, "angles must satisfy −180 ≤ min_deg ≤ max_deg ≤ 180.")

    @override
    def limits_deg(self, distance_m: float) -> tuple[float, float]:
        return self.min_deg, self.max_deg


@register(ACTIVE_CONSTRAINTS, "tilt_by_distance")
@dataclass(frozen=True)
class TiltByDistance(TiltConstraint):
    """Tilt towards F's axis as a function of the distance to F's origin."""

    frame: str  # F: frame of an object, or `world`
    distance_m: tuple[float, ...]  # distances to F's origin, increasing
    tilt_deg: tuple[float, ...]  # one tilt for each distance; linear in between, constant beyond
    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # R_FE at zero tilt
    turns_along: bool = False  # True if E turns about F's z axis as it moves around it

    def __post_init__(self) -> None:
        require_three(self.rpy_deg, "rpy_deg")
        require(
            len(self.distance_m) == len(self.tilt_deg) >= 1 and np.all(np.diff(self.distance_m) > 0),
            "distance_m must increase, with one tilt_deg for each distance.",
        )
        require(min(self.tilt_deg) >= -180 and max(self.tilt_deg) <= 180, "tilt_deg must be between −180 and 180.")

    @override
    def limits_deg(self, distance_m: float) -> tuple[float, float]:
        tilt = float(np.interp(distance_m, self.distance_m, self.tilt_deg))
        return tilt, tilt


class _Tangent(HalfSpace):
    """Half-space at a shape's surface, with an offset that is not finite if the pose of an object is not finite."""

    @override
    def __post_init__(self) -> None:
        """Check nothing, because callers check that the command is finite."""


class Outside(PositionConstraint):
    """Base class of constraints to positions outside of a convex shape in F.

    `SharedControlTemplate.command` linearizes the constraint at the last command: it projects a request into a
    half-space outside of the shape. If the last command is outside, the straight line to the next command is therefore
    outside too. `project` and `violation` use the nearest point of the shape's surface.
    """

    @property
    @abstractmethod
    def shape(self) -> shapes.ConvexShape:
        """Shape in F."""

    @override
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        distance, normal = self.shape.surface(p_FE)
        return p_FE if distance >= 0.0 else p_FE + (shapes.CLEARANCE - distance) * normal

    def at(self, X_WLast: RigidTransform, frames: Frames) -> HalfSpace:
        """Return the half-space of allowed positions for the command after X_WLast."""
        normal, offset = self.shape.half_space(position_in(self.frame, X_WLast, frames))
        return _Tangent(tuple(normal), offset + shapes.CLEARANCE, self.frame)


@register(ACTIVE_CONSTRAINTS, "outside_sphere")
@dataclass(frozen=True)
class OutsideSphere(Outside):
    """Outside of a sphere."""

    radius_m: float  # radius of the sphere, including a safety distance
    center_m: tuple[float, ...] = (0.0, 0.0, 0.0)  # center in F
    frame: str = WORLD  # F: frame of an object, or `world`

    def __post_init__(self) -> None:
        require_three(self.center_m, "center_m")
        require(self.radius_m > 0, f"radius_m must be positive, not {self.radius_m}.")

    @cached_property
    def shape(self) -> shapes.ConvexShape:
        """Sphere."""
        return shapes.Sphere(self.center_m, self.radius_m)


@register(ACTIVE_CONSTRAINTS, "outside_cylinder")
@dataclass(frozen=True)
class OutsideCylinder(Outside):
    """Outside of a solid cylinder along F's z axis."""

    frame: str  # F: frame of an object, or `world`
    radius_m: float  # radius of the cylinder
    min_m: float  # z of the lower face in F
    max_m: float  # z of the upper face in F
    margin_m: float = 0.0  # minimum distance from the cylinder

    def __post_init__(self) -> None:
        require(self.radius_m > 0, f"radius_m must be positive, not {self.radius_m}.")
        require(
            self.min_m < self.max_m and self.margin_m >= 0,
            "min_m must be less than max_m, and margin_m must not be negative.",
        )

    @cached_property
    def shape(self) -> shapes.ConvexShape:
        """Cylinder."""
        ends = (0.0, 0.0, self.min_m), (0.0, 0.0, self.max_m)
        return shapes.Cylinder(*ends, self.radius_m, self.margin_m)


@register(ACTIVE_CONSTRAINTS, "outside_box")
@dataclass(frozen=True)
class OutsideBox(Outside):
    """Outside of a box lower_m ≤ p_FE ≤ upper_m."""

    lower_m: tuple[float, ...]  # lower corner in F
    upper_m: tuple[float, ...]  # upper corner in F
    frame: str = WORLD  # F: frame of an object, or `world`
    margin_m: float = 0.0  # minimum distance from the box

    def __post_init__(self) -> None:
        require_three(self.lower_m, "lower_m")
        require_three(self.upper_m, "upper_m")
        require(np.all(np.less(self.lower_m, self.upper_m)), "lower_m must be less than upper_m.")
        require(self.margin_m >= 0, "margin_m must not be negative.")

    @cached_property
    def shape(self) -> shapes.ConvexShape:
        """Box."""
        return shapes.Box(self.lower_m, self.upper_m, self.margin_m)


@register(ACTIVE_CONSTRAINTS, "inside_sphere")
@dataclass(frozen=True)
class InsideSphere(PositionConstraint):
    """Inside of a sphere."""

    radius_m: float  # radius of the sphere
    center_m: tuple[float, ...] = (0.0, 0.0, 0.0)  # center in F
    frame: str = WORLD  # F: frame of an object, or `world`

    def __post_init__(self) -> None:
        require_three(self.center_m, "center_m")
        require(self.radius_m > 0, f"radius_m must be positive, not {self.radius_m}.")

    @override
    def project_position(self, p_FE: np.ndarray) -> np.ndarray:
        offset = p_FE - np.array(self.center_m)
        distance = math.sqrt(offset @ offset)
        if distance <= self.radius_m:
            return p_FE
        return np.array(self.center_m) + (self.radius_m - min(1e-12, 0.25 * self.radius_m)) / distance * offset
