"""Mixture, kernel and regularization that fit what was shown, with nothing set by hand.

A kernel that is too wide cuts corners, one that is too narrow forgets that a motion is smooth, and a regularization in
the wrong unit pulls everything towards zero. All three show where one demonstration is left out and reproduced from the
others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.primitives.demonstrations import Demonstrations
from guiderail.models.primitives.kernels import DEFAULT_KERNEL, Kernel, make_kernel
from guiderail.models.primitives.lc_ns_kmp import LcNsKmp
from guiderail.models.primitives.mixture import fit_mixture, information_criteria, regress
from guiderail.models.primitives.reference import ReferenceTrajectory

#: What counts as staying with the demonstrations: this share of the steps within one standard deviation.
ENOUGH = 0.95
# Of the motion's duration: from a third of it, which knows one bend, to a few steps.
_LENGTHS = (0.3, 0.2, 0.13, 0.09, 0.06, 0.04, 0.027, 0.018, 0.012, 0.008)
# The outputs' own size in the prior's standard deviations is the square root of these.
_REGULARIZATIONS = (1.0, 0.1, 0.01)
_COMPONENTS = (3, 5, 8, 12, 18, 26, 36, 50)
_EVALUATED = 40  # steps at which a candidate is compared


@dataclass(frozen=True)
class Candidate:
    """One kernel and regularization that were tried.

    Attributes:
        length_scale: ℓ of the kernel [input].
        lambda_: λ = β.
        error: RMS distance between left-out demonstrations and what the others reproduce, in standard deviations of
            the demonstrations, correlations counted; infinite where the motion leaves all of them anyway.
        worse: how much worse than the best that is, in standard errors over the demonstrations.
        share: of the steps at which the motion without actions is within one standard deviation of the mean.
    """

    length_scale: float
    lambda_: float
    error: float
    worse: float
    share: float


@dataclass(frozen=True)
class Selection:
    """What was chosen, and why.

    Attributes:
        reference: of all demonstrations.
        components: C of its mixture.
        kernel: with this λ the widest that reproduces the demonstrations as well as any.
        length_scale: ℓ of the kernel [input].
        lambda_, beta: λ and β, the same; the strongest that does.
        share: of the steps at which the motion without actions is within one standard deviation of the mean.
        criteria: Bayesian information criterion of each number of components that was tried.
        candidates: every kernel and regularization that was tried.
        why: the choice in a few sentences.
    """

    reference: ReferenceTrajectory
    components: int
    kernel: Kernel
    length_scale: float
    lambda_: float
    beta: float
    share: float
    criteria: dict[int, float]
    candidates: tuple[Candidate, ...]
    why: str

    @property
    def stays(self) -> bool:
        """True if the motion without actions stays with the demonstrations."""
        return self.share >= ENOUGH

    def primitive(self, **arguments: Any) -> LcNsKmp:
        """A primitive with what was chosen; `arguments` are the others of `LcNsKmp`, or replace what was chosen."""
        chosen = {"kernel": self.kernel, "lambda_": self.lambda_, "beta": self.beta}
        return LcNsKmp(self.reference, **{**chosen, **arguments})


def fit(
    demonstrations: Demonstrations,
    *,
    components: int | None = None,
    kernel: str = DEFAULT_KERNEL,
    length_scale: float | None = None,
    kernel_parameters: Mapping[str, float] | None = None,
    lambda_: float | None = None,
    horizon: int = 40,
    num_steps: int | None = None,
    floor: float | np.ndarray = 0.0,
    seed: int = 0,
) -> Selection:
    """Chooses components, kernel and regularization by what reproduces a demonstration that was left out.

    The number of components is the one of least Bayesian information criterion. Kernel and regularization are tried on
    a grid, relative to the motion's duration and size: of those that reproduce left-out demonstrations as well as the
    best one does, within a standard error, and that stay within the demonstrations' spread without actions, the
    strongest regularization is taken, and with it the widest kernel: as smooth as the demonstrations allow.

    Args:
        demonstrations: at least three.
        components, length_scale, lambda_: what is given is taken as it is, and the rest chosen for it.
        kernel, kernel_parameters: as in `make_kernel`.
        horizon: H of the primitive that is meant.
        num_steps, floor, seed: as in `ReferenceTrajectory.from_demonstrations`.

    Raises:
        InputError: if there are fewer than three demonstrations, or they can't be fitted.
    """
    if demonstrations.num_demonstrations < 3:
        raise InputError(
            f"leaving one of {demonstrations.num_demonstrations} demonstrations out says nothing: show at least three"
        )
    shown = demonstrations.resampled(num_steps)
    if len(shown.times[0]) < 4 * _COMPONENTS[0]:
        raise InputError(f"a mixture needs at least {4 * _COMPONENTS[0]} steps, not {len(shown.times[0])}")
    times, outputs = shown.times[0], np.stack(shown.outputs)
    tried = [components] if components is not None else [c for c in _COMPONENTS if c <= len(times) // 4]
    criteria = information_criteria(times, outputs, tried, seed)
    components = min(criteria, key=lambda count: criteria[count])

    reference = ReferenceTrajectory.from_demonstrations(shown, components, seed, floor=floor)
    without = [_reference(times, np.delete(outputs, m, axis=0), components, seed, floor) for m in range(len(outputs))]
    make = partial(make_kernel, kernel, parameters=kernel_parameters)
    candidates = _tried(reference, without, outputs, horizon, _grid(shown, length_scale, lambda_), make)
    chosen = _chosen(candidates)
    length_scale = chosen.length_scale
    primitive = LcNsKmp(reference, make(length_scale), chosen.lambda_, chosen.lambda_, horizon)
    share = share_within_spread(primitive)
    why = _why(components, criteria, chosen, candidates, share, times)
    return Selection(
        reference=reference,
        components=components,
        kernel=primitive.kernel,
        length_scale=length_scale,
        lambda_=chosen.lambda_,
        beta=chosen.lambda_,
        share=share,
        criteria=criteria,
        candidates=candidates,
        why=why,
    )


def share_within_spread(primitive: LcNsKmp) -> float:
    """The share of steps at which the motion without actions is within one standard deviation of the mean.

    Correlations count: one standard deviation is the ellipsoid of the reference's covariance. With a history, the
    motion is the one that its own commands lead to, from the first mean on. Below 0.95, the kernel is too wide for what
    was shown or the regularization too strong: `fit` chooses both.
    """
    return float(_within(primitive.reference, motion_without_actions(primitive), slice(None)).mean())


def estimated_share(
    reference: ReferenceTrajectory, kernel: Kernel, lambda_: float, beta: float, horizon: int = 40
) -> float:
    """About what `share_within_spread` is of a primitive without a history, from forty of its steps.

    Args:
        reference: of the primitive.
        kernel, lambda_, beta, horizon: as in `LcNsKmp`.
    """
    steps = np.unique(np.linspace(0, reference.num_steps - 1, _EVALUATED).astype(int))
    motion = _motion(reference, kernel, lambda_ + beta, horizon, steps)
    return float(_within(reference, motion, steps).mean())


def motion_without_actions(primitive: LcNsKmp) -> np.ndarray:
    """(N, O): what a primitive commands step by step if nobody acts, from the first mean on."""
    reference = primitive.reference
    past = np.tile(reference.means[0], (primitive.history, 1))
    motion = np.zeros_like(reference.means)
    for step in range(reference.num_steps):
        motion[step] = primitive.predict(step, None, past if primitive.history else None).output
        if primitive.history:
            past = np.vstack([past[1:], motion[step]])
    return motion


def _reference(
    times: np.ndarray, outputs: np.ndarray, components: int, seed: int, floor: float | np.ndarray
) -> ReferenceTrajectory:
    """The reference of a part of the demonstrations, which is only compared."""
    means, covariances = regress(fit_mixture(times, outputs, components, seed), times)
    return ReferenceTrajectory(times, means, covariances + np.diag(np.broadcast_to(floor, means.shape[1:]) ** 2))


def _within(reference: ReferenceTrajectory, motion: np.ndarray, steps: Any) -> np.ndarray:
    error = motion - reference.means[steps]
    return _squared(reference.covariances[steps], error) <= 1.0


def _squared(covariances: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Squared Mahalanobis distance (…, n) of errors (…, n, O)."""
    whiten = np.linalg.inv(np.linalg.cholesky(covariances))
    return (np.einsum("nij,...nj->...ni", whiten, error) ** 2).sum(axis=-1)


def _grid(shown: Demonstrations, length_scale: float | None, lambda_: float | None) -> list[tuple[float, float]]:
    """Kernels and ħ to try, in the motion's own duration and size, or what was given."""
    duration = float(shown.times[0][-1] - shown.times[0][0])
    size = float(np.sqrt((np.stack(shown.outputs) ** 2).mean(axis=(0, 1)).max())) or 1.0
    lengths = [length * duration for length in _LENGTHS] if length_scale is None else [length_scale]
    strengths = [hbar / size**2 for hbar in _REGULARIZATIONS] if lambda_ is None else [2.0 * lambda_]
    return [(length, hbar) for length in lengths for hbar in strengths]


def _tried(
    reference: ReferenceTrajectory,
    without: Sequence[ReferenceTrajectory],
    outputs: np.ndarray,
    horizon: int,
    grid: Sequence[tuple[float, float]],
    make: Callable[[float], Kernel],
) -> tuple[Candidate, ...]:
    """Every kernel and regularization, with how well it reproduces what was left out.

    One whose motion leaves the spread of all demonstrations is not asked what it does without one of them.
    """
    steps = np.unique(np.linspace(0, reference.num_steps - 1, _EVALUATED).astype(int))
    kernels = [make(length_scale) for length_scale, _ in grid]
    motions = [_motion(reference, k, hbar, horizon, steps) for k, (_, hbar) in zip(kernels, grid, strict=True)]
    shares = np.array([_within(reference, motion, steps).mean() for motion in motions])
    asked = shares >= min(ENOUGH, shares.max())
    errors = np.full((len(grid), len(without)), np.inf)
    for i in np.flatnonzero(asked).tolist():
        for m, part in enumerate(without):
            motion = _motion(part, kernels[i], grid[i][1], horizon, steps)
            errors[i, m] = _squared(reference.covariances[steps], outputs[m, steps] - motion).mean()
    worse = np.full(len(grid), np.inf)
    behind = errors[asked] - errors[int(np.argmin(errors.mean(axis=1)))]
    standard_error = behind.std(axis=1, ddof=1) / np.sqrt(len(without))
    worse[asked] = np.divide(behind.mean(axis=1), standard_error, out=np.zeros(len(behind)), where=standard_error > 0)
    rms = np.sqrt(errors.mean(axis=1) / outputs.shape[-1])
    return tuple(
        Candidate(length_scale, hbar / 2, float(rms[i]), float(worse[i]), float(shares[i]))
        for i, (length_scale, hbar) in enumerate(grid)
    )


def _motion(reference: ReferenceTrajectory, kernel: Kernel, hbar: float, horizon: int, steps: np.ndarray) -> np.ndarray:
    """(n, O): k* (K + ħΣ)⁻¹ μ of the windows at `steps`, all at once and in plain doubles."""
    outputs = reference.num_outputs
    window = np.minimum(steps[:, None] + np.arange(horizon + 1), reference.num_steps - 1)
    clock = reference.inputs(np.arange(horizon + 1))
    K = np.kron(kernel(clock, clock), np.eye(outputs))
    size = len(K)
    A = np.tile(K, (len(steps), 1, 1))
    at = np.arange(horizon + 1)
    blocks = A.reshape(len(steps), horizon + 1, outputs, horizon + 1, outputs)
    blocks[:, at, :, at, :] += hbar * reference.covariances[window].transpose(1, 0, 2, 3)
    means = reference.means[window].reshape(len(steps), size, 1)
    return (K[:outputs] @ np.linalg.solve(A, means))[:, :, 0]


def _chosen(candidates: Sequence[Candidate]) -> Candidate:
    """The strongest regularization, and with it the widest kernel, among those that are as good as any."""
    good = [c for c in candidates if c.worse <= 1.0 and c.share >= ENOUGH]
    if good:
        return min(good, key=lambda c: (-c.lambda_, -c.length_scale))
    return max(candidates, key=lambda c: (c.share, -c.error))


def _why(
    components: int,
    criteria: dict[int, float],
    chosen: Candidate,
    candidates: Sequence[Candidate],
    share: float,
    times: np.ndarray,
) -> str:
    length = chosen.length_scale
    best = min(candidate.error for candidate in candidates)
    many = len(criteria) > 1
    said = (
        f"{components} components {'have the least information criterion of' if many else 'were given, and'} "
        f"{len(criteria) if many else 'no other'} numbers tried. "
        f"A kernel as long as {length:.3g}, {length / (times[-1] - times[0]):.1%} of the motion, with "
        f"λ = β = {chosen.lambda_:.3g} reproduces left-out demonstrations to {chosen.error:.3g} standard deviations, "
        f"the best of {len(candidates)} tried to {best:.3g}. Without actions {share:.1%} of the steps are within one "
        "standard deviation of the mean"
    )
    if share >= ENOUGH:
        return said + ": nothing smoother is as good."
    return said + f", less than {ENOUGH:.0%}: record more demonstrations, or ones that differ less in their timing."
