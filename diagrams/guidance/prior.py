"""What is known about a task, for guidance to be made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from guiderail.diagrams.guidance.primitive_config import PrimitiveConfig
from guiderail.models.common.poses import POSE_SIZE, WRENCH_SIZE
from guiderail.models.primitives import LinearConstraints
from guiderail.models.templates import SharedControlTemplate


@dataclass(frozen=True)
class PlacedTemplate:
    """A shared control template and the poses of its objects in a scene.

    Attributes:
        template: the template.
        frames: poses X_TF of the template's objects by name, in the frame of the station's poses.
        active_constraints: whether the active constraints are enforced; None: the kind of guidance decides.
        max_tracking_error: distance [m] between the robot and its command beyond which the command waits.
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
    """A straight line along z that needs no demonstrations, and how far a policy may lead away from it.

    Attributes:
        heights: where it begins and ends [m].
        speed: [m/s].
        reach: how far a full action moves the command along each axis [m].
    """

    heights: tuple[float, float]
    speed: float
    reach: float


@dataclass(frozen=True)
class PriorKnowledge:
    """What a task knows; None where the task does not override the method of that name.

    Attributes:
        period: s, seconds between control steps.
        demonstrations: with constraints, walls to keep out of, and how a policy may move between them.
        template: shared control template and the poses of its objects.
        approach: a scripted one.
        options: of the kind of guidance itself, by name, where it declares some.
        pose_size: O of the station.
        wrench_size: W of the station.
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
        """The linear ones on a commanded pose (O,), which come with demonstrations; none where there are none."""
        known = self.demonstrations
        return LinearConstraints.none(self.pose_size) if known is None else known.constraints

    def has(self, ingredient: str) -> bool:
        """Whether the task declares "demonstrations", "keep_out" (beside demonstrations), "template" or "approach"."""
        if ingredient == "keep_out":
            return self.demonstrations is not None and self.demonstrations.keep_out is not None
        return getattr(self, ingredient) is not None
