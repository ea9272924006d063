"""Bounds on what a primitive commands, for all sequences of actions in [−1, 1].

Where no constraint is active the loop history → next command is affine: its reachable set is a zonotope, whose
generators are the impulse responses, and the largest value along any direction is the sum of their sizes. Three regimes
are certified.

- *free*: for all sequences, as long as no constraint had to be enforced. Exact.
- *always*: for all sequences. Up to the first step whose window a constraint can touch it is the free regime. From
  there on a constrained output is capped by the constraint set. Without a history (KGRL) a command is a function of
  one action, and the actions are cut into cells. Between a cell's corners the mean v̄ of the corners' corrections v_i
  is a feasible one, and the least one v of any action is no farther from it than ‖v − v̄‖² ≤ ‖v̄‖² − ‖v‖², where a
  corner's multipliers bound ‖v‖ from below (weak duality). So a command is between the corners' by that radius times
  the output's size. With a history corrections feed back, and an output that no constraint caps, and that is tied to
  one that is constrained, has no bound in this regime.
- *budgeted*, with a history: for all sequences in which corrections keep a budget. A correction moves the executed
  point as another action would, and by a residue in the outputs that no action moves. What such actions exceed ±1 by
  has a budget, at one step and added up over the sequence, and so has the residue: both are small, as a correction
  takes back what an action asked for. They are worst where the response to them is largest. That they are kept is
  assumed, not proved.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from guiderail.models.certificate.lagrange_bounds import Budget, Budgeted, budgeted
from guiderail.models.certificate.loop import Bounds, SharedControlTemplate, caps, reach
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp

CELLS = {1: 16, 2: 24, 3: 3}  # along each action, by how many actions there are; one for more
MOST_ACTIONS = 6  # of which all corners are looked at
ROUNDING = 1e-6  # of a squared correction: a radius below its root is none


@dataclass(frozen=True)
class Certified:
    """What holds of a skill.

    Attributes:
        free, always: the two regimes.
        touched: (N,), whether a constraint can be active in a step's window, whatever the actions before.
        multipliers: at the steps that are touched, for every corner of a cell of the actions (T, (K+1)^A, H+1, F):
            what proves how far commands go; empty with a history.
        budgeted: the third regime; None where there is none.
    """

    free: Bounds
    always: Bounds
    touched: np.ndarray
    multipliers: np.ndarray
    budgeted: Budgeted | None = None


def certify(skill: SharedControlTemplate, budget: Budget | None = None) -> Certified:
    """The bounds of a skill; of the budgeted regime as well, with a budget and where a history feeds corrections back.

    Raises:
        InputError: if a primitive without a history has more actions than whose corners can be looked at.
    """
    primitive = skill.primitive
    middle, generators = reach(skill)
    free = _of_zonotope(middle, generators, skill)
    touched = _touched(skill, middle, generators)
    if primitive.history:
        unknown = np.logical_or.accumulate(touched)[:, None] & _coupled(primitive)
        corrected = np.where(unknown, np.inf, np.nan) * np.array([-1.0, 1.0])[:, None, None]
        multipliers = _none(primitive)
    else:
        corrected, multipliers = _cellwise(skill, touched)
    always = _always(skill, free, corrected)
    if budget is None or not primitive.history or not touched.any():
        return Certified(free, always, touched, multipliers)
    first = int(np.argmax(touched))
    return Certified(free, always, touched, multipliers, budgeted(skill, free, middle, generators, first, budget))


def nodes(gains: np.ndarray) -> tuple[np.ndarray, list[list[int]]]:
    """The corners (C, O) of all cells of the raw actions, and which of them each cell has.

    Raises:
        InputError: for too many actions.
    """
    moved = np.flatnonzero(gains)
    if len(moved) > MOST_ACTIONS:
        raise InputError(f"the corners of {len(moved)} actions are too many to look at: explore {MOST_ACTIONS} at most")
    along = CELLS.get(len(moved), 1)
    places = list(itertools.product(range(along + 1), repeat=len(moved)))
    number = {place: i for i, place in enumerate(places)}
    raw = np.zeros((len(places), len(gains)))
    raw[:, moved] = (2.0 * np.array(places).reshape(len(places), len(moved)) / along - 1.0) * gains[moved]
    cells = [
        [number[tuple(np.add(first, step))] for step in itertools.product((0, 1), repeat=len(moved))]
        for first in itertools.product(range(along), repeat=len(moved))
    ]
    return raw, cells


def _of_zonotope(middle: np.ndarray, generators: np.ndarray, skill: SharedControlTemplate) -> Bounds:
    steps = skill.primitive.num_steps
    size = np.abs(generators).sum(axis=2)
    changes = []
    for order in (1, 2):
        change = np.abs(np.diff(middle, order, axis=0)) + np.abs(np.diff(generators, order, axis=0)).sum(axis=2)
        padded = np.concatenate([np.zeros((order, middle.shape[1])), change])[-steps:]
        changes.append(padded / skill.period**order)
    return Bounds((middle - size)[-steps:], (middle + size)[-steps:], *changes)


def _touched(skill: SharedControlTemplate, middle: np.ndarray, generators: np.ndarray) -> np.ndarray:
    primitive, past = skill.primitive, skill.primitive.history
    moved = np.flatnonzero(skill.gains)
    touched = np.zeros(primitive.num_steps, dtype=bool)
    for n in range(primitive.num_steps):
        rows, lower, upper = primitive.free_constraints(n)
        of_history, of_action = rows[:, : past * primitive.num_outputs], rows[:, past * primitive.num_outputs :]
        value = of_history @ middle[n : past + n].ravel()
        spread = of_history @ generators[n : past + n].reshape(of_history.shape[1], generators.shape[2])
        spread[:, n * len(moved) : (n + 1) * len(moved)] += of_action[:, moved] * skill.gains[moved]
        size = np.abs(spread).sum(axis=1)
        touched[n] = bool((value - size < lower).any() or (value + size > upper).any())
    return touched


def _cellwise(skill: SharedControlTemplate, touched: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and greatest commands (2, N, O) at touched steps, NaN at others, and the multipliers that prove them."""
    primitive = skill.primitive
    reached, multipliers = np.full((2, primitive.num_steps, primitive.num_outputs), np.nan), []
    actions, cells = nodes(skill.gains)
    for n in map(int, np.flatnonzero(touched)):
        found = [primitive.predict(n, action) for action in actions]
        multipliers.append([one.multipliers for one in found])
        rows, lower, upper = primitive.free_constraints(n)
        empty = np.zeros(next((len(one.correction) for one in found if one.correction is not None), 0))
        corrections = np.array([empty if one.correction is None else one.correction for one in found])
        free, outputs, sizes = actions @ rows.T, np.array([one.output for one in found]), primitive.output_sizes(n)
        ranges = []
        for cell in cells:
            least = [_least_sizes(found[k].signed_multipliers, free[cell], lower, upper, corrections[k]) for k in cell]
            radius = sizes * np.sqrt(min(_squared_radius(corrections[cell], one) for one in least))
            ranges.append([outputs[cell].min(axis=0) - radius, outputs[cell].max(axis=0) + radius])
        reached[0, n], reached[1, n] = np.min(ranges, axis=0)[0], np.max(ranges, axis=0)[1]
    return reached, np.array(multipliers) if multipliers else _none(primitive)


def _least_sizes(
    signed: np.ndarray | None, free: np.ndarray, lower: np.ndarray, upper: np.ndarray, correction: np.ndarray
) -> np.ndarray:
    """What multipliers say of the size of a cell's corners' corrections at least; zeros where that is nothing."""
    size = np.linalg.norm(correction)
    if signed is None or not size > 0.0:
        return np.zeros(len(free))
    at_lower, at_upper = signed < 0.0, signed > 0.0
    short = (lower - free)[:, at_lower] @ -signed[at_lower] + (free - upper)[:, at_upper] @ signed[at_upper]
    return short / size if (short >= 0.0).all() else np.zeros(len(free))


def _squared_radius(corrections: np.ndarray, least: np.ndarray) -> float:
    """How far the least correction of any action in a cell can be from the mean of the corners' there, squared."""
    squared = np.sum(corrections**2, axis=1)
    apart = np.sum((corrections[:, None] - corrections) ** 2, axis=2)
    between = 0.5 * max(float(np.max((least[:, None] - least) ** 2 - apart)), 0.0)
    return max(float(np.max(squared - least**2)) + between, ROUNDING * float(squared.max()))


def _none(primitive: LcNsKmp) -> np.ndarray:
    return np.zeros((0, 0, primitive.horizon + 1, primitive.constraints.num_constraints))


def _coupled(primitive: LcNsKmp) -> np.ndarray:
    """(O,): whether a correction can move an output: one that is constrained, or tied to such a one by covariance."""
    tied = (primitive.reference.covariances != 0.0).any(axis=0)
    reached = (primitive.constraints.G.reshape(-1, primitive.num_outputs) != 0.0).any(axis=0)
    for _ in range(primitive.num_outputs):
        reached = reached | (tied & reached).any(axis=1)
    return reached


def _always(skill: SharedControlTemplate, free: Bounds, reached: np.ndarray) -> Bounds:
    corrected = ~np.isnan(reached[0])
    least, greatest = caps(skill)
    lower = np.where(corrected, np.maximum(reached[0], least), free.lower)
    upper = np.where(corrected, np.minimum(reached[1], greatest), free.upper)
    speed, acceleration = free.speed.copy(), free.acceleration.copy()
    begin = np.broadcast_to([skill.start - skill.start_within, skill.start + skill.start_within], (2, *lower.shape[1:]))
    for n in range(len(lower)):
        low, high = _last(lower, n, begin[0]), _last(upper, n, begin[1])
        if (n >= 1 or skill.primitive.history) and corrected[max(n - 1, 0) : n + 1].any():
            away = np.maximum(high[0] - low[1], high[1] - low[0]) / skill.period
            speed[n] = np.where(corrected[max(n - 1, 0) : n + 1].any(axis=0), away, speed[n])
        if (n >= 2 or skill.primitive.history) and corrected[max(n - 2, 0) : n + 1].any():
            most = np.maximum(high[0] - 2.0 * low[1] + high[2], 2.0 * high[1] - low[0] - low[2]) / skill.period**2
            acceleration[n] = np.where(corrected[max(n - 2, 0) : n + 1].any(axis=0), most, acceleration[n])
    return Bounds(lower, upper, speed, acceleration)


def _last(values: np.ndarray, n: int, begin: np.ndarray) -> list[np.ndarray]:
    """Of step n and the two before it, the newest first; before the first step it is where the robot begins."""
    return [values[k] if k >= 0 else begin for k in (n, n - 1, n - 2)]
