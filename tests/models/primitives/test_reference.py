import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory
from guiderail.models.primitives.reference import interpolate_prior


def hourglass(num=9, n=120, seed=0):
    """Return demonstrations with the smallest spread in the middle."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0, 2, n)
    width = 0.1 * np.abs(t - 1) + 0.005
    return Demonstrations(t, [np.column_stack([np.sin(t) + rng.standard_normal() * width, t]) for _ in range(num)])


@pytest.mark.parametrize("components", [8, None])
def test_regression_recovers_mean_and_deviation(components):
    d = hourglass(60)
    reference = ReferenceTrajectory.from_demonstrations(d, components)
    outputs = np.stack(d.outputs)
    np.testing.assert_allclose(reference.means[:, 0], outputs[..., 0].mean(axis=0), atol=0.02)
    wide, narrow = reference.standard_deviations[[10, 60], 0]
    assert wide > 4 * narrow
    assert wide == pytest.approx(outputs[:, 10, 0].std(), rel=0.3)


def test_reference_is_deterministic_for_a_seed():
    a, b = (ReferenceTrajectory.from_demonstrations(hourglass(), 6, seed=3) for _ in range(2))
    np.testing.assert_array_equal(a.covariances, b.covariances)


def test_floor_raises_the_deviation_of_equal_demonstrations():
    """The regularization of EM makes the covariance regular; the floor is the least standard deviation."""
    t = np.linspace(0, 1, 50)
    same = Demonstrations(t, [np.column_stack([np.sin(t), np.zeros(50)])] * 3)
    assert (ReferenceTrajectory.from_demonstrations(same, 5).standard_deviations > 0).all()
    floored = ReferenceTrajectory.from_demonstrations(same, 5, floor=[0.01, 0.02])
    assert (floored.standard_deviations >= [0.01, 0.02]).all()


def test_prior_is_added_to_the_variance_of_one_demonstration():
    """The mean is the demonstration; oscillations that the mixture does not resolve add their variance to the prior."""
    t = np.linspace(0, 2, 200)
    slow = Demonstrations(t, [np.column_stack([np.sin(t), t])])
    reference = ReferenceTrajectory.from_demonstrations(slow, 12, prior_std=[0.1, 0.2])
    np.testing.assert_allclose(reference.means, slow.outputs[0], atol=5e-3)
    np.testing.assert_allclose(reference.standard_deviations, np.tile([0.1, 0.2], (200, 1)), rtol=2e-3)
    oscillating = Demonstrations(t, [np.column_stack([np.sin(t) + 0.3 * np.sin(100 * t), t])])
    reference = ReferenceTrajectory.from_demonstrations(oscillating, 12, prior_std=[0.1, 0.2])
    np.testing.assert_allclose(reference.means[:, 0], np.sin(t), atol=0.12)
    assert np.median(reference.standard_deviations[:, 0]) == pytest.approx(np.hypot(0.1, 0.3 / np.sqrt(2)), rel=0.1)


def test_prior_is_interpolated_between_phases():
    rows = [0.0, 0.1, 1.0, 0.5, 0.3, 1.0]  # rows at phases 0 and 0.5; the second row applies until the end
    prior = interpolate_prior(rows, 5, 2)
    np.testing.assert_allclose(prior, [[0.1, 1.0], [0.2, 1.0], [0.3, 1.0], [0.3, 1.0], [0.3, 1.0]])
    np.testing.assert_array_equal(interpolate_prior(0.1, 2, 2), np.full((2, 2), 0.1))


@pytest.mark.parametrize(
    ("prior", "message"),
    [
        (None, "single demonstration has no variance: give prior_std"),
        ([0.1, 0.0], "positive"),
        ([0.1, np.nan], "positive"),
        ([0.1] * 4, "2 standard deviations, or rows of a phase"),
        ([], "2 standard deviations"),
        ([0.0, 0.1, 0.1, 0.0, 0.1, 0.1], "increase"),
        ([-0.1, 0.1, 0.1], "from 0 to 1"),
        ([0.0, 0.1, 0.1, 1.1, 0.1, 0.1], "from 0 to 1"),
    ],
)
def test_prior_of_a_single_demonstration_is_refused(prior, message):
    with pytest.raises(InputError, match=message):
        ReferenceTrajectory.from_demonstrations(hourglass(1), 5, prior_std=prior)


def test_prior_is_refused_for_several_demonstrations():
    with pytest.raises(InputError, match="there are 9, which have a variance"):
        ReferenceTrajectory.from_demonstrations(hourglass(), 5, prior_std=0.1)


def test_inputs_are_extrapolated_beyond_the_ends():
    reference = ReferenceTrajectory([0, 1, 3], np.zeros((3, 1)), np.ones((3, 1, 1)))
    np.testing.assert_array_equal(reference.inputs(np.arange(-2, 5)), [-2, -1, 0, 1, 3, 5, 7])
    assert not reference.uniform
    assert ReferenceTrajectory(np.linspace(0, 7.98, 400), np.zeros((400, 1)), np.ones((400, 1, 1))).uniform


@pytest.mark.parametrize(
    ("times", "means", "covariances", "message"),
    [
        ([0.0], [[0.0]], [[[1.0]]], "at least two"),
        ([0.0, 0.0], [[0.0]] * 2, [[[1.0]]] * 2, "increase"),
        ([0.0, 1.0], [[0.0]] * 3, [[[1.0]]] * 2, "means"),
        ([0.0, 1.0], [[0.0]] * 2, [[[1.0]]] * 3, "covariances"),
        ([0.0, 1.0], [[0.0], [np.nan]], [[[1.0]]] * 2, "means must be finite"),
        ([0.0, 1.0], [[0.0]] * 2, [[[1.0]], [[0.0]]], "step 1 is singular"),
        ([0.0, 1.0], [[0.0]] * 2, [[[1.0]], [[-1.0]]], "step 1 is singular"),
        ([0.0, 1.0], [[0.0, 0.0]] * 2, [[[1.0, 1.0], [1.0, 1.0]]] * 2, "singular"),
        ([0.0, 1.0], [[0.0, 0.0]] * 2, [[[1.0, 0.5], [0.0, 1.0]]] * 2, "symmetric"),
    ],
)
def test_constructor_refuses_invalid_references(times, means, covariances, message):
    with pytest.raises(InputError, match=message):
        ReferenceTrajectory(times, means, covariances)


def test_from_demonstrations_refuses_invalid_mixtures():
    with pytest.raises(InputError, match="components"):
        ReferenceTrajectory.from_demonstrations(hourglass(), 0)
    with pytest.raises(InputError, match="floor"):
        ReferenceTrajectory.from_demonstrations(hourglass(), 5, floor=-1)


@pytest.mark.parametrize("times", [[0.0, 1.0, 10.0], [2.0, 3.0, 4.0]])
def test_resampled_reference_is_interpolated_over_its_clock(times):
    means = np.array(times)[:, None] - times[0]
    resampled = ReferenceTrajectory(times, means, 1.0 + means[:, None]).resampled(0.5)
    expected = np.minimum(resampled.times - times[0], means[-1])
    np.testing.assert_allclose(resampled.means[:, 0], expected, atol=1e-12)
    np.testing.assert_allclose(resampled.covariances[:, 0, 0], 1.0 + expected, atol=1e-12)


@pytest.mark.parametrize("height", [0.3, 0.5, 1.0, 0.1])
def test_constant_output_has_a_spread_independent_of_its_value(height):
    """The mean of equal numbers may differ from the number by rounding."""
    rng = np.random.default_rng(0)
    t = np.linspace(0, 1, 50)
    outputs = [np.column_stack([np.sin(t + 0.05 * rng.normal()), np.full(50, height)]) for _ in range(3)]
    reference = ReferenceTrajectory.from_demonstrations(Demonstrations([t] * 3, outputs), 4)
    np.testing.assert_allclose(reference.standard_deviations[:, 1], 1e-3, rtol=1e-6)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"components": 61}, "the number of components must be a whole number from 1 to 60, not 61"),
        ({"demonstrations": hourglass(1), "prior_std": "small"}, "prior_std is not an array of numbers"),
    ],
)
def test_arguments_out_of_range_are_refused(changes, message):
    with pytest.raises(InputError, match=message):
        ReferenceTrajectory.from_demonstrations(**({"demonstrations": hourglass(3), "components": 4} | changes))
