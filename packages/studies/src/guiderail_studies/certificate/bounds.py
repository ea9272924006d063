"""Bounds on the commands of a primitive for all sequences of actions in [−1, 1].

Without active constraints, the next command is an affine function of the history and the action, and the set of
reachable motions is a zonotope. The generators of the zonotope are the impulse responses. Its half-width along a
direction is the sum of the absolute values of the generators along that direction. Three regimes are certified:

- *free*: all sequences, until a constraint becomes active. These bounds are exact.
- *always*: all sequences. The window of a step consists of this step and its H future points with constraints. Without
  a history, the bounds of *free* are valid at each step where no constraint of the window can be active; with a
  history, only before the first step where a constraint can be active. At all other steps, a constrained output is
  bounded by the constraints themselves.
  Without a history (KGRL), a command depends on one action only, and the actions are divided into cells. An action in
  a cell is a convex combination of the corners, with weights λ_i. The same combination v̄ = Σ λ_i v_i of the corners'
  corrections v_i is feasible for this action. The smallest feasible correction v satisfies ‖v − v̄‖² ≤ ‖v̄‖² − ‖v‖².
  The multipliers at a corner give a lower bound of ‖v‖ (weak duality). So an output exceeds the range of the outputs
  at the corners by at most ‖v − v̄‖ times the output's largest displacement per unit of correction. With a history,
  corrections act on later commands, and an unconstrained output that is coupled to a constrained output has no bound.
- *budgeted*, with a history: all sequences whose corrections satisfy a budget. A corrected command equals the command
  of another action, possibly outside ±1, plus a residue in the outputs that no action moves. The budget limits the
  excess of these actions over ±1, and the residue, at one step and summed over the sequence. Excess and residue are
  small, because a correction counteracts the action that violates a constraint. In the worst case, the corrections
  occur at the steps with the largest response. The budget is an assumption about the sequence and is not proven.
"""

import itertools
from dataclasses import dataclass

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.constraints import LinearConstraints
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.qp import UnsolvableError
from guiderail_studies.certificate.lagrange_bounds import Budget, BudgetedBounds, bound_within_budget
from guiderail_studies.certificate.loop import Bounds, CertifiedLoop, reach, single_output_bounds

CELLS = {1: 16, 2: 24, 3: 3}  # number of actions → number of cells along each; 1 for more actions
MAX_ACTIONS = 6  # largest number of actions whose corners are enumerated
ROUNDING = 1e-6  # smallest squared radius of a cell, relative to the squared correction
BORDER = 1e-6  # slack below which a constraint counts as active, relative to the constraint's terms
CORNER_MARGIN = 1e-8  # margin of the corrections at corners, so that the checker's rounding cannot make them infeasible


@dataclass(frozen=True)
class CertifiedBounds:
    """Certified bounds of a loop."""

    free: Bounds  # bounds until a constraint becomes active
    always: Bounds  # bounds for all sequences
    can_be_active: np.ndarray  # mask (N,) of the steps at which some actions make a constraint of the window active
    # Lagrange multipliers that prove `always`, (T, (K+1)^A, H+1, F): T steps of `can_be_active`, corners of the cells
    # (K cells along each of A actions), points of the window, and constraints of each point. Empty with a history.
    multipliers: np.ndarray
    budgeted: BudgetedBounds | None = None  # bounds for corrections within a budget, or None


def certify(loop: CertifiedLoop, budget: Budget | None = None) -> CertifiedBounds:
    """Compute the bounds of a loop.

    The regime *budgeted* is left out without a budget, without a history, or if no constraint can be active.

    Raises:
        InputError: If a primitive without a history has more than `MAX_ACTIONS` actions, its constraints leave less
            room than twice `CORNER_MARGIN`, or a constrained program is not solved.
    """
    primitive = loop.primitive
    middle, generators = reach(loop)
    free = _bound_zonotope(middle, generators, loop)
    can_be_active = _find_active_steps(loop, middle, generators)
    if primitive.history:
        is_unbounded = np.logical_or.accumulate(can_be_active)[:, None] & _find_coupled(primitive)
        corrected = np.where(is_unbounded, np.inf, np.nan) * np.array([-1.0, 1.0])[:, None, None]
        multipliers = _no_multipliers(primitive)
    else:
        corrected, multipliers = _bound_cells(loop, can_be_active)
    always = _bound_always(loop, free, corrected)
    if budget is None or not primitive.history or not can_be_active.any():
        return CertifiedBounds(free, always, can_be_active, multipliers)
    first = int(np.argmax(can_be_active))
    budgeted = bound_within_budget(loop, free, middle, generators, first, budget)
    return CertifiedBounds(free, always, can_be_active, multipliers, budgeted)


def action_cells(gains: np.ndarray) -> tuple[np.ndarray, list[list[int]]]:
    """Divide the actions into cells, given the null-space action per unit of the action, `gains` (O,).

    Returns:
        The corners (C, O) of all cells as null-space actions, and the indices of the corners of each cell.

    Raises:
        InputError: If there are more than `MAX_ACTIONS` actions.
    """
    moved = np.flatnonzero(gains)
    if len(moved) > MAX_ACTIONS:
        raise InputError(
            f"the corners of {len(moved)} actions are too many to enumerate: explore {MAX_ACTIONS} at most"
        )
    along = CELLS.get(len(moved), 1)
    nodes = list(itertools.product(range(along + 1), repeat=len(moved)))
    index = {node: i for i, node in enumerate(nodes)}
    raw = np.zeros((len(nodes), len(gains)))
    raw[:, moved] = (2.0 * np.array(nodes).reshape(len(nodes), len(moved)) / along - 1.0) * gains[moved]
    cells = [
        [index[tuple(np.add(first, step))] for step in itertools.product((0, 1), repeat=len(moved))]
        for first in itertools.product(range(along), repeat=len(moved))
    ]
    return raw, cells


def _bound_zonotope(middle: np.ndarray, generators: np.ndarray, loop: CertifiedLoop) -> Bounds:
    steps = loop.primitive.num_steps
    size = np.abs(generators).sum(axis=2)
    changes = []
    for order in (1, 2):
        change = np.abs(np.diff(middle, order, axis=0)) + np.abs(np.diff(generators, order, axis=0)).sum(axis=2)
        changes.append(change[-steps:] / loop.period**order)
    return Bounds((middle - size)[-steps:], (middle + size)[-steps:], *changes)


def _find_active_steps(loop: CertifiedLoop, middle: np.ndarray, generators: np.ndarray) -> np.ndarray:
    """Return the mask (N,) of the steps at which a constraint can be active."""
    primitive, past = loop.primitive, loop.primitive.history
    moved = np.flatnonzero(loop.gains)
    can_be_active = np.zeros(primitive.num_steps, dtype=bool)
    for n in range(primitive.num_steps):
        rows, lower, upper = primitive.free_constraints(n)
        history_map, action_map = rows[:, : past * primitive.num_outputs], rows[:, past * primitive.num_outputs :]
        rows_past = slice(loop.rest + n - past, loop.rest + n)
        value = history_map @ middle[rows_past].ravel()
        spread = history_map @ generators[rows_past].reshape(history_map.shape[1], generators.shape[2])
        spread[:, n * len(moved) : (n + 1) * len(moved)] += action_map[:, moved] * loop.gains[moved]
        size = np.abs(spread).sum(axis=1)
        # A constraint with less slack than `BORDER` counts as active, so that the result does not depend on rounding.
        limits = np.array([lower, upper])
        near = BORDER * (np.abs(value - np.where(np.isfinite(limits), limits, value)) + size)
        can_be_active[n] = bool((value - size < lower + near[0]).any() or (value + size > upper - near[1]).any())
    return can_be_active


def _bound_cells(loop: CertifiedLoop, can_be_active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return bounds (2, N, O) of corrected commands, NaN at steps without corrections, and multipliers as proof."""
    primitive = _with_margin(loop.primitive)
    bounds, multipliers = np.full((2, primitive.num_steps, primitive.num_outputs), np.nan), []
    actions, cells = action_cells(loop.gains)
    for n in map(int, np.flatnonzero(can_be_active)):
        try:
            predictions = [primitive.predict(n, action) for action in actions]
        except UnsolvableError as error:
            raise InputError(f"step {n} can't be certified, because {error}: widen the constraints") from error
        multipliers.append([prediction.multipliers for prediction in predictions])
        rows, lower, upper = loop.primitive.free_constraints(n)  # without `CORNER_MARGIN`, for `_min_norms`
        solutions = [prediction.correction for prediction in predictions]
        rank = next((len(solution) for solution in solutions if solution is not None), 0)
        corrections = np.array([np.zeros(rank) if solution is None else solution for solution in solutions])
        free, sizes = actions @ rows.T, primitive.output_sizes(n)
        outputs = np.array([prediction.output for prediction in predictions])
        ranges = []
        for cell in cells:
            norms = [
                _min_norms(predictions[k].signed_multipliers, free[cell], lower, upper, corrections[k]) for k in cell
            ]
            radius = sizes * np.sqrt(min(_squared_radius(corrections[cell], min_norms) for min_norms in norms))
            ranges.append([outputs[cell].min(axis=0) - radius, outputs[cell].max(axis=0) + radius])
        bounds[0, n], bounds[1, n] = np.min(ranges, axis=0)[0], np.max(ranges, axis=0)[1]
    return bounds, np.array(multipliers) if multipliers else _no_multipliers(primitive)


def _with_margin(primitive: LcNsKmp) -> LcNsKmp:
    """Return the primitive with constraints tightened by `CORNER_MARGIN`.

    Raises:
        InputError: If the constraints leave no room for this margin.
    """
    constraints = primitive.constraints
    tighter = np.where((constraints.G != 0.0).any(axis=-1), constraints.c + CORNER_MARGIN, constraints.c)
    try:
        tightened = LinearConstraints(constraints.G, tighter)
    except InputError as error:
        raise InputError("constraints that leave less than 20 nm of room can't be certified: widen them") from error
    settings = {name: getattr(primitive, name) for name in ("lambda_", "beta", "horizon")}
    # No check of the deviation: the motion without constraints is that of `primitive`, which has passed this check.
    return LcNsKmp(primitive.reference, primitive.kernel, constraints=tightened, max_deviation=np.inf, **settings)


def _min_norms(
    signed: np.ndarray | None, free: np.ndarray, lower: np.ndarray, upper: np.ndarray, correction: np.ndarray
) -> np.ndarray:
    """Return lower bounds on the norms of the corrections at a cell's corners, proven by multipliers, or zeros."""
    norm = np.linalg.norm(correction)
    if signed is None or not norm > 0.0:
        return np.zeros(len(free))
    at_lower, at_upper = signed < 0.0, signed > 0.0
    missing = (lower - free)[:, at_lower] @ -signed[at_lower] + (free - upper)[:, at_upper] @ signed[at_upper]
    return missing / norm if (missing >= 0.0).all() else np.zeros(len(free))


def _squared_radius(corrections: np.ndarray, min_norms: np.ndarray) -> float:
    """Return a bound on ‖v − v̄‖², with a correction v in a cell and the interpolation v̄ of the corners' corrections."""
    squared = np.sum(corrections**2, axis=1)
    distances = np.sum((corrections[:, None] - corrections) ** 2, axis=2)
    between = 0.5 * max(float(np.max((min_norms[:, None] - min_norms) ** 2 - distances)), 0.0)
    return max(float(np.max(squared - min_norms**2)) + between, ROUNDING * float(squared.max()))


def _no_multipliers(primitive: LcNsKmp) -> np.ndarray:
    return np.zeros((0, 0, primitive.horizon + 1, primitive.constraints.num_constraints))


def _find_coupled(primitive: LcNsKmp) -> np.ndarray:
    """Return the mask (O,) of outputs that are constrained, or coupled to a constrained output by covariance."""
    coupling = (primitive.reference.covariances != 0.0).any(axis=0)
    is_coupled = (primitive.constraints.G.reshape(-1, primitive.num_outputs) != 0.0).any(axis=0)
    for _ in range(primitive.num_outputs):
        is_coupled = is_coupled | (coupling & is_coupled).any(axis=1)
    return is_coupled


def _bound_always(loop: CertifiedLoop, free: Bounds, corrected_bounds: np.ndarray) -> Bounds:
    """Combine the bounds `free` with those of corrected commands (2, N, O), which are NaN at steps of `free`."""
    is_corrected = ~np.isnan(corrected_bounds[0])
    low, high = single_output_bounds(loop)
    lower = np.where(is_corrected, np.maximum(corrected_bounds[0], low), free.lower)
    upper = np.where(is_corrected, np.minimum(corrected_bounds[1], high), free.upper)
    # Bounds from two steps before the first step on, when the robot rests at a pose in the box of starts.
    least = np.vstack([[loop.start - loop.start_within] * 2, lower])
    greatest = np.vstack([[loop.start + loop.start_within] * 2, upper])
    recent = np.vstack([np.zeros((2, lower.shape[1]), bool), is_corrected])
    steps = np.maximum(greatest[2:] - least[1:-1], greatest[1:-1] - least[2:]) / loop.period
    forward = greatest[2:] - 2.0 * least[1:-1] + greatest[:-2]
    bends = np.maximum(forward, 2.0 * greatest[1:-1] - least[2:] - least[:-2]) / loop.period**2
    speed = np.where(recent[2:] | recent[1:-1], steps, free.speed)
    acceleration = np.where(recent[2:] | recent[1:-1] | recent[:-2], bends, free.acceleration)
    return Bounds(lower, upper, speed, acceleration)
