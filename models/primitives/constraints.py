"""Linear inequality constraints g_{n,f}ᵀ ζ^O ≥ c_{n,f} on the output of a primitive (thesis, equation 4.5)."""

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.qp import UnsolvableError, solve_least_norm

TOLERANCE = 1e-9
"""Largest accepted violation of a command, in the unit of a constraint's c (1 nm if that is meters)."""


class LinearConstraints:
    """Constraints G y ≥ c, the same at every step or different from step to step.

    Args:
        G: Rows g_f, (F, O) or (N, F, O), finite [unit of c / unit of the output].
        c: Lower bounds, (F,) or (N, F), finite.

    Raises:
        InputError: If shapes do not match, a number is not finite, or no output satisfies all constraints of a step.

    Attributes:
        G, c: Copies of the arguments, read-only.
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
        self._refuse_contradictions()
        for values in (self.G, self.c):
            values.setflags(write=False)  # primitives of a process share it

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike) -> "LinearConstraints":
        """Return the constraints lower ≤ y ≤ upper.

        Args:
            lower: Lower bounds, (O,) or (N, O); −inf at every step is no constraint.
            upper: Upper bounds, (O,) or (N, O); inf at every step is no constraint.

        Raises:
            InputError: If a lower bound exceeds its upper bound, or a bound is NaN or infinite at some steps only.
        """
        lower, upper = as_numbers(lower, "a lower bound"), as_numbers(upper, "an upper bound")
        try:
            lower, upper = np.broadcast_arrays(lower, upper)
        except ValueError as error:
            raise InputError(f"box bounds must have the same shape, not {lower.shape} and {upper.shape}") from error
        if lower.ndim not in (1, 2) or np.isnan(lower).any() or np.isnan(upper).any():
            raise InputError(f"box bounds must be numbers of shape (O,) or (N, O), not of shape {lower.shape}")
        if (lower > upper).any():
            where = f" at step {np.argwhere(lower > upper)[0, 0]}" if lower.ndim == 2 else ""
            raise InputError(
                f"the constraints{where} contradict each other: a lower bound exceeds its upper bound; loosen one"
            )
        num_outputs = lower.shape[-1]
        rows, bounds = [], []
        for o in range(num_outputs):
            for sign, bound in ((1.0, lower[..., o]), (-1.0, -upper[..., o])):
                if np.all(bound == -np.inf):
                    continue
                rows.append(sign * np.eye(num_outputs)[o])
                bounds.append(bound)
        G = np.reshape(rows, (len(rows), num_outputs))
        if lower.ndim == 1:
            return cls(G, np.reshape(bounds, len(rows)))
        steps = lower.shape[0]
        return cls(np.broadcast_to(G, (steps, *G.shape)), np.reshape(bounds, (len(rows), steps)).T)

    @classmethod
    def none(cls, num_outputs: int) -> "LinearConstraints":
        """Return constraints with F = 0."""
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

    def window(self, steps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return G (n, F, O) and c (n, F) at steps (n,); a step past the end has the constraints of the last one."""
        steps = np.asarray(steps)
        if self.G.ndim == 2:
            G, c = (np.broadcast_to(values, (len(steps), *values.shape)) for values in (self.G, self.c))
            return G, c
        steps = np.minimum(steps, self.G.shape[0] - 1)
        return self.G[steps], self.c[steps]

    def violation(self, output: np.ndarray, step: int = 0) -> float:
        """Compute the maximum over the constraints of c − G y [unit of c].

        Args:
            output: y (O,).
            step: Step of the constraints.

        Returns:
            The violation; a negative one is slack, and −inf is returned without constraints.
        """
        if self.num_constraints == 0:
            return -np.inf
        if self.G.ndim == 2:
            return float((self.c - self.G @ output).max())
        step = min(step, self.G.shape[0] - 1)
        return float((self.c[step] - self.G[step] @ output).max())

    def nearest(self, output: np.ndarray, step: int = 0) -> np.ndarray:
        """Compute the output (O,) within the constraints of a step that is nearest to `output` (O,).

        Raises:
            UnsolvableError: If the solver does not find it.
        """
        output = np.asarray(output, dtype=float)
        if self.violation(output, step) <= 0:
            return output.copy()
        G, c = (a[0] for a in self.window(np.array([step])))
        scale = 1 / np.where(np.linalg.norm(G, axis=1) > 0, np.linalg.norm(G, axis=1), 1)
        move, _ = solve_least_norm(G * scale[:, None], (c - G @ output) * scale, np.full(len(c), np.inf))
        nearest = output + move
        if not self.violation(nearest, step) <= TOLERANCE:
            raise UnsolvableError(f"the nearest output violates a constraint by {self.violation(nearest, step):.1e}")
        return nearest

    def _refuse_contradictions(self) -> None:
        if self.num_constraints == 0:
            return
        from scipy.optimize import linprog  # takes half a second, and reading a file does not need it

        G = self.G.reshape(-1, *self.G.shape[-2:])
        c = self.c.reshape(-1, self.c.shape[-1])
        flat = np.concatenate([G.reshape(len(G), -1), c], axis=1)
        for step in np.sort(np.unique(flat, axis=0, return_index=True)[1]):
            # Rows are scaled to unit length, so that the solver's tolerance is a tolerance on the output itself.
            size = np.linalg.norm(G[step], axis=1)
            scale = np.where(size > 0, size, 1.0)
            result = linprog(
                np.zeros(self.num_outputs),
                A_ub=-G[step] / scale[:, None],
                b_ub=-c[step] / scale,
                bounds=(None, None),
                # The smallest tolerances that HiGHS accepts.
                options={"primal_feasibility_tolerance": 1e-10, "dual_feasibility_tolerance": 1e-10},
            )
            if result.status == 2:
                where = "" if self.G.ndim == 2 else f" at step {step}"
                raise InputError(
                    f"the constraints{where} contradict each other: no output satisfies all {self.num_constraints} of "
                    "them; loosen c or remove a row of G"
                )
