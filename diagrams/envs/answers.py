"""Results of a task's methods, checked where diagrams are built from them."""

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

HALF_TURN_MARGIN = 0.1  # margin of demonstrated angles to ±180° [rad]: actions and contact turn the tool further


class _Answer(NamedTuple):
    """Types that a method may return: one of `kinds`, or a list or tuple of `entry`."""

    kinds: tuple[type, ...] = ()
    entry: type | None = None

    def accepts(self, value: Any) -> bool:
        is_list = self.entry is not None and isinstance(value, list | tuple)
        return isinstance(value, self.kinds) or (is_list and all(isinstance(one, self.entry or ()) for one in value))

    def __str__(self) -> str:
        names = ["None" if kind is NoneType else kind.__name__ for kind in self.kinds]
        return " or ".join(names + ([] if self.entry is None else [f"a list of {self.entry.__name__}"]))


_ANSWERS = {
    "reference": _Answer((ReferenceTrajectory,)),
    "keep_out": _Answer((KeepOut,)),
    "template": _Answer((PlacedTemplate,)),
    "approach": _Answer((ScriptedApproach,)),
    "constraints": _Answer((LinearConstraints, NoneType)),
    "motion_constraints": _Answer((MotionConstraints, NoneType)),
    "impedance": _Answer((Impedance, NoneType)),
    "signals": _Answer((Mapping,)),
    "observation_terms": _Answer((Camera,), ObservationTerm),
    "privileged_terms": _Answer(entry=ObservationTerm),
    "reward_terms": _Answer(entry=RewardTerm),
    "termination_terms": _Answer(entry=TerminationTerm),
}
_WORKCELLS = {
    "insertion": ("X_WT", "add_fixture", "add_workpiece", "filter_contacts"),
    "plane": ("robot_radius", "walls", "goal", "goal_radius", "zone_x", "obstacle", "obstacles", "obstacles_move"),
    "pouring": ("X_WT", "mug", "ball", "num_balls", "plant_period", "control_period"),
}  # names that a workcell must have, by its kind; workcells of other kinds are not checked


def ask(task: Task, method: str, *arguments: Any) -> Any:
    """Call a method of a task that declares a part of its diagram, and return the result.

    Raises:
        InputError: If the method does not take these arguments, or returns another type than `Task` declares.
    """
    check_takes_arguments(task, method)
    value = getattr(task, method)(*arguments)
    if not _ANSWERS[method].accepts(value):
        raise InputError(f"{method}() of {task.name} must return {_ANSWERS[method]}, not {brief(value)}")
    return value


def check_takes_arguments(task: Task, method: str) -> None:
    """Raise an `InputError` if a method of a task does not take the arguments of the method of `Task`."""
    own, needed = (inspect.signature(getattr(declared, method)) for declared in (task, Task))
    names = list(needed.parameters)[1:]
    try:
        own.bind(*names)
    except TypeError:
        raise InputError(
            f"{method}() of {task.name} is called with the arguments ({', '.join(names)}), but has the parameters "
            f"({', '.join(own.parameters)}): give it those of Task.{method}"
        ) from None


def threshold_of(task: Task) -> Threshold:
    """Return the attribute `collision` of a task.

    Raises:
        InputError: If it is no `Threshold`, or its limit is no number.
    """
    if not isinstance(task.collision, Threshold):
        raise InputError(f"collision of {task.name} must be a Threshold, not {brief(task.collision)}")
    if np.isnan(as_number(task.collision.above, f"the limit of the collision threshold of {task.name}")):
        raise InputError(f"the limit of the collision threshold of {task.name} must be a number, not nan")
    return task.collision


def workcell_of(task: Task) -> Any:
    """Return the workcell of a task.

    Raises:
        InputError: If there is none, or it lacks an attribute that the stations for its kind need.
    """
    check_takes_arguments(task, "workcell")
    workcell, station = task.workcell(), task.config.station
    if workcell is None:
        raise InputError(f"workcell() of {task.name} returns nothing: let it return what station={station!r} works on")
    missing = [name for name in _WORKCELLS.get(task.workcell_kind, ()) if not hasattr(workcell, name)]
    if missing:
        raise InputError(
            f"workcell() of {task.name} returns {brief(workcell)}, which has no {missing[0]}: let it return what "
            f"station={station!r} works on"
        )
    return workcell


def refuse_half_turns(means: np.ndarray) -> None:
    """Raise an `InputError` if angles of a motion (N, 6) come near ±180°, where the station's pose jumps."""
    furthest = np.abs(means[:, 3:]).max(initial=0.0)
    if furthest > np.pi - HALF_TURN_MARGIN:
        raise InputError(
            f"the demonstrations turn to {np.rad2deg(furthest):.0f}°, and this station's angles jump by a full turn at "
            f"180°: rotate the target's frame, so that they stay {np.rad2deg(HALF_TURN_MARGIN):.0f}° away"
        )
