"""Inference of parameters from summaries: sensitivities, posterior, and a check that the model explains a robot.

The summaries are compressed to one number for each parameter: the prediction of the parameter by kernel ridge
regression (semi-automatic summary statistics, Fearnhead and Prangle 2012). Predictions of the training draws leave out
the draw itself. A parameter whose predictions explain little of its variance cannot be identified, and its posterior is
its prior. The posterior of the others is an ensemble of normalizing flows (neural posterior estimation, package `sbi`).

All parameters are standard normal here: z = Φ⁻¹(q), with the quantile q of the prior.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.stats import norm

IDENTIFIABLE = 0.2  # smallest fraction of a parameter's variance that the summaries of an identifiable one explain
MEMBERS = 3  # flows of the ensemble; a single flow is too certain if it was fitted to few draws
FALSE_ALARMS = 0.04  # fraction of robots inside the model that are reported as not explained by it
COMPONENTS = 30  # largest number of principal components of the summaries that are checked
_RIDGES = np.logspace(-3, 3, 13)
_CONSTANT = 100.0  # constant part of the kernels, an intercept that the ridge hardly shrinks
_WIDTHS = (0.5, 1.0, 2.0, 4.0)  # widths of the kernel, in median distances


def to_normal(quantiles: np.ndarray) -> np.ndarray:
    """Return the standard normal values of quantiles of the prior."""
    return np.asarray(norm.ppf(np.clip(quantiles, 1e-4, 1.0 - 1e-4)))


def to_quantiles(normal: np.ndarray) -> np.ndarray:
    """Return the quantiles of the prior of standard normal values."""
    return np.asarray(norm.cdf(normal))


class Regression:
    """Kernel ridge regression of one output; its kernel and ridge have the smallest leave-one-out error.

    The kernel is the sum of a linear and a squared exponential one, or the linear one.

    Attributes:
        left_out: Predictions of the training outputs without the sample itself, (n,).
        explained: Fraction of the variance of the outputs that `left_out` explains, at least 0.
    """

    def __init__(self, kernels: Sequence[Any], outputs: np.ndarray):
        """Fit to outputs (n,), with the eigendecompositions of `Kernels`."""
        self._mean = float(outputs.mean())
        y = outputs - self._mean
        best = np.inf
        for index, (values, vectors) in enumerate(kernels):
            projected, squares = vectors.T @ y, vectors**2
            for ridge in _RIDGES:
                shrink = 1.0 / (values + ridge)
                dual, diagonal = vectors @ (shrink * projected), squares @ shrink
                residual = dual / diagonal
                error = float((residual**2).mean())
                if error < best:
                    best, self._index, self._dual, self.left_out = error, index, dual, outputs - residual
        self.explained = max(0.0, 1.0 - best / float(y.var()))

    def predict(self, kernels: Sequence[np.ndarray]) -> np.ndarray:
        """Return predictions (m,) from the kernel matrices (m, n) of new inputs."""
        return np.asarray(self._mean + kernels[self._index] @ self._dual)


class Kernels:
    """Kernel matrices of standardized inputs (n, p)."""

    def __init__(self, inputs: np.ndarray):
        """Construct the kernels of training inputs."""
        self._center = inputs.mean(axis=0)
        self._scale = inputs.std(axis=0)
        self._used = self._scale > 1e-9 * (1.0 + np.abs(self._center))
        self._inputs = self._standardized(inputs)
        self._distance = float(np.median(_squares(self._inputs, self._inputs)))
        self.decompositions = [
            (np.maximum(values, 0.0), vectors) for values, vectors in map(np.linalg.eigh, self.matrices(inputs))
        ]

    def matrices(self, inputs: np.ndarray) -> list[np.ndarray]:
        """Return the matrix (m, n) of each kernel for inputs (m, p)."""
        x = self._standardized(inputs)
        linear = _CONSTANT + x @ self._inputs.T / x.shape[1]
        squares = _squares(x, self._inputs) / self._distance
        return [linear, *(linear + np.exp(-squares / width**2) for width in _WIDTHS)]

    def _standardized(self, inputs: np.ndarray) -> np.ndarray:
        z = (inputs - self._center)[:, self._used] / self._scale[self._used]
        return np.asarray(np.clip(z, -6.0, 6.0))  # a robot outside the model must not dominate a prediction


def _squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.asarray((a**2).sum(1)[:, None] + (b**2).sum(1) - 2.0 * a @ b.T)


class Posterior:
    """Amortized posterior of parameters for the summaries of any robot.

    Attributes:
        sensitivities: Fraction of each parameter's variance that the summaries explain, (d,).
        identifiable: True for each parameter whose sensitivity is at least `IDENTIFIABLE`, (d,).
    """

    def __init__(self, quantiles: np.ndarray, summaries: np.ndarray, seed: int = 0):
        """Fit to draws of the prior: quantiles (n, d) and summaries (n, p)."""
        z = to_normal(quantiles)
        self._kernels = Kernels(summaries)
        self._regressions = [Regression(self._kernels.decompositions, column) for column in z.T]
        self.sensitivities = np.array([regression.explained for regression in self._regressions])
        self.identifiable = self.sensitivities >= IDENTIFIABLE
        left_out = np.stack([regression.left_out for regression in self._regressions], axis=1)
        self._check = ModelCheck(summaries, left_out[:, self.identifiable])
        self._flows: list[Any] = []
        if self.identifiable.any():
            known, estimates = z[:, self.identifiable], left_out[:, self.identifiable]
            # The flow only has to learn the residuals of a linear regression, which few draws suffice for.
            design = np.column_stack([np.ones(len(estimates)), estimates])
            self._linear, *_ = np.linalg.lstsq(design, known, rcond=None)
            self._flows = [
                _fit_flow(known - design @ self._linear, estimates, seed + member) for member in range(MEMBERS)
            ]

    def estimates(self, summaries: np.ndarray) -> np.ndarray:
        """Return the compressed summaries (m, d) of summaries (m, p)."""
        matrices = self._kernels.matrices(np.atleast_2d(summaries))
        return np.stack([regression.predict(matrices) for regression in self._regressions], axis=1)

    def sample(self, summaries: np.ndarray, number: int, seed: int = 0) -> np.ndarray:
        """Return quantiles (number, d) of draws of the posterior for the summaries (p,) of a robot."""
        import torch

        normal = np.random.default_rng(seed).standard_normal((number, len(self.identifiable)))
        if self._flows:
            observed = self.estimates(summaries)[0, self.identifiable]
            condition = torch.tensor(observed, dtype=torch.float32)
            with torch.random.fork_rng(), torch.no_grad(), _quiet():
                torch.manual_seed(seed)
                count = -(-number // MEMBERS)
                parts = [flow.sample((count,), x=condition, show_progress_bars=False).numpy() for flow in self._flows]
            # Draws alternate between the flows, so that the first few are draws of the ensemble, too.
            draws = np.stack(parts, axis=1).reshape(-1, len(observed))[:number]
            normal[:, self.identifiable] = draws + np.append(1.0, observed) @ self._linear
        return to_quantiles(normal)

    def explains(self, summaries: np.ndarray) -> tuple[bool, float]:
        """Return True if the model explains the summaries (p,), and the p-value of the check."""
        p = self._check.p_value(summaries, self.estimates(summaries)[0, self.identifiable])
        return p > FALSE_ALARMS, p


class ModelCheck:
    """Check that the summaries of a robot are as likely as those of simulated draws.

    An emulator predicts the principal components of the summaries from the estimated parameters. The distance of a
    robot is the Mahalanobis distance of its residuals, together with the part of the summaries outside of the
    principal components. The p-value is the rank of this distance among those of the simulated draws, each without
    itself: at most `FALSE_ALARMS` of the robots inside the model have a p-value of at most `FALSE_ALARMS`.
    """

    def __init__(self, summaries: np.ndarray, estimates: np.ndarray):
        """Fit to summaries (n, p) and estimates (n, d) of simulated draws."""
        n = len(summaries)
        self._center = np.median(summaries, axis=0)
        spread = summaries.std(axis=0)
        self._used = spread > 1e-9 * (1.0 + np.abs(self._center))
        self._scale = spread[self._used]
        x = self._scaled(summaries)
        folds = np.arange(n) % 5
        distances = np.zeros((n, 2))
        for fold in range(5):
            at = folds == fold
            distances[at] = _distances(self._fit(x[~at], estimates[~at]), x[at], estimates[at])
        self._fitted = self._fit(x, estimates)
        self._reference = distances
        self._combined = np.sort(self._combine(distances))

    def p_value(self, summaries: np.ndarray, estimates: np.ndarray) -> float:
        """Return the p-value of the summaries (p,) of a robot with the estimated parameters (d,)."""
        distance = _distances(self._fitted, self._scaled(summaries[None]), estimates[None])
        above = len(self._combined) - np.searchsorted(self._combined, self._combine(distance)[0], side="left")
        return float((above + 1) / (len(self._combined) + 1))

    def _scaled(self, summaries: np.ndarray) -> np.ndarray:
        return np.asarray((summaries - self._center)[:, self._used] / self._scale)

    def _combine(self, distances: np.ndarray) -> np.ndarray:
        """Return the larger of both distances (m, 2), each in its own 95 % quantile."""
        return np.asarray((distances / np.quantile(self._reference, 0.95, axis=0)).max(axis=1))

    @staticmethod
    def _fit(x: np.ndarray, estimates: np.ndarray) -> Any:
        mean = x.mean(axis=0)
        _, _, axes = np.linalg.svd(x - mean, full_matrices=False)
        axes = axes[: min(COMPONENTS, len(x) // 5)]
        scores = (x - mean) @ axes.T
        kernels = Kernels(estimates) if estimates.shape[1] else None
        emulators = [] if kernels is None else [Regression(kernels.decompositions, column) for column in scores.T]
        predicted = np.stack([e.left_out for e in emulators], axis=1) if emulators else scores.mean(axis=0)
        residuals = scores - predicted
        precision = np.linalg.pinv(np.cov(residuals, rowvar=False) + 1e-9 * np.eye(len(axes)))
        return mean, axes, kernels, emulators, scores.mean(axis=0), precision


def _distances(fitted: Any, x: np.ndarray, estimates: np.ndarray) -> np.ndarray:
    """Return the distance of residuals within and outside of the principal components, (m, 2)."""
    mean, axes, kernels, emulators, center, precision = fitted
    scores = (x - mean) @ axes.T
    if kernels is not None:
        matrices = kernels.matrices(estimates)
        residuals = scores - np.stack([emulator.predict(matrices) for emulator in emulators], axis=1)
    else:
        residuals = scores - center
    outside = x - mean - scores @ axes
    return np.stack([np.einsum("ij,jk,ik->i", residuals, precision, residuals), (outside**2).sum(axis=1)], axis=1)


def _fit_flow(residuals: np.ndarray, estimates: np.ndarray, seed: int) -> Any:
    """Return the neural posterior of residuals (n, k) for estimates (n, k)."""
    import torch
    from sbi.inference import NPE
    from sbi.neural_nets import posterior_nn

    with torch.random.fork_rng(), _quiet():
        torch.manual_seed(seed)
        dimensions = residuals.shape[1]
        # The loss of a single round of NPE does not contain the prior; it only defines the support, which is unbounded.
        prior = torch.distributions.MultivariateNormal(torch.zeros(dimensions), torch.eye(dimensions))
        network = posterior_nn("maf", hidden_features=16, num_transforms=2)
        inference = NPE(prior=prior, density_estimator=network, tracker=_NoTracker(), show_progress_bars=False)
        inference.append_simulations(
            torch.tensor(residuals, dtype=torch.float32), torch.tensor(estimates, dtype=torch.float32)
        )
        inference.train(training_batch_size=64, learning_rate=2e-3, validation_fraction=0.15, max_num_epochs=300)
        return inference.build_posterior()


class _NoTracker:
    """Tracker that logs nothing; by default, `sbi` writes logs of TensorBoard into the current folder."""

    log_dir: str | None = None

    def log_metric(self, name: str, value: float, step: int | None = None) -> None:
        """Ignore a metric."""

    def log_metrics(self, metrics: dict[str, float], step: int | None = None) -> None:
        """Ignore metrics."""

    def log_params(self, params: dict[str, Any]) -> None:
        """Ignore parameters."""

    def add_figure(self, name: str, figure: Any, step: int | None = None) -> None:
        """Ignore a figure."""

    def flush(self) -> None:
        """Do nothing."""


@contextlib.contextmanager
def _quiet() -> Any:
    """Suppress the messages and warnings of `sbi`, which concern its own internals."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        yield


def describe_check(is_explained: bool, p_value: float) -> str:
    """Return the result of the check of the model in one sentence."""
    if is_explained:
        return f"The model explains the recordings (p = {p_value:.2g})."
    return (
        f"Not explained by this model (p = {p_value:.2g}, and {FALSE_ALARMS:g} or less is an alarm): the robot differs "
        "in something that no parameter describes, such as a grasp that slips; do not rely on posterior and prediction."
    )
