"""Linear inequality constraints g_{n,f}ᵀ ζ^O ≥ c_{n,f} on the output of a primitive (thesis, equation 4.5)."""

from contextlib import suppress

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.qp import UnsolvableError, solve_least_norm

TOLERANCE = 1e-9
"""Largest accepted constraint violation of a command [unit of the output]: 1 nm if outputs are in meters."""
_EPS = float(np.finfo(float).eps)
_ROUNDING = 64 * _EPS  # largest contradiction that counts as rounding, relative to |c| and to the terms of G y


class LinearConstraints:
    """Constraints G y ≥ c, the same at every step or different from step to step.

    Each row and its bound c are divided by the row's norm. Violations are therefore distances in the outputs' unit, and
    the scale of a row changes neither results nor tolerances.

    Args:
        G: Rows g_f, (F, O) or (N, F, O), finite [unit of c / unit of the output].
        c: Lower bounds, (F,) or (N, F), finite.

    Raises:
        InputError: If shapes do not match, a number is not finite, a bound divided by its row's norm is not finite, or
            no output satisfies all constraints of a step, up to rounding.

    Attributes:
        G, c: Rows of unit norm (or zero) and their bounds [unit of the output], read-only; a row whose norm is one up
            to rounding is unchanged.
    """

    def __init__(self, G: np.ndarray, c: np.ndarray):
        self.G, self.c = as_numbers(G, "G"), as_numbers(c, "c")
        if self.G.ndim not in (2, 3) or self.c.shape != self.G.shape[:-1]:
            raise InputError(
                f"constraints need G of shape (F, O) with c of shape (F,), or (N, F, O) with (N, F), "
                f"not {self.G.shape} with {self.c.shape}"
            )
        if not (np.isfinite(self.G).all() and np.isfinite(self.c).all()):
            raise InputError("constraints must be finite: leave out the rows that do not constrain anything")
        self._normalize()
        self._interior = self._find_interior()
        for values in (self.G, self.c):
            values.setflags(write=False)  # primitives of a process share these arrays

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike) -> "LinearConstraints":
        """Return the constraints lower ≤ y ≤ upper.

        Args:
            lower: Lower bounds, (O,) or (N, O); −inf at every step for none.
            upper: Upper bounds, (O,) or (N, O); inf at every step for none.

        Raises:
            InputError: If a lower bound exceeds its upper bound, a bound is NaN or infinite at some steps only, a lower
                bound is inf, or an upper bound is −inf.
        """
        lower, upper = np.broadcast_arrays(as_numbers(lower, "a lower bound"), as_numbers(upper, "an upper bound"))
        # Rows y_0 ≥ lower_0, −y_0 ≥ −upper_0, y_1 ≥ lower_1, …, without those that are infinite at every step.
        c = np.stack([lower, -upper], axis=-1).reshape(*lower.shape[:-1], -1)
        is_finite = (np.atleast_2d(c) != -np.inf).any(axis=0)
        G = np.kron(np.eye(lower.shape[-1]), [[1.0], [-1.0]])[is_finite]
        return cls(np.broadcast_to(G, (*lower.shape[:-1], *G.shape)), c[..., is_finite])

    @classmethod
    def none(cls, num_outputs: int) -> "LinearConstraints":
        """Return an empty set of constraints, F = 0."""
        return cls(np.zeros((0, num_outputs)), np.zeros(0))

    @property
    def num_constraints(self) -> int:
        """Number of constraints F."""
        return self.G.shape[-2]

    @property
    def num_outputs(self) -> int:
        """Number of outputs O."""
        return self.G.shape[-1]

    @property
    def num_steps(self) -> int | None:
        """Number of steps N if constraints differ from step to step, else None."""
        return self.G.shape[0] if self.G.ndim == 3 else None

    def check_sizes(self, num_outputs: int, num_steps: int) -> None:
        """Check that the constraints fit a reference trajectory.

        Raises:
            InputError: If the numbers of outputs differ, or if the constraints differ from step to step and the numbers
                of steps differ.
        """
        if self.num_outputs != num_outputs:
            raise InputError(f"constraints are on {self.num_outputs} outputs, the reference has {num_outputs}")
        if self.num_steps not in (None, num_steps):
            raise InputError(f"constraints are given for {self.num_steps} steps, the reference has {num_steps}")

    def window(self, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return G (n, F, O) and c (n, F) at steps (n,), which are clipped to the first and the last step."""
        steps = np.asarray(steps)
        if self.G.ndim == 2:
            G, c = (np.broadcast_to(values, (len(steps), *values.shape)) for values in (self.G, self.c))
            return G, c
        steps = np.clip(steps, 0, self.G.shape[0] - 1)
        return self.G[steps], self.c[steps]

    def violation(self, output: np.ndarray, step: int = 0) -> float:
        """Compute the largest violation c − G y of a step's constraints, with rows of unit norm [unit of the output].

        The output y is (O,). A negative violation is slack. The result is −inf if there are no constraints.
        """
        if self.num_constraints == 0:
            return -np.inf
        if self.G.ndim == 2:
            return float((self.c - self.G @ output).max())
        step = min(max(step, 0), self.G.shape[0] - 1)
        return float((self.c[step] - self.G[step] @ output).max())

    def nearest(self, output: np.ndarray, step: int = 0) -> np.ndarray:
        """Compute the output (O,) nearest to `output` (O,) within the constraints of a step.

        If the solver fails, the result is the first allowed point on the straight line from `output` to a point inside
        the constraints. A result therefore exists for every finite output.

        Raises:
            UnsolvableError: If `output` is not finite.
        """
        output = as_numbers(output, "an output")
        if not np.isfinite(output).all():
            raise UnsolvableError(f"an output must be finite to have a nearest one within constraints, not {output}")
        if self.violation(output, step) <= 0:
            return output.copy()
        G, c = (a[0] for a in self.window(np.array([step])))
        with suppress(UnsolvableError):
            move, _ = solve_least_norm(G.copy(), c - G @ output, np.full(len(c), np.inf))
            if self.violation(output + move, step) <= TOLERANCE:
                return np.asarray(output + move)
        return self._entry_point(output, step)

    def _entry_point(self, output: np.ndarray, step: int) -> np.ndarray:
        """Return the first point (O,) within the constraints of a step on the line from `output` to a point inside."""
        G, c = (a[0] for a in self.window(np.array([step])))
        inside = self._interior if self.G.ndim == 2 else self._interior[min(max(step, 0), len(self._interior) - 1)]
        inside = np.where((G == 0.0).all(axis=0), output, inside)  # outputs without a constraint do not move
        violation, decrease = c - G @ output, G @ (inside - output)
        is_violated = violation > 0.0
        share = float(np.max(violation[is_violated] / np.maximum(decrease, violation)[is_violated]))
        entry = output + share * (inside - output)
        return entry if self.violation(entry, step) <= TOLERANCE else inside

    def _normalize(self) -> None:
        """Divide each row and its bound by the row's norm, except rows whose norm is one up to rounding."""
        # Rows are first divided by their largest entry, because squares of extreme entries overflow or underflow.
        largest = np.abs(self.G).max(axis=-1, initial=0.0)
        scale = np.where(largest > 0.0, largest, 1.0)
        with np.errstate(over="ignore"):
            G = self.G / scale[..., None]
            norm = np.linalg.norm(G, axis=-1)
            is_unit = np.abs(np.where(largest > 0.0, norm * largest, 1.0) - 1.0) <= 4 * _EPS
            norm = np.where(largest > 0.0, norm, 1.0)
            c = self.c / scale / norm
        if not np.isfinite(c).all():
            raise InputError("a constraint's bound divided by the norm of its row is not finite: scale the row up")
        self.G = np.where(is_unit[..., None], self.G, G / norm[..., None])
        self.c = np.where(is_unit, self.c, c)

    def _find_interior(self) -> np.ndarray:
        """Return a point inside the constraints, (O,) or (N, O).

        Raises:
            InputError: If a step has no such point.
        """
        steps = (self.G, self.c) if self.G.ndim == 3 else (self.G[None], self.c[None])
        if ((self.G != 0.0).sum(axis=-1) <= 1).all():
            interior = _box_interior(*steps)
        else:
            flat = np.concatenate([steps[0].reshape(len(steps[0]), -1), steps[1]], axis=1)
            _, first, inverse = np.unique(flat, axis=0, return_index=True, return_inverse=True)
            points = {step: _max_margin_point(steps[0][step], steps[1][step]) for step in np.sort(first).tolist()}
            interior = np.array([points[step] for step in first[inverse.ravel()].tolist()])
        violation = steps[1] - np.einsum("nfo,no->nf", steps[0], interior)
        size = np.abs(steps[1]) + np.einsum("nfo,no->nf", np.abs(steps[0]), np.abs(interior))
        is_contradiction = ~(violation <= _ROUNDING * size).all(axis=1)
        if is_contradiction.any():
            where = "" if self.G.ndim == 2 else f" at step {int(np.argmax(is_contradiction))}"
            raise InputError(
                f"the constraints{where} contradict each other: no output satisfies all {self.num_constraints} of "
                "them; loosen c or remove a row of G"
            )
        return interior if self.G.ndim == 3 else interior[0]


def _box_interior(G: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return points (n, O) inside boxes: centers, or, without two finite bounds, the allowed value nearest to zero."""
    lower = np.where(G > 0.0, c[..., None], -np.inf).max(axis=1, initial=-np.inf)
    upper = np.where(G < 0.0, -c[..., None], np.inf).min(axis=1, initial=np.inf)
    is_bounded = np.isfinite(lower) & np.isfinite(upper)
    with np.errstate(invalid="ignore"):
        return np.where(is_bounded, 0.5 * lower + 0.5 * upper, np.clip(0.0, lower, upper))


def _max_margin_point(G: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return the point (O,) that maximizes the smallest margin G y − c, capped at max |c| (at 1 if c = 0)."""
    from scipy.optimize import linprog  # imported here because it takes half a second

    num_outputs = G.shape[1]
    size = float(np.abs(c).max(initial=0.0)) or 1.0
    result = linprog(
        np.append(np.zeros(num_outputs), -1.0),
        A_ub=np.column_stack([-G, (np.abs(G).max(axis=1) > 0.0).astype(float)]),
        b_ub=-c / size,
        bounds=[(None, None)] * num_outputs + [(None, 1.0)],
        # The smallest tolerances that HiGHS accepts.
        options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
    )
    if result.x is None:  # a row of zeros with a positive bound
        return np.zeros(num_outputs)
    best = np.asarray(size * result.x[:num_outputs])
    # The solver's point is accurate to its tolerance; the solution of its active constraints is accurate to rounding.
    active = np.flatnonzero(result.ineqlin.marginals < -1e-9)
    system = np.column_stack([G[active], -np.ones(len(active))])
    correction = np.linalg.lstsq(system, c[active] - G[active] @ best, rcond=None)[0][:num_outputs]
    return max((best, best + correction), key=lambda y: float((G @ y - c).min()))
