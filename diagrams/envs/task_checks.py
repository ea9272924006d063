"""Checks of a task's declarations, made when diagrams are built from them."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from types import NoneType
from typing import Any, NamedTuple

import numpy as np

from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.envs.scene import Camera
from guiderail.diagrams.guidance.prior import PlacedTemplate, ScriptedApproach
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.task import Task, Threshold
from guiderail.models.common.arrays import as_number
from guiderail.models.common.errors import InputError, brief
from guiderail.models.control.keep_out import KeepOut
from guiderail.models.control.motion_constraints import MotionConstraints
from guiderail.models.primitives import LinearConstraints, ReferenceTrajectory
from guiderail.systems.episode_monitor import TerminationTerm
from guiderail.systems.reward_system import RewardTerm

# Smallest distance of demonstrated angles from ±180° [rad], because actions and contact turn the tool further.
HALF_TURN_MARGIN = 0.1


class _ReturnType(NamedTuple):
    """Types that a method may return: one of `kinds`, or a list or tuple of `entry`."""

    kinds: tuple[type, ...] = ()
    entry: type | None = None

    def accepts(self, value: Any) -> bool:
        entry = self.entry
        is_list = entry is not None and isinstance(value, list | tuple)
        return isinstance(value, self.kinds) or (is_list and all(isinstance(each, entry or ()) for each in value))

    def __str__(self) -> str:
        names = ["None" if kind is NoneType else kind.__name__ for kind in self.kinds]
        return " or ".join(names + ([] if self.entry is None else [f"a list of {self.entry.__name__}"]))


_RETURN_TYPES = {
    "reference": _ReturnType((ReferenceTrajectory,)),
    "keep_out": _ReturnType((KeepOut,)),
    "template": _ReturnType((PlacedTemplate,)),
    "approach": _ReturnType((ScriptedApproach,)),
    "constraints": _ReturnType((LinearConstraints, NoneType)),
    "motion_constraints": _ReturnType((MotionConstraints, NoneType)),
    "impedance": _ReturnType((Impedance, NoneType)),
    "signals": _ReturnType((Mapping,)),
    "observation_terms": _ReturnType((Camera,), ObservationTerm),
    "privileged_terms": _ReturnType(entry=ObservationTerm),
    "reward_terms": _ReturnType(entry=RewardTerm),
    "termination_terms": _ReturnType(entry=TerminationTerm),
}
# Attributes that a workcell must have, by its kind; workcells of other kinds are not checked.
_WORKCELL_ATTRIBUTES = {
    "insertion": ("X_WT", "add_fixture", "add_workpiece", "filter_contacts"),
    "plane": ("robot_radius", "walls", "goal", "goal_radius", "zone_x", "obstacle", "obstacles", "obstacles_move"),
    "pouring": ("X_WT", "mug", "ball", "num_balls", "plant_period", "control_period"),
}


def call_checked(task: Task, method: str, *arguments: Any) -> Any:
    """Call a method of a task, check the type of the result, and return the result.

    Raises:
        InputError: If the method does not take these arguments, or returns another type than `Task` declares.
    """
    check_takes_arguments(task, method)
    value = getattr(task, method)(*arguments)
    if not _RETURN_TYPES[method].accepts(value):
        raise InputError(f"{method}() of {task.name} must return {_RETURN_TYPES[method]}, not {brief(value)}")
    return value


def check_takes_arguments(task: Task, method: str) -> None:
    """Raise an `InputError` if a method of a task does not take the arguments of the same method of `Task`."""
    signature, base_signature = (inspect.signature(getattr(owner, method)) for owner in (task, Task))
    names = list(base_signature.parameters)[1:]
    try:
        signature.bind(*names)
    except TypeError:
        raise InputError(
            f"{method}() of {task.name} is called with the arguments ({', '.join(names)}), but has the parameters "
            f"({', '.join(signature.parameters)}): give it those of Task.{method}"
        ) from None


def threshold_of(task: Task) -> Threshold:
    """Return the attribute `collision` of a task.

    Raises:
        InputError: If it is not a `Threshold`, or its limit is not a number.
    """
    if not isinstance(task.collision, Threshold):
        raise InputError(f"collision of {task.name} must be a Threshold, not {brief(task.collision)}")
    if np.isnan(as_number(task.collision.above, f"the limit of the collision threshold of {task.name}")):
        raise InputError(f"the limit of the collision threshold of {task.name} must be a number, not nan")
    return task.collision


def workcell_of(task: Task) -> Any:
    """Return the workcell of a task.

    Raises:
        InputError: If there is no workcell, or it lacks an attribute that the stations for its kind need.
    """
    check_takes_arguments(task, "workcell")
    workcell, station = task.workcell(), task.config.station
    if workcell is None:
        raise InputError(f"workcell() of {task.name} returns nothing: let it return what station={station!r} works on")
    missing = [name for name in _WORKCELL_ATTRIBUTES.get(task.workcell_kind, ()) if not hasattr(workcell, name)]
    if missing:
        raise InputError(
            f"workcell() of {task.name} returns {brief(workcell)}, which has no {missing[0]}: let it return what "
            f"station={station!r} works on"
        )
    return workcell


def turns_near_half(means: np.ndarray) -> bool:
    """Return True if angles of a motion (N, 6) come near ±180°."""
    return bool(np.abs(means[:, 3:]).max(initial=0.0) > np.pi - HALF_TURN_MARGIN)


def refuse_half_turns(means: np.ndarray) -> None:
    """Raise an `InputError` if angles of a motion (N, 6) come near ±180°, where the station's angles jump."""
    if turns_near_half(means):
        furthest = np.abs(means[:, 3:]).max()
        raise InputError(
            f"the demonstrations turn to {np.rad2deg(furthest):.0f}°, and this station's angles jump by a full turn at "
            f"180°: rotate the target's frame, so that they stay {np.rad2deg(HALF_TURN_MARGIN):.0f}° away"
        )
