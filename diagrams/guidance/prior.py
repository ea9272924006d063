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
class Template:
    """A shared control template in its surroundings.

    Attributes:
        skill: the template.
        frames: the poses X_TF of its objects by name, in the frame that the station's poses are given in.
        active_constraints: whether they hold; None leaves it to the kind of guidance.
        leash: [m] how far the robot may be from its command before that waits.
    """

    skill: SharedControlTemplate
    frames: Mapping[str, RigidTransform]
    active_constraints: bool | None = None
    max_tracking_error: float = np.inf

    def constrained(self, by_default: bool) -> bool:
        """Whether the active constraints hold for a kind of guidance that says so `by_default`."""
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
        template: in its surroundings.
        approach: a scripted one.
        options: of the kind of guidance itself, by name, where it declares some.
        pose_size: O of the station.
        wrench_size: W of the station.
    """

    period: float
    demonstrations: PrimitiveConfig | None = None
    template: Template | None = None
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
