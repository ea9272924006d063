"""Active constraints to positions outside or inside of a convex shape."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from typing_extensions import override

from guiderail.models.common.transforms import RigidTransform
from guiderail.models.control import shapes
from guiderail.models.templates.constraints import HalfSpace, PositionConstraint
from guiderail.models.templates.geometry import WORLD, Frames, position_in
from guiderail.models.templates.kinds import ACTIVE_CONSTRAINTS, register, require, require_three


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
