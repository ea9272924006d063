"""Fits of letters with sharp corners and loops, and of correlated outputs, without manual settings."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory, SquaredExponential, mixture
from guiderail.models.primitives.deviation import outputs_at
from guiderail.models.primitives.fit import LONG, MIN_SHARE, fit, share_within_spread
from guiderail.models.primitives.mixture import information_criteria
from oracles.handwriting import make_correlated, share_within_deviation, write_letter


def motion(selection):
    """Return the outputs (N, O) of a fitted primitive without actions."""
    reference, steps = selection.reference, np.arange(selection.reference.num_steps)
    return outputs_at(reference, selection.kernel, 2.0 * selection.lambda_, 40, steps)


# The unit and the origin of the coordinates must not affect the fit.
PAGES = [{"size": 1.0}, {"size": 100.0, "offset": (300.0, -200.0)}]


# `letters.py` in this folder prints the selection for letters with more demonstrations and steps.
@pytest.mark.parametrize(("letter", "page"), list(zip("Ne", PAGES, strict=True)))
def test_fitted_letter_stays_within_the_demonstrations(letter, page):
    selection = fit(write_letter(letter, count=4, steps=60, **page))
    assert selection.is_within_spread
    assert selection.share >= MIN_SHARE
    assert f"{selection.components} components have the least information criterion" in selection.why


def test_fitted_letter_with_corners_stays_within_the_deviation():
    letter = write_letter("B", count=5, steps=100)
    assert share_within_deviation(letter, motion(fit(letter))) >= MIN_SHARE


@pytest.fixture(scope="module")
def demonstrations():
    return make_correlated(count=4, steps=80)


@pytest.fixture(scope="module")
def selection(demonstrations):
    return fit(demonstrations)


def test_fit_reproduces_correlated_outputs(demonstrations, selection):
    """At a correlation of 0.98, the deviation is twelve times as large along the main direction as across."""
    outputs = np.stack(demonstrations.outputs)
    deviations = outputs - outputs.mean(axis=0)
    assert np.corrcoef(deviations.reshape(-1, 3).T)[np.triu_indices(3, 1)].min() > 0.97
    assert selection.is_within_spread
    assert share_within_deviation(demonstrations, motion(selection)) >= MIN_SHARE


def test_fit_selects_the_smoothest_of_the_best_candidates(selection):
    chosen = next(
        c
        for c in selection.candidates
        if (c.length_scale, c.lambda_) == (selection.kernel.length_scale, selection.lambda_)
    )
    assert chosen.worse <= 1
    assert chosen.share >= MIN_SHARE
    for candidate in selection.candidates:
        if candidate.worse <= 1 and candidate.share >= MIN_SHARE:
            assert (-candidate.lambda_, -candidate.length_scale) >= (-chosen.lambda_, -chosen.length_scale)
    assert min(c.worse for c in selection.candidates) == 0
    assert selection.components == min(selection.criteria, key=lambda count: selection.criteria[count])
    for number in (selection.components, f"{selection.share:.1%}", f"{selection.lambda_:.3g}"):
        assert str(number) in selection.why


def test_fit_is_invariant_to_units(demonstrations, selection):
    """Outputs scaled by 100 scale the motion by 100 and λ by the inverse square; time scales only the length scale."""
    other = fit(Demonstrations([10 * t for t in demonstrations.times], [100 * y for y in demonstrations.outputs]))
    assert other.components == selection.components
    assert other.kernel.length_scale == pytest.approx(10 * selection.kernel.length_scale, rel=1e-9)
    assert other.lambda_ == pytest.approx(selection.lambda_ / 1e4, rel=1e-6)
    np.testing.assert_allclose(motion(other), 100 * motion(selection), atol=1e-3)


def test_selection_accepts_arguments_of_the_primitive(selection):
    primitive = selection.primitive(history=3, history_variance=1e-5, lambda_=7.0)
    assert (primitive.history, primitive.lambda_, primitive.beta) == (3, 7.0, selection.lambda_)
    assert primitive.reference is selection.reference


def hook(steps=60, deviation=0.05):
    """Return a reference with a corner in the middle."""
    t = np.linspace(0, 2, steps)
    means = np.column_stack([np.abs(t - 1), t])
    return ReferenceTrajectory(t, means, np.tile(deviation**2 * np.eye(2), (steps, 1, 1)))


def test_share_is_low_when_a_primitive_leaves_the_spread():
    """The share falls if the kernel cuts the corner, or if λ pulls the motion to zero."""
    for reference, length_scale, lambda_, low, high in (
        (hook(), 0.1, 0.05, 1.0, 1.0),
        (hook(deviation=0.005), 22.4, 6.0, 0.0, 0.7),
        (hook(), 0.1, 1e5, 0.0, 0.2),
    ):
        share = share_within_spread(reference, SquaredExponential(length_scale), lambda_, lambda_, evaluated=LONG)
        assert low <= share <= high
        estimate = share_within_spread(reference, SquaredExponential(length_scale), lambda_, lambda_)
        assert estimate == pytest.approx(share, abs=0.1)


def test_share_considers_correlations():
    """With variances of 0.01 and a correlation of 0.99, one standard deviation is 0.141 along (1, 1), 0.01 across."""
    t = np.linspace(0, 1, 20)
    covariances = np.tile(0.01 * np.array([[1.0, 0.99], [0.99, 1.0]]), (20, 1, 1))
    for offset, share in (((0.05, 0.05), 1.0), ((0.011, -0.011), 0.0), ((0.0995, 0.0995), 1.0), ((0.102, 0.102), 0.0)):
        reference = ReferenceTrajectory(t, np.tile(offset, (20, 1)), covariances)
        # This regularization is so strong that the motion stays at zero.
        assert share_within_spread(reference, SquaredExponential(0.5), 1e8, 0.0) == share


def test_information_criteria_stop_when_not_improving():
    """A straight line needs one or two components; the search stops before eight."""
    t = np.linspace(0, 1, 100)
    rng = np.random.default_rng(0)
    outputs = np.stack([t[:, None] + 0.05 * rng.standard_normal((100, 1)) for _ in range(4)])
    result = information_criteria(t, outputs, [1, 2, 3, 4, 8, 16], 0)
    assert min(result, key=lambda count: result[count]) <= 2
    assert not {8, 16} & set(result)


def test_fit_refuses_too_few_data():
    t = np.linspace(0, 1, 50)
    with pytest.raises(InputError, match="at least three"):
        fit(Demonstrations(t, [np.sin(t)[:, None], np.cos(t)[:, None]]))
    with pytest.raises(InputError, match="at least 12 steps"):
        fit(Demonstrations(t[:5], [t[:5, None], 2 * t[:5, None], 3 * t[:5, None]]))


@pytest.mark.parametrize("components", [0, 41, 1000])
def test_fit_refuses_too_many_components(components, demonstrations):
    with pytest.raises(InputError, match="the number of components must be a whole number from 1 to 40"):
        fit(demonstrations, components=components)


def slow(steps, count=3):
    """Return slow smooth motions, each with its own duration, and `steps` samples."""
    rng, s = np.random.default_rng(0), np.linspace(0, 1, steps)
    shapes = [np.column_stack([s, np.sin(3 * s)]) for _ in range(count)]
    bends = 0.02 * rng.normal(size=(count, 2))
    outputs = [y + bend * np.sin(np.pi * s)[:, None] for y, bend in zip(shapes, bends, strict=True)]
    return Demonstrations([(19.0 + m) * s for m in range(count)], outputs)


def test_long_recordings_are_thinned_out_before_the_mixture():
    lines = []
    long = fit(slow(1500), log=lines.append)
    short = fit(slow(150))
    assert long.why.endswith("The mixture was fitted to 150 evenly spaced steps of 1500.")
    assert "evenly spaced" not in short.why
    assert lines[0].endswith("components to 150 of 1500 steps")
    assert len(lines) == 5
    assert long.reference.num_steps == 1500
    assert long.components == short.components
    np.testing.assert_allclose(long.reference.means[[0, -1]], short.reference.means[[0, -1]], atol=2e-3)


@pytest.mark.parametrize(("steps", "samples"), [(400, 400), (401, 150), (5000, 150)])
def test_size_of_the_mixture_does_not_grow_with_the_recording(steps, samples, monkeypatch):
    """The cost of expectation maximization is bounded by the number of samples that it sees."""
    sizes = []
    fitted = mixture._fit

    def counted(data, *arguments):
        sizes.append(len(data))
        return fitted(data, *arguments)

    monkeypatch.setattr(mixture, "_fit", counted)
    selection = fit(slow(steps), components=5)
    assert max(sizes) == 3 * samples
    assert selection.reference.num_steps == steps
    assert ("evenly spaced" in selection.why) == (samples < steps)
