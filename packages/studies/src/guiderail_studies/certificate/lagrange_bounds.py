"""Bounds on commands whose corrections satisfy a budget, tightened by Lagrange multipliers of the constraints.

A correction is the change of a command by active constraints; see `bounds.py` for the budget.

The largest displacement from the center of a zonotope along a direction is the sum of the absolute values of the
generators along this direction. Constraints on commands at nearby steps tighten this bound: for any multiplier α,
subtract α times the generators of such a command from those along the direction, and add |α| times the margin of the
command's constraint. Any multipliers give a valid bound, because they are feasible points of the dual of a linear
program. A greedy search finds good multipliers.
"""

from dataclasses import dataclass

import numpy as np

from guiderail_studies.certificate.loop import Bounds, CertifiedLoop, single_output_bounds

ROUNDS = 4  # number of constraints at nearby steps that tighten one bound
MAX_DISTANCE, STRIDE = 48, 3  # largest distance of these steps from the step of the bound, and their spacing [steps]
NUM_CANDIDATES = 6  # number of constraints tried in each round, those most correlated with the direction
FACTORS = np.array([0.15, 0.3, 0.5, 0.75, 1.0])  # multipliers tried, relative to the least-squares multiplier


@dataclass(frozen=True)
class Budget:
    """Budget of corrections: the rows are the largest value at one step and the largest sum over a sequence."""

    excess: np.ndarray  # excess over ±1 of the actions that would lead to the corrected commands (2, A), A actions
    residue: np.ndarray  # displacement, by corrections, of the outputs that no action moves (2, O) [unit of the output]


@dataclass(frozen=True)
class BudgetedBounds:
    """Bounds under the assumption that corrections satisfy a budget.

    The last three attributes prove the bounds. The axes of their shape (3, 2, N, O, R) are the order of the difference
    (0 for commands, 1 for speeds, 2 for accelerations), sign, step, output and round of the search.
    """

    budget: Budget  # assumed budget
    bounds: Bounds  # bounds on commands, speeds and accelerations
    steps: np.ndarray  # step of the constraint that tightens a bound
    outputs: np.ndarray  # output of this constraint
    multipliers: np.ndarray  # multiplier of this constraint, positive for an upper bound, negative for a lower bound


def bound_within_budget(
    loop: CertifiedLoop, free: Bounds, middle: np.ndarray, generators: np.ndarray, first: int, budget: Budget
) -> BudgetedBounds:
    """Compute bounds of a loop with a history for corrections that satisfy a budget.

    `free` are the bounds without active constraints, `middle` and `generators` the results of `reach`, and `first` is
    the first step at which a constraint can be active.
    """
    num_steps, num_outputs = loop.primitive.num_steps, loop.primitive.num_outputs
    generators = np.concatenate([generators, residue_generators(loop, first)], axis=2)
    search = MultiplierSearch(loop, middle, generators, first, budget)
    shape = (3, 2, num_steps, num_outputs)
    steps, outputs, multipliers = (np.zeros((*shape, ROUNDS), kind) for kind in (int, int, float))
    largest = np.zeros(shape)
    for order in range(3):
        middle_change, generator_changes = np.diff(middle, order, axis=0), np.diff(generators, order, axis=0)
        for n in range(first, num_steps):
            search.select_step(n)
            for side, sign in enumerate((1.0, -1.0)):
                at, row = (order, side, n), loop.rest + n - order
                directions = sign * generator_changes[row]
                steps[at], outputs[at], multipliers[at] = search.find(directions)
                value = search.bound(directions, steps[at], outputs[at], multipliers[at])
                largest[at] = sign * middle_change[row] + value
    low, high = single_output_bounds(loop)
    values = [array.copy() for array in (free.lower, free.upper, free.speed, free.acceleration)]
    values[0][first:] = np.maximum(-largest[0, 1], low)[first:]
    values[1][first:] = np.minimum(largest[0, 0], high)[first:]
    for order in (1, 2):
        values[order + 1][first:] = largest[order].max(axis=0)[first:] / loop.period**order
    return BudgetedBounds(budget, Bounds(*values), steps, outputs, multipliers)


def residue_generators(loop: CertifiedLoop, first: int) -> np.ndarray:
    """Compute the responses (R + N, O, B) to a unit residue at each step from `first` in each unmoved output."""
    primitive, past, rest = loop.primitive, loop.primitive.history, loop.rest
    steps, unmoved = primitive.num_steps, np.flatnonzero(loop.gains == 0.0)
    response = np.zeros((rest + steps, primitive.num_outputs, (steps - first) * len(unmoved)))
    for n, row in enumerate(range(rest + first, rest + steps), start=first):
        history_map = primitive.linear_response(n)[0]
        response[row] = history_map @ response[row - past : row].reshape(history_map.shape[1], response.shape[2])
        response[row, unmoved, (n - first) * len(unmoved) + np.arange(len(unmoved))] = 1.0
    return response


class MultiplierSearch:
    """Greedy search for Lagrange multipliers that tighten the bound in a direction.

    The arguments are those of `bound_within_budget`; `generators` also include the `residue_generators`, at the end.
    """

    def __init__(self, loop: CertifiedLoop, middle: np.ndarray, generators: np.ndarray, first: int, budget: Budget):
        self._generators, self._first, self._rest = generators, first, loop.rest
        self._steps, outputs = loop.primitive.num_steps, loop.primitive.num_outputs
        moved = loop.gains != 0.0
        self._actions = self._steps * int(moved.sum())
        self._free = self._actions + outputs  # number of generators without a budget: actions, then the start
        low, high = single_output_bounds(loop)
        self._margins = np.stack([middle[self._rest :] - low, high - middle[self._rest :]])
        self._bounded = np.flatnonzero(np.isfinite(low).any(axis=0) | np.isfinite(high).any(axis=0))
        self._budgets = budget.excess, budget.residue[:, ~moved]

    def select_step(self, n: int) -> None:
        """Select the constraints around step `n` as candidates."""
        first = max(n % STRIDE, n - MAX_DISTANCE // STRIDE * STRIDE)
        near = np.arange(first, min(n + MAX_DISTANCE, self._steps - 1) + 1, STRIDE)
        self._at, self._of = (x.ravel() for x in np.meshgrid(near, self._bounded))
        self._rows = self._generators[self._rest + self._at, self._of, : self._free]
        self._sizes = np.maximum((self._rows**2).sum(axis=1), 1e-300)

    def find(self, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return steps, outputs and multipliers (O, R) that tighten the bound in directions (O, ·)."""
        outputs = len(directions)
        rest, rows = directions[:, : self._free].copy(), np.arange(outputs)
        shape = (outputs, ROUNDS)
        steps, constrained, multipliers = np.zeros(shape, int), np.zeros(shape, int), np.zeros(shape)
        for r in range(ROUNDS if len(self._at) else 0):
            products = rest @ self._rows.T
            tried = np.argsort(-np.abs(products) / np.sqrt(self._sizes), axis=1)[:, :NUM_CANDIDATES]
            alpha = (products / self._sizes)[rows[:, None], tried][..., None] * FACTORS
            margin = self._margins[(alpha > 0.0).astype(int), self._at[tried][..., None], self._of[tried][..., None]]
            cost = np.where(np.isfinite(margin), np.abs(alpha) * np.where(np.isfinite(margin), margin, 0.0), np.inf)
            bounds = np.abs(rest[:, None, None] - alpha[..., None] * self._rows[tried][:, :, None]).sum(axis=3) + cost
            best = bounds.reshape(outputs, -1).argmin(axis=1)
            is_better = bounds.reshape(outputs, -1)[rows, best] < np.abs(rest).sum(axis=1)
            chosen = tried[rows, best // len(FACTORS)]
            steps[:, r], constrained[:, r] = self._at[chosen], self._of[chosen]
            multipliers[:, r] = np.where(is_better, alpha.reshape(outputs, -1)[rows, best], 0.0)
            rest -= multipliers[:, r, None] * self._rows[chosen]
        return steps, constrained, multipliers

    def bound(
        self, directions: np.ndarray, steps: np.ndarray, outputs: np.ndarray, multipliers: np.ndarray
    ) -> np.ndarray:
        """Compute upper bounds (O,) on the displacement along directions, which are given as generators (O, ·).

        The bounds are proven by the `multipliers` (O, R) of the constraints at `steps` (O, R) on `outputs` (O, R).
        """
        rest = directions - np.einsum("or,orc->oc", multipliers, self._generators[self._rest + steps, outputs])
        margins = self._margins[(multipliers > 0.0).astype(int), steps, outputs]
        margin = np.where(multipliers == 0.0, 0.0, margins)
        value = np.abs(rest[:, : self._free]).sum(axis=1) + (np.abs(multipliers) * margin).sum(axis=1)
        steps_left = self._steps - self._first
        excess = rest[:, self._actions - steps_left * self._budgets[0].shape[1] : self._actions]
        for response, (per_step, total) in zip((excess, rest[:, self._free :]), self._budgets, strict=True):
            spent = np.clip(total - np.arange(steps_left)[:, None] * per_step, 0.0, per_step)
            sizes = np.sort(np.abs(response).reshape(len(rest), steps_left, len(total)), axis=1)[:, ::-1]
            value += (sizes * spent).sum(axis=(1, 2))
        return value
