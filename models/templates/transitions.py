"""Transition distances: the distance to the end of a state (thesis, section 2.3)."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from typing_extensions import override

from guiderail.models.common.transforms import RigidTransform
from guiderail.models.templates.active_constraints import TiltLimits
from guiderail.models.templates.parts import (
    TRANSITION_DISTANCES,
    Frames,
    StatePart,
    position_in,
    register,
    require,
    require_three,
)


class TransitionDistance(StatePart, ABC):
    """Transition distance d_t, which decreases as the task progresses."""

    unit: str = "m"  # unit of thresholds in a file, "m" or "deg"; values are in meters or radians
    can_be_negative: ClassVar[bool] = True  # False if the value is at least 0 everywhere

    @abstractmethod
    def value(self, X_WE: RigidTransform, frames: Frames) -> float:
        """Return the distance at X_WE, [m] or [rad]."""


@register(TRANSITION_DISTANCES, "distance")
@dataclass(frozen=True)
class Distance(TransitionDistance):
    """Distance ‖p_FE − point_m‖ of the end effector's origin from a point of F."""

    frame: str  # F: frame of an object, or `world`
    point_m: tuple[float, ...] = (0.0, 0.0, 0.0)  # point in F
    can_be_negative = False

    def __post_init__(self) -> None:
        require_three(self.point_m, "point_m")

    @override
    def value(self, X_WE: RigidTransform, frames: Frames) -> float:
        p_PE = position_in(self.frame, X_WE, frames) - self.point_m
        return math.sqrt(p_PE @ p_PE)


@register(TRANSITION_DISTANCES, "height")
@dataclass(frozen=True)
class Height(TransitionDistance):
    """Height of the end effector's origin above F, the z component of p_FE."""

    frame: str  # F: frame of an object, or `world`

    @override
    def value(self, X_WE: RigidTransform, frames: Frames) -> float:
        return float(position_in(self.frame, X_WE, frames)[2])


@register(TRANSITION_DISTANCES, "axis_distance")
@dataclass(frozen=True)
class AxisDistance(TransitionDistance):
    """Distance of the end effector's origin from F's z axis."""

    frame: str  # F: frame of an object, or `world`
    can_be_negative = False

    @override
    def value(self, X_WE: RigidTransform, frames: Frames) -> float:
        return float(np.hypot(*position_in(self.frame, X_WE, frames)[:2]))


@register(TRANSITION_DISTANCES, "tilt_to_go")
@dataclass(frozen=True)
class TiltToGo(TransitionDistance):
    """Remaining tilt towards F's z axis: until_deg minus the current tilt.

    The tilt is in (−180°, 180°], so the distance jumps by 360° when the tilt passes 180°.
    """

    frame: str  # F: frame of an object, or `world`
    until_deg: float  # tilt at which the distance is zero
    rpy_deg: tuple[float, ...] = (0.0, 0.0, 0.0)  # R_FE at zero tilt
    turns_along: bool = False  # as in `tilt_limits`
    unit = "deg"

    def __post_init__(self) -> None:
        require_three(self.rpy_deg, "rpy_deg")
        require(-180 <= self.until_deg <= 180, f"until_deg must be between −180 and 180, not {self.until_deg}.")

    @cached_property
    def _any_tilt(self) -> TiltLimits:
        return TiltLimits(self.frame, -180.0, 180.0, self.rpy_deg, self.turns_along)

    @override
    def value(self, X_WE: RigidTransform, frames: Frames) -> float:
        return math.radians(self.until_deg) - self._any_tilt.tilt(X_WE, frames)
