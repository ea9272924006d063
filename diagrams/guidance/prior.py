"""Prior knowledge about a task, which guidance is built from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.guidance.primitive_config import PrimitiveConfig
from guiderail.models.common.transforms import POSE_SIZE, WRENCH_SIZE
from guiderail.models.primitives import LinearConstraints

if TYPE_CHECKING:
    from guiderail.models.templates import SharedControlTemplate


@dataclass(frozen=True)
class PlacedTemplate:
    """Shared control template and the poses of its objects in a scene.

    Attributes:
        template: Shared control template.
        frames: Poses X_TF of the template's objects by name, in the frame of the station's poses.
        active_constraints: True if the active constraints are enforced; None: the guidance's default.
        max_tracking_error: Distance between robot and command [m] beyond which the last command is repeated.
    """

    template: SharedControlTemplate
    frames: Mapping[str, RigidTransform]
    active_constraints: bool | None = None
    max_tracking_error: float = np.inf

    def constrained(self, by_default: bool) -> bool:
        """Return `active_constraints`, or the guidance's own `by_default` if it is None."""
        return by_default if self.active_constraints is None else self.active_constraints


@dataclass(frozen=True)
class ScriptedApproach:
    """Straight motion along z, for guidance without demonstrations, and the range of a policy's action around it.

    Attributes:
        heights: First and last height [m].
        speed: Speed [m/s].
        reach: Displacement of the command [m] along each axis at an action of 1.
    """

    heights: tuple[float, float]
    speed: float
    reach: float


@dataclass(frozen=True)
class PriorKnowledge:
    """Prior knowledge about a task; an attribute is None if the task does not provide it.

    Attributes:
        period: Control period [s].
        demonstrations: Demonstrations with constraints, keep-out walls, and the range of a policy's action.
        template: Shared control template and the poses of its objects.
        approach: Scripted approach.
        options: Options of the guidance by name; empty if it declares none.
        pose_size: Size O of the station's pose.
        wrench_size: Size W of the station's wrench.
    """

    period: float
    demonstrations: PrimitiveConfig | None = None
    template: PlacedTemplate | None = None
    approach: ScriptedApproach | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    pose_size: int = POSE_SIZE
    wrench_size: int = WRENCH_SIZE

    @property
    def constraints(self) -> LinearConstraints:
        """Linear constraints on a commanded pose (O,); no rows without demonstrations."""
        config = self.demonstrations
        return LinearConstraints.none(self.pose_size) if config is None else config.constraints

    def has(self, requirement: str) -> bool:
        """Return True if the task provides a requirement: "demonstrations", "keep_out", "template" or "approach"."""
        if requirement == "keep_out":
            return self.demonstrations is not None and self.demonstrations.keep_out is not None
        return getattr(self, requirement) is not None
