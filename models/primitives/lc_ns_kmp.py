"""Linearly constrained null-space kernelized movement primitives, LC-NS-KMP (thesis, sections 4.3 and 5.3).

A prediction solves problem 4.5 for a window of the P last outputs (the history) and the H+1 next reference points. The
solution follows the demonstrations as closely as their covariance requires, and passes through the history. A
null-space action displaces it at the executed point. It satisfies the linear constraints at every future point. Special
cases are NS-KMP without constraints (equation 4.4), LC-KMP with β = 0 (4.2), KMP without constraints and with β = 0
(2.17), and the primitive of sKGRL with a history (5.1 to 5.3).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import ArrayLike

from guiderail.models.common.arrays import as_doubles, as_numbers, as_whole
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.files import digest
from guiderail.models.primitives.constraints import TOLERANCE, LinearConstraints
from guiderail.models.primitives.deviation import MAX_DEVIATION, check_constraints, check_deviation
from guiderail.models.primitives.kernels import Kernel, SquaredExponential, check_kernel
from guiderail.models.primitives.qp import UnsolvableError
from guiderail.models.primitives.reference import ReferenceTrajectory
from guiderail.models.primitives.window import (
    Modification,
    Prediction,
    StepFactor,
    Window,
    WindowFeatures,
    window_features,
    window_interpolation,
)

HISTORY, HORIZON = 10, 40
"""Default numbers of past outputs P of sKGRL, and of future points H with constraints."""
_CACHE_BYTES = 2**29  # memory limit of a primitive's factored steps [bytes]; above it, those factored first are dropped


class LcNsKmp:
    """Movement primitive that follows demonstrations, null-space actions and linear constraints.

    The kernel's input is the reference's time, so every matrix depends on the step alone. Each step is factored at its
    first use. A prediction takes two small matrix products; a QP is solved only if the result violates a constraint.

    Args:
        reference: Means and covariances of the demonstrations, N steps of O outputs.
        kernel: Kernel k; the thesis's `SquaredExponential(length_scale=0.5)` by default.
        lambda_: Regularization λ of problem 4.5, not negative.
        beta: Weight β of a null-space action, not negative; λ + β is positive.
        horizon: Number of future points H after the executed one.
        history: Number of past outputs P that the motion passes through (sKGRL); 0 for none (KGRL).
        history_variance: Variance ρ of the past outputs [output²], positive.
        constraints: Constraints G y ≥ c at every future point; none by default.
        max_deviation: Largest accepted `deviation` of a motion that is not within `MAX_MISS` (`check_deviation`).

    Raises:
        InputError: If an argument is out of range, or the history's variance is too small for its length; also as
            `check_kernel`, `check_deviation` and `check_constraints`.

    Warns:
        UserWarning: If `deviation` exceeds one.

    Attributes:
        reference, kernel, lambda_, beta, horizon, history, history_variance, constraints: Arguments.
        deviation: RMS distance of the motion without actions from the reference mean [standard deviations].
        cached_bytes: Memory of the factored steps [bytes].
    """

    def __init__(
        self,
        reference: ReferenceTrajectory,
        kernel: Kernel | None = None,
        lambda_: float = 6.0,
        beta: float = 6.0,
        horizon: int = HORIZON,
        history: int = 0,
        history_variance: float = 1e-6,
        constraints: LinearConstraints | None = None,
        max_deviation: float = MAX_DEVIATION,
    ):
        for name, value in (("lambda_", lambda_), ("beta", beta)):
            if not 0.0 <= value < math.inf:
                raise InputError(f"{name} must be finite and not negative, not {value}")
        if not lambda_ + beta > 0:
            raise InputError("lambda_ + beta must be positive: without any regularization problem 4.5 has no solution")
        if history and not 0.0 < history_variance < math.inf:
            raise InputError(f"history_variance must be positive, not {history_variance}")
        self.kernel: Kernel = kernel if kernel is not None else SquaredExponential()
        check_kernel(self.kernel, reference.inputs(np.arange(-history, reference.num_steps + min(horizon, 10**6))))
        constraints = constraints if constraints is not None else LinearConstraints.none(reference.num_outputs)
        constraints.check_sizes(reference.num_outputs, reference.num_steps)
        check_constraints(reference, constraints, max_deviation)
        self.reference = reference
        self.lambda_, self.beta = float(lambda_), float(beta)
        self.horizon, self.history, self.history_variance = int(horizon), int(history), float(history_variance)
        self.constraints = constraints
        self._cache: OrderedDict[int, StepFactor] = OrderedDict()
        self.cached_bytes = 0
        self._shared_features: WindowFeatures | None = None
        self._whole: StepFactor | None = None
        self._history_shape = (self.history, reference.num_outputs)
        self._no_action = np.zeros(self.num_outputs)
        if self.history:
            self._features(0)  # raises an InputError if the history's variance is too small
        self.deviation = check_deviation(reference, self.kernel, self.lambda_, self.beta, self.horizon, max_deviation)

    @property
    def num_outputs(self) -> int:
        """Number of outputs O."""
        return self.reference.num_outputs

    @property
    def num_steps(self) -> int:
        """Number of steps N; later steps are equal to step N−1: the motion stays at its end."""
        return self.reference.num_steps

    def predict(
        self, step: int, null_space_action: np.ndarray | None = None, history: np.ndarray | None = None
    ) -> Prediction:
        """Compute the output at a step (equations 4.21 and 5.1).

        Args:
            step: Step n ≥ 0; past the end, the last step.
            null_space_action: ξ̂ (O,), the policy's action times a gain (see the module `gains`); zero by default.
            history: Outputs at step−P … step−1, oldest first, (P, O); None if P = 0.

        Raises:
            InputError: If the history has the wrong shape, an argument is not finite, or the step is negative or not
                whole.
            UnsolvableError: If no window within the constraints was found. Repeat the last safe command.
        """
        factor = (self._cache.get(step) if type(step) is int else None) or self._factor(step)
        return self._finish(factor, self._stack(null_space_action, history))

    def predict_window(
        self,
        step: int,
        means: ArrayLike,
        covariances: ArrayLike,
        null_space_action: np.ndarray | None = None,
        history: np.ndarray | None = None,
    ) -> Prediction:
        """Compute the output at a step from a given window, such as that of a reference system; nothing is cached.

        Args:
            step: As in `predict`; it selects the constraints and the times of the window.
            means: Reference means of the window (H+1, O), the executed point first.
            covariances: Reference covariances of the window (H+1, O, O), positive definite.
            null_space_action: ξ̂ (O,), as in `predict`.
            history: (P, O), as in `predict`.

        Raises:
            InputError: As `predict`; also if a covariance is not symmetric and positive definite.
            UnsolvableError: As `predict`.
        """
        step = self._checked_step(step)
        window = Window.checked(means, covariances, *self.constraints.window(self._window_steps(step, self.horizon)))
        factor = StepFactor(window, self._features(step), self.lambda_, self.beta)
        return self._finish(factor, self._stack(null_space_action, history))

    def _finish(self, factor: StepFactor, x: np.ndarray) -> Prediction:
        """Return the prediction of a factored window, corrected if it violates a constraint."""
        output = factor.output_map @ x
        output += factor.output_offset
        free = factor.constraint_map @ x
        if (free >= factor.lower).all() and (free <= factor.upper).all():
            return Prediction(output, factor, x)
        v, signed = factor.correct(free)
        output += factor.correction_map @ v
        violation = factor.violation(output)
        if not violation <= TOLERANCE:
            raise UnsolvableError(f"the solver left a violation of {violation:.1e}")
        return Prediction(output, factor, x, v, signed)

    def modified_trajectory(
        self, at: ArrayLike, null_space_actions: ArrayLike, history: np.ndarray | None = None
    ) -> Modification:
        """Compute the whole motion under null-space actions at several of its points (equations 4.17 and 4.18).

        Problem 4.5 is solved once, over all N steps, whereas `predict` solves it for each window. The result is smooth
        over the whole motion and within the constraints at every step. Between the steps of the actions, the action is
        interpolated by the function of smallest norm in the kernel's Hilbert space. The problem is factored at the
        first call.

        Args:
            at: Different steps (J,) from 0 … N−1, in any order; none for the motion without actions.
            null_space_actions: ξ̂ (J, O), one for each of these steps.
            history: Outputs before the first step, (P, O); None if P = 0.

        Raises:
            InputError: As `predict`; also if a step in `at` is outside of the motion, or the steps are so close to each
                other, or equal, that their kernel matrix is singular.
            UnsolvableError: If no motion within the constraints was found.
        """
        last, x = self.num_steps - 1, self._stack(None, history)
        points = as_numbers(at, "the steps of null-space actions")
        if points.ndim != 1 or not np.isin(points, np.arange(last + 1)).all():
            raise InputError(f"null-space actions must be at steps among 0 … {last}: {brief(at)}")
        actions = as_numbers(null_space_actions, "null-space actions").reshape(len(points), self.num_outputs)
        if not np.isfinite(actions).all():
            raise InputError("null-space actions must be finite")
        past, future = self._inputs(0, last)
        if self._whole is None:
            features = window_features(self.kernel, past, future, self._history_noise)
            self._whole = StepFactor(self._window(0, last), features, self.lambda_, self.beta)
        factor, noise = self._whole, self._history_noise
        action = window_interpolation(self.kernel, past, future, noise, points.astype(int)) @ actions
        trajectory, signed = factor.modified(x, action)
        violation = factor.max_violation(trajectory)
        if not violation <= TOLERANCE:
            raise UnsolvableError(f"the solver left a violation of {violation:.1e}")
        alpha = np.zeros(factor.multipliers_shape) if signed is None else factor.multipliers(signed)
        return Modification(trajectory, alpha)

    def linear_response(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return R_h (O, PO), N (O, O) and r (O,) of a step's unconstrained output R_h h + N ξ̂ + r."""
        factor = self._factor(step)
        split = self.history * self.num_outputs
        return factor.output_map[:, :split], factor.output_map[:, split:], factor.output_offset

    def free_constraints(self, step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the map (m, PO+O) from [history, ξ̂] to the constrained directions, and their lower and upper bounds.

        A window needs no correction if its directions are within their bounds (m,).
        """
        factor = self._factor(step)
        return factor.constraint_map, factor.lower, factor.upper

    def output_sizes(self, step: int) -> np.ndarray:
        """Return the largest displacement (O,) of a step's output by a correction of norm one."""
        return self._factor(step).output_sizes()

    def _stack(self, null_space_action: np.ndarray | None, history: np.ndarray | None) -> np.ndarray:
        """Check the arguments and return x = [history, null-space action]."""
        action = self._no_action if null_space_action is None else as_doubles(null_space_action, "a null-space action")
        if self.history == 0:
            if history is not None and np.size(history):
                raise InputError("this primitive has no history (P = 0): pass None")
            x = action.copy()  # copied, because a `Prediction` keeps x
        else:
            past = as_doubles(history, "the history") if history is not None else np.zeros(0)
            if past.shape != self._history_shape:
                raise InputError(f"the history has shape {self._history_shape}, oldest output first, not {past.shape}")
            x = np.concatenate((past.ravel(), action))
        # One reduction instead of isfinite().all(): the product is not finite if x has NaN, infinity or large numbers.
        if not math.isfinite(x.dot(x)):
            raise InputError("history and null-space action must be finite, also when squared")
        return x

    def _checked_step(self, step: int) -> int:
        """Return a step, clipped to the last one; raise an InputError unless it is a whole number of at least 0."""
        if (number := step if type(step) is int else as_whole(step, "a step")) < 0:
            raise InputError(f"step counts from 0, not {step}")
        return min(number, self.num_steps - 1)

    def _factor(self, step: int) -> StepFactor:
        step = self._checked_step(step)
        factor = self._cache.get(step)
        if factor is None:
            factor = StepFactor(self._window(step, self.horizon), self._features(step), self.lambda_, self.beta)
            factor.factor_corrections()
            self._cache[step] = factor
            self.cached_bytes += factor.nbytes
            while self.cached_bytes > _CACHE_BYTES and len(self._cache) > 1:
                _, oldest = self._cache.popitem(last=False)
                self.cached_bytes -= oldest.nbytes
        return factor

    @property
    def _history_noise(self) -> float:
        """Weight ħρ of the history's covariance relative to the kernel."""
        return (self.lambda_ + self.beta) * self.history_variance

    def _window(self, step: int, horizon: int) -> Window:
        steps = self._window_steps(step, horizon)
        G, c = self.constraints.window(steps)
        return Window(self.reference.means[steps], self.reference.covariances[steps], G, c)

    def _window_steps(self, step: int, horizon: int) -> np.ndarray:
        """Return the steps of a window (horizon+1,), clipped to the last one."""
        return np.minimum(np.arange(step, step + horizon + 1), self.num_steps - 1)

    def _inputs(self, step: int, horizon: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the times of the history (P,), and of the executed point and the horizon (horizon+1,)."""
        past = self.reference.inputs(np.arange(step - self.history, step))
        return past, self.reference.inputs(np.arange(step, step + horizon + 1))

    def _features(self, step: int) -> WindowFeatures:
        if self._shared_features is not None:
            return self._shared_features
        can_share = self.kernel.stationary and self.reference.uniform
        # Shared features are always computed at step 0, so that results do not depend on the order of calls.
        past, future = self._inputs(0 if can_share else step, self.horizon)
        features = window_features(self.kernel, past, future, self._history_noise)
        if can_share:
            self._shared_features = features
        return features


# Weak references: an unused primitive releases its factored steps, which take megabytes.
_SHARED: WeakValueDictionary[tuple[Any, ...], LcNsKmp] = WeakValueDictionary()


def get_shared_primitive(
    reference: ReferenceTrajectory, constraints: LinearConstraints, kernel: Kernel, **arguments: Any
) -> LcNsKmp:
    """Return the existing primitive with these arguments if there is one, otherwise a new one.

    Primitives can be shared, because their factored steps do not change results. The caller must not modify the
    primitive.

    Args:
        reference: As in `LcNsKmp`.
        constraints: As in `LcNsKmp`.
        kernel: As in `LcNsKmp`; kernels that compare equal share a primitive.
        arguments: Further arguments of `LcNsKmp`, numbers or strings.
    """
    arrays = {name: getattr(reference, name) for name in ("times", "means", "covariances")}
    arrays |= {"G": constraints.G, "c": constraints.c}
    key = (digest(arrays, ""), kernel, *sorted(arguments.items()))
    primitive = _SHARED.get(key)
    if primitive is None:
        primitive = LcNsKmp(reference, kernel=kernel, constraints=constraints, **arguments)
        _SHARED[key] = primitive
    return primitive
