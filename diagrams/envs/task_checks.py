"""Checks of a task's declarations, made when diagrams are built from them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from guiderail.diagrams.envs.observation import ObservationTerm
from guiderail.diagrams.stations.registry import StationKind
from guiderail.models.common.errors import InputError, brief

# Smallest distance of demonstrated angles from ±180° [rad], because actions and contact turn the tool further.
HALF_TURN_MARGIN = 0.1


# Attributes that a workcell must have, by its kind; workcells of other kinds are not checked.
_WORKCELL_ATTRIBUTES = {
    "insertion": ("X_WT", "add_fixture", "add_workpiece", "filter_contacts"),
    "plane": ("robot_radius", "walls", "goal", "goal_radius", "zone_x", "obstacle", "obstacles", "obstacles_move"),
    "pouring": ("X_WT", "mug", "ball", "num_balls", "plant_period", "control_period"),
}


def check_workcell(workcell: Any, kind: StationKind, task: str) -> None:
    """Check that the workcell of a task has the attributes that stations of a `kind` need.

    Raises:
        InputError: If there is no workcell, or it lacks an attribute.
    """
    if workcell is None:
        raise InputError(f"workcell() of {task} returns nothing: let it return what station={kind.name!r} works on")
    missing = [name for name in _WORKCELL_ATTRIBUTES.get(kind.workcell_kind, ()) if not hasattr(workcell, name)]
    if missing:
        raise InputError(
            f"workcell() of {task} returns {brief(workcell)}, which has no {missing[0]}: let it return what "
            f"station={kind.name!r} works on"
        )


def check_terms(terms: Any, task: str) -> None:
    """Raise an `InputError` unless the observation of a task is a list of `ObservationTerm`."""
    if not isinstance(terms, list | tuple) or not all(isinstance(term, ObservationTerm) for term in terms):
        raise InputError(f"observe() of {task} must return Observed or a list of ObservationTerm, not {brief(terms)}")


def check_functions(functions: Any, method: str, task: str) -> None:
    """Raise an `InputError` unless a `method` of a task returns functions by name."""
    if not isinstance(functions, Mapping):
        raise InputError(f"{method}() of {task} must return functions of signals by name, not {brief(functions)}")


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
