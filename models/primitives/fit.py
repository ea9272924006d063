"""Selection of mixture, length scale and regularization by leave-one-out cross-validation.

A kernel that is too wide cuts corners. A kernel that is too narrow does not smooth the motion. A regularization in the
wrong unit pulls the motion towards zero. All three increase the error of reproducing one demonstration from the others.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations
from guiderail.models.primitives.deviation import outputs_at, squared_distances
from guiderail.models.primitives.kernels import Kernel, SquaredExponential
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.mixture import information_criteria, thinned
from guiderail.models.primitives.reference import ReferenceTrajectory

MIN_DEMONSTRATIONS = 3
"""Smallest number of demonstrations for `fit`."""
MIN_SHARE = 0.95
"""Smallest share of steps within one standard deviation at which a motion follows the demonstrations."""
# Length scales to try, relative to the motion's duration, for motions from a single bend to details of a few steps.
_LENGTHS = (0.3, 0.2, 0.13, 0.09, 0.06, 0.04, 0.027, 0.018, 0.012, 0.008)
# Values of ħ = λ + β to try, for outputs of unit size.
_REGULARIZATIONS = (1.0, 0.1, 0.01)
_COMPONENTS = (3, 5, 8, 12, 18, 26, 36, 50)  # numbers of mixture components to try
_EVALUATED = 40  # number of steps at which candidates are compared
LONG = 400
"""Largest number of steps at which a mixture is fitted to all steps."""
# Number of evenly spaced steps, at least four for each component, to which the mixture of a long motion is fitted.
_MIXTURE_STEPS = 150


@dataclass(frozen=True)
class Candidate:
    """Kernel and regularization with their cross-validation error."""

    length_scale: float  # ℓ of the kernel [unit of the input]
    lambda_: float  # λ = β
    # RMS Mahalanobis distance between a left-out demonstration and its reproduction from the others, in standard
    # deviations of the demonstrations; infinite if `share` is below `MIN_SHARE` and below that of another candidate.
    error: float
    worse: float  # mean excess over the best candidate's squared error, in standard errors over the demonstrations
    share: float  # share of the steps at which the motion without actions is within one standard deviation of the mean


@dataclass(frozen=True)
class Selection:
    """Mixture, kernel and regularization that `fit` selected."""

    reference: ReferenceTrajectory  # reference of all demonstrations
    components: int  # number of components C of its mixture
    kernel: SquaredExponential
    lambda_: float  # λ = β
    share: float  # share of the steps at which the motion without actions is within one standard deviation of the mean
    criteria: dict[int, float]  # Bayesian information criterion by number of components
    candidates: tuple[Candidate, ...]  # all compared candidates
    why: str  # reason for the selection, in sentences

    @property
    def is_within_spread(self) -> bool:
        """True if the motion without actions follows the demonstrations (`share` is at least `MIN_SHARE`)."""
        return self.share >= MIN_SHARE

    def primitive(self, **arguments: Any) -> LcNsKmp:
        """Build the selected primitive; `arguments` of `LcNsKmp` complete or replace the selected ones."""
        selected = {"kernel": self.kernel, "lambda_": self.lambda_, "beta": self.lambda_}
        return LcNsKmp(self.reference, **{**selected, **arguments})


def fit(
    demonstrations: Demonstrations,
    *,
    components: int | None = None,
    horizon: int = 40,
    floor: float | np.ndarray = 0.0,
    log: Callable[[str], object] | None = None,
) -> Selection:
    """Select components, length scale and regularization by leave-one-out cross-validation.

    The selected number of components has the least Bayesian information criterion. Length scale and regularization are
    taken from a grid relative to the motion's duration and size. A candidate qualifies if its error is within a
    standard error of the best error and its motion without actions stays within the demonstrations' spread
    (`MIN_SHARE`). The strongest regularization that qualifies is selected, and for this regularization the widest
    kernel: the motion is as smooth as the demonstrations allow. If no candidate qualifies, the one with the largest
    `share` is selected.

    Args:
        demonstrations: At least three demonstrations.
        components: Number of components C; selected by default.
        horizon: Horizon H of the intended primitive [steps].
        floor: As in `ReferenceTrajectory.from_demonstrations`.
        log: Function that receives sentences on the progress.

    Raises:
        InputError: If there are fewer than three demonstrations, they cannot be fitted, or an argument is out of range.
    """
    if demonstrations.num_demonstrations < MIN_DEMONSTRATIONS:
        raise InputError(
            f"cross-validation needs at least three demonstrations, and there are {demonstrations.num_demonstrations}: "
            "record more"
        )
    resampled = demonstrations.resampled()
    times, outputs = resampled.times[0], np.stack(resampled.outputs)
    if len(times) < 4 * _COMPONENTS[0]:
        raise InputError(f"a mixture needs at least {4 * _COMPONENTS[0]} steps, not {len(times)}")
    mixture_steps = max(_MIXTURE_STEPS, 4 * (components or 0)) if len(times) > LONG else None
    at, say = thinned(len(times), mixture_steps), log or (lambda sentence: None)
    counts = [components] if components is not None else [c for c in _COMPONENTS if c <= len(at) // 4]
    say(f"fitting mixtures of {', '.join(map(str, counts))} components to {len(at)} of {len(times)} steps")
    criteria = information_criteria(times[at], outputs[:, at], counts, seed=0)
    components = min(criteria, key=lambda count: criteria[count])

    def fitted(recorded: Demonstrations) -> ReferenceTrajectory:
        return ReferenceTrajectory.from_demonstrations(recorded, components, floor=floor, mixture_steps=mixture_steps)

    reference, folds = fitted(resampled), []
    for m in range(len(outputs)):
        say(f"leaving out demonstration {m + 1} of {len(outputs)}, with {components} components")
        folds.append(fitted(Demonstrations(times, np.delete(outputs, m, axis=0))))
    say("comparing kernels and regularizations")
    candidates = _validate(reference, folds, outputs, horizon, _grid(resampled))
    selected = _select(candidates)
    kernel, lambda_ = SquaredExponential(selected.length_scale), selected.lambda_
    share = share_within_spread(reference, kernel, lambda_, lambda_, horizon, evaluated=LONG)
    thinning = ""
    if len(at) < len(times):
        thinning = f" The mixture was fitted to {len(at)} evenly spaced steps of {len(times)}."
    why = _explain(components, criteria, selected, candidates, share, times) + thinning
    return Selection(reference, components, kernel, lambda_, share, criteria, candidates, why)


def share_within_spread(
    reference: ReferenceTrajectory,
    kernel: Kernel,
    lambda_: float,
    beta: float,
    horizon: int = 40,
    evaluated: int = _EVALUATED,
) -> float:
    """Compute the share of steps at which the motion without actions is within one standard deviation of the mean.

    One standard deviation is the ellipsoid of the reference's covariance. If the share is below `MIN_SHARE`, the kernel
    is too wide for the demonstrations or the regularization is too strong; `fit` selects both. The arguments are those
    of `LcNsKmp` without a history, and the largest number of evaluated steps, which are evenly spaced.
    """
    steps = thinned(reference.num_steps, evaluated)
    parts = np.array_split(steps, -(-len(steps) // _EVALUATED))  # the matrices of all steps may need 200 MB
    motion = np.concatenate([outputs_at(reference, kernel, lambda_ + beta, horizon, part) for part in parts])
    return float(_within(reference, motion, steps).mean())


def _within(reference: ReferenceTrajectory, motion: np.ndarray, steps: np.ndarray) -> np.ndarray:
    return squared_distances(reference.covariances[steps], motion - reference.means[steps]) <= 1.0


def _grid(resampled: Demonstrations) -> list[tuple[float, float]]:
    """Return length scales and ħ to try, relative to the motion's duration and size."""
    duration = float(resampled.times[0][-1] - resampled.times[0][0])
    size = float(np.sqrt((np.stack(resampled.outputs) ** 2).mean(axis=(0, 1)).max())) or 1.0
    return [(length * duration, hbar / size**2) for length in _LENGTHS for hbar in _REGULARIZATIONS]


def _validate(
    reference: ReferenceTrajectory,
    folds: Sequence[ReferenceTrajectory],
    outputs: np.ndarray,
    horizon: int,
    grid: Sequence[tuple[float, float]],
) -> tuple[Candidate, ...]:
    """Return the candidates of a grid with their errors (see `Candidate`)."""
    steps = np.unique(np.linspace(0, reference.num_steps - 1, _EVALUATED).astype(int))
    kernels = [SquaredExponential(length_scale) for length_scale, _ in grid]
    motions = [outputs_at(reference, k, hbar, horizon, steps) for k, (_, hbar) in zip(kernels, grid, strict=True)]
    shares = np.array([_within(reference, motion, steps).mean() for motion in motions])
    is_within = shares >= min(MIN_SHARE, shares.max())
    errors = np.full((len(grid), len(folds)), np.inf)
    for i in np.flatnonzero(is_within).tolist():
        for m, fold in enumerate(folds):
            motion = outputs_at(fold, kernels[i], grid[i][1], horizon, steps)
            errors[i, m] = squared_distances(reference.covariances[steps], outputs[m, steps] - motion).mean()
    worse = np.full(len(grid), np.inf)
    excess = errors[is_within] - errors[int(np.argmin(errors.mean(axis=1)))]
    standard_error = excess.std(axis=1, ddof=1) / np.sqrt(len(folds))
    worse[is_within] = np.divide(
        excess.mean(axis=1), standard_error, out=np.zeros(len(excess)), where=standard_error > 0
    )
    rms = np.sqrt(errors.mean(axis=1) / outputs.shape[-1])
    return tuple(
        Candidate(length_scale, hbar / 2, float(rms[i]), float(worse[i]), float(shares[i]))
        for i, (length_scale, hbar) in enumerate(grid)
    )


def _select(candidates: Sequence[Candidate]) -> Candidate:
    """Select a candidate as described in `fit`."""
    qualified = [c for c in candidates if c.worse <= 1.0 and c.share >= MIN_SHARE]
    if qualified:
        return max(qualified, key=lambda c: (c.lambda_, c.length_scale))
    return max(candidates, key=lambda c: (c.share, -c.error))


def _explain(
    components: int,
    criteria: dict[int, float],
    selected: Candidate,
    candidates: Sequence[Candidate],
    share: float,
    times: np.ndarray,
) -> str:
    length = selected.length_scale
    best = min(candidate.error for candidate in candidates)
    tried = "have the least information criterion of the {} numbers tried" if len(criteria) > 1 else "are fixed"
    text = (
        f"{components} components {tried.format(len(criteria))}. "
        f"A kernel of length scale {length:.3g}, {length / (times[-1] - times[0]):.1%} of the motion, with "
        f"λ = β = {selected.lambda_:.3g} reproduces left-out demonstrations to {selected.error:.3g} standard "
        f"deviations; the best of {len(candidates)} candidates to {best:.3g}. Without actions {share:.1%} of the steps "
        "are within one standard deviation of the mean"
    )
    if share >= MIN_SHARE:
        return text + ": no smoother candidate is as good."
    return text + f", less than {MIN_SHARE:.0%}: record more demonstrations, or some whose timing differs less."
