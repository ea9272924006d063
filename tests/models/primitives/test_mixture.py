import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from guiderail.diagrams.tasks import bnc_connector as connector
from guiderail.diagrams.tasks import narrow_passage as passage
from guiderail.models.common.errors import InputError
from guiderail.models.objects.narrow_passage import PATH
from guiderail.models.primitives import Demonstrations, mixture
from guiderail.models.primitives.mixture import (
    FIELDS,
    Mixture,
    digest,
    fit_mixture,
    fit_new_mixture,
    information_criteria,
    regress,
)

PACKAGED = [(path, connector.COMPONENTS) for path in connector.DEMONSTRATIONS.values()]
PACKAGED.append((PATH, passage.COMPONENTS))


@pytest.mark.parametrize(("path", "components"), PACKAGED, ids=lambda value: getattr(value, "stem", None))
def test_packaged_demonstrations_have_a_stored_mixture(path, components):
    demonstrations = Demonstrations.load(path).resampled()
    arguments = demonstrations.times[0], np.stack(demonstrations.outputs), components, 0
    assert fit_mixture(*arguments) is fit_mixture(*arguments)


def test_stored_mixture_equals_a_fit_of_the_demonstrations():
    path, components = PACKAGED[0]
    demonstrations = Demonstrations.load(path).resampled()
    arguments = demonstrations.times[0], np.stack(demonstrations.outputs), components, 0
    stored, fitted = fit_mixture(*arguments), fit_new_mixture(*arguments)
    for name in FIELDS:
        np.testing.assert_allclose(getattr(stored, name), getattr(fitted, name), rtol=1e-6, atol=1e-9)


def test_digest_depends_on_every_argument():
    times, outputs = np.arange(4.0), np.zeros((2, 4, 3))
    variants = [(times + 1, outputs, 2, 0), (times, outputs + 1, 2, 0), (times, outputs, 1, 0), (times, outputs, 2, 1)]
    variants.append((times, outputs.reshape(3, 4, 2), 2, 0))
    assert len({digest(*arguments) for arguments in [(times, outputs, 2, 0), *variants]}) == 6


def test_packaged_demonstrations_need_no_scikit_learn():
    """Importing scikit-learn would take 0.5 s and 60 MiB of every training process."""
    program = (
        "import sys; from guiderail.diagrams.tasks.bnc_connector import reference_trajectory as connector; "
        "from guiderail.diagrams.tasks.narrow_passage import reference_trajectory as passage; "
        "connector('insert'), connector('search'), connector('firm_search'), passage(); "
        "sys.exit('sklearn' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", program], check=False).returncode == 0


def test_regression_returns_the_moments_of_the_mixture():
    """Compare with the moments of the joint density at a fixed time."""
    weights, means = np.array([0.3, 0.7]), np.array([[-0.5, 1.0], [0.8, -0.4]])
    covariances = np.array([[[0.4, 0.3], [0.3, 0.5]], [[0.2, -0.1], [-0.1, 0.3]]])
    center, scale = np.array([2.0, 0.1]), np.array([0.5, 3.0])
    times, y = np.array([1.2, 2.0, 2.5, 5.0]), np.linspace(-30, 30, 20001)
    regressed = regress(Mixture(weights, means, covariances, center, scale), times)
    for t, mean, covariance in zip(times, *regressed, strict=True):
        joint = (np.stack([np.full_like(y, t), y], axis=1) - center) / scale
        differences = joint[:, None] - means
        exponent = np.einsum("ncj,cjk,nck->nc", differences, np.linalg.inv(covariances), differences)
        density = (np.exp(-exponent / 2) / np.sqrt(np.linalg.det(covariances)) * weights).sum(axis=1)
        density /= density.sum()
        assert mean[0] == pytest.approx(density @ y, rel=1e-9)
        assert covariance[0, 0] == pytest.approx(density @ (y - mean[0]) ** 2, rel=1e-9)


def test_regression_extrapolates_the_most_likely_component():
    """If every density underflows, the mean follows the line of the most likely component."""
    clock, outputs = np.linspace(0, 1, 40), np.stack([np.outer(np.linspace(0, 1, 40), [2.0]) + o for o in (0.0, 0.01)])
    fitted = fit_mixture(clock, outputs, components=20, seed=0)
    times = np.array([-300.0, 300.0, 400.0])
    means, covariances = regress(fitted, times)
    assert np.isfinite(means).all()
    assert (covariances[:, 0, 0] > 0).all()
    assert means[2, 0] - means[1, 0] == pytest.approx((means[2, 0] - means[0, 0]) / 7, rel=0.2)


def test_components_are_limited_to_half_the_steps():
    times, outputs = np.linspace(0, 1, 12), np.random.default_rng(0).normal(size=(3, 12, 1))
    assert len(fit_mixture(times, outputs, components=6, seed=0).weights) == 6
    with pytest.raises(InputError, match="components"):
        fit_mixture(times, outputs, components=7, seed=0)


def test_fit_mixture_selects_the_better_number_of_components():
    """Four steps allow one or two components; two separate levels need two components."""
    rng = np.random.default_rng(0)
    outputs = np.array([0.0, 0.0, 10.0, 10.0])[:, None] + 0.01 * rng.standard_normal((30, 4, 1))
    assert len(fit_mixture(np.arange(4.0), outputs, components=None, seed=0).weights) == 2


def fit_with_criteria(monkeypatch, criteria):
    """Replace the fit by a stub with the given information criteria of 1, 2, … components."""
    fits = [
        SimpleNamespace(bic=lambda _, c=c: c, weights_=n, means_=n, covariances_=n) for n, c in enumerate(criteria, 1)
    ]
    monkeypatch.setattr(mixture, "_fit", lambda data, phase, count, seed: fits[count - 1])


def test_search_ends_after_two_criteria_above_the_minimum(monkeypatch):
    criteria = [5.0, 4.0, 3.0, 3.5, 3.6, 1.0]
    fit_with_criteria(monkeypatch, criteria)
    found = information_criteria(np.arange(20.0), np.zeros((2, 20, 1)), range(1, 7), 0)
    assert found == dict(zip(range(1, 6), criteria, strict=False))


@pytest.mark.parametrize(("criteria", "expected"), [((1.0, 2.0, 3.0), 1), (range(50, 0, -1), 20)])
def test_one_to_twenty_components_are_searched(criteria, expected, monkeypatch):
    fit_with_criteria(monkeypatch, criteria)
    assert fit_new_mixture(np.arange(100.0), np.zeros((2, 100, 1)), None, 0).weights == expected
