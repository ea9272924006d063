"""Probabilistic movement primitive: fit, conditioning on via-points, blending, and exploration in gaps."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, LcNsKmp, ProMp, ReferenceTrajectory, SquaredExponential
from guiderail.models.primitives.gains import authority_gains
from guiderail.models.primitives.reference import unobserved_share

T = np.linspace(0.0, 2.0, 100)
PHASES = np.linspace(0.0, 1.0, 100)


def bundle(number=12, seed=0):
    """Return demonstrations with opposite displacements along x and y, which are smallest in the middle."""
    rng = np.random.default_rng(seed)
    wide = 0.2 * np.abs(T - 1.0) + 0.01
    scales = rng.standard_normal((number, 2))
    return Demonstrations(T, [np.column_stack([np.sin(T) + a * wide, T - a * wide + 0.05 * b * T]) for a, b in scales])


def test_promp_has_the_moments_of_its_demonstrations():
    outputs = np.stack(bundle().outputs)
    means, covariances = ProMp.fit(bundle()).moments(PHASES)
    np.testing.assert_allclose(means, outputs.mean(axis=0), atol=2e-3)
    deviations = outputs - outputs.mean(axis=0)
    sample = np.einsum("mno,mnp->nop", deviations, deviations) / len(outputs)
    np.testing.assert_allclose(covariances, sample, atol=0.02 * np.abs(sample).max())


def test_conditioning_equals_conditioning_of_the_joint_gaussian():
    """Compare with the textbook formula for two outputs at two phases, without weights."""
    promp = ProMp.fit(bundle(), 8)
    at, second_phase, target, accuracy = 0.3, 0.8, np.array([0.7, 0.5]), np.diag([1e-4, 4e-4])
    pair = promp._blocks(np.array([at, second_phase])).reshape(4, -1)
    mean, joint = pair @ promp.mean, pair @ promp.covariance @ pair.T
    gain = joint[2:, :2] @ np.linalg.inv(joint[:2, :2] + accuracy)
    means, covariances = promp.conditioned(at, target, accuracy).moments(np.array([second_phase]))
    np.testing.assert_allclose(means[0], mean[2:] + gain @ (target - mean[:2]), atol=1e-9)
    np.testing.assert_allclose(covariances[0] - promp.noise, joint[2:, 2:] - gain @ joint[:2, 2:], atol=1e-12)


def test_via_point_displaces_correlated_outputs():
    promp = ProMp.fit(bundle())
    displacement = np.array([0.1, -0.1])  # along x and y to opposite sides, as in the demonstrations
    target = promp.moments(np.array([0.1]))[0][0] + displacement
    conditioned = promp.conditioned(0.1, target, 1e-8 * np.eye(2))
    np.testing.assert_allclose(conditioned.moments(np.array([0.1]))[0][0], target, atol=1e-3)
    # Demonstrations that begin to one side end on the same side.
    assert conditioned.moments(np.array([0.9]))[0][0, 0] - promp.moments(np.array([0.9]))[0][0, 0] > 0.05
    before, after = (np.trace(p.moments(np.array([0.1]))[1][0]) for p in (promp, conditioned))
    assert after < 0.1 * before
    conditioned_twice = conditioned.conditioned(0.9, promp.moments(np.array([0.9]))[0][0], 1e-8 * np.eye(2))
    assert np.linalg.eigvalsh(conditioned_twice.covariance)[0] > -1e-12


@pytest.mark.parametrize(
    ("phase", "output", "covariance"),
    [
        (1.1, np.zeros(2), np.eye(2)),
        (0.5, np.array([0.0, np.nan]), np.eye(2)),
        (0.5, np.zeros(2), -np.eye(2)),
        (0.5, np.zeros(2), np.array([[1.0, 0.5], [0.0, 1.0]])),
    ],
)
def test_promp_refuses_invalid_via_points(phase, output, covariance):
    with pytest.raises(InputError, match="via-point"):
        ProMp.fit(bundle()).conditioned(phase, output, covariance)


def test_promp_refuses_too_many_basis_functions():
    with pytest.raises(InputError, match="between 2 and half"):
        ProMp.fit(bundle(), 51)
    with pytest.raises(InputError, match="resampled"):
        ProMp.fit(Demonstrations([T, 2.0 * T], [T[:, None], T[:, None]]))


def test_reference_from_promp_equals_reference_with_promp_model():
    d = bundle()
    direct = ReferenceTrajectory.from_promp(ProMp.fit(d), T, floor=[0.01, 0.02])
    fitted = ReferenceTrajectory.from_demonstrations(d, model="promp", floor=[0.01, 0.02])
    np.testing.assert_allclose(fitted.means, direct.means, atol=1e-12)
    np.testing.assert_allclose(fitted.covariances, direct.covariances, atol=1e-12)
    assert (fitted.standard_deviations >= [0.01, 0.02]).all()
    single = ReferenceTrajectory.from_demonstrations(d.first(1), model="promp", prior_std=[0.1, 0.2])
    np.testing.assert_allclose(single.standard_deviations, np.tile([0.1, 0.2], (100, 1)), rtol=1e-2)
    with pytest.raises(InputError, match="gmr or promp"):
        ReferenceTrajectory.from_demonstrations(d, model="dmp")
    for floor in (-0.01, [0.01, np.nan], [0.01] * 3):
        with pytest.raises(InputError, match="floor"):
            ReferenceTrajectory.from_promp(ProMp.fit(d), T, floor=floor)


def random_reference(scale, seed):
    """Return a reference with random means, and random covariances in proportion to the square of the scale."""
    rng = np.random.default_rng(seed)
    roots = scale * rng.standard_normal((100, 2, 2))
    covariances = roots @ roots.transpose(0, 2, 1) + 1e-3 * scale**2 * np.eye(2)
    return ReferenceTrajectory(T, rng.standard_normal((100, 2)), covariances)


def test_blend_is_the_product_of_the_gaussians():
    first, second, share = random_reference(1.0, 0), random_reference(0.1, 1), np.linspace(0.05, 0.95, 100)
    blended = first.blended(second, share)
    precisions = [np.linalg.inv(reference.covariances) for reference in (first, second)]
    precision = (1.0 - share)[:, None, None] * precisions[0] + share[:, None, None] * precisions[1]
    both = [
        weight[:, None] * np.einsum("nop,np->no", inverse, reference.means)
        for weight, inverse, reference in zip((1.0 - share, share), precisions, (first, second), strict=True)
    ]
    np.testing.assert_allclose(np.linalg.inv(blended.covariances), precision, rtol=1e-6)
    np.testing.assert_allclose(blended.means, np.linalg.solve(precision, sum(both)[..., None])[..., 0], rtol=1e-6)


def test_blend_of_share_zero_and_one_is_exact():
    first, second = random_reference(1.0, 0), random_reference(0.1, 1)
    for share, expected in ((0.0, first), (1.0, second)):
        np.testing.assert_allclose(first.blended(second, share).means, expected.means, rtol=1e-9)
        np.testing.assert_allclose(first.blended(second, share).covariances, expected.covariances, rtol=1e-9)
    for share in (-0.1, np.nan, np.zeros(3)):
        with pytest.raises(InputError, match="share"):
            first.blended(second, share)
    with pytest.raises(InputError, match="same times"):
        first.blended(ReferenceTrajectory(2.0 * T, first.means, first.covariances), 0.5)


def with_gap(first, last):
    """Return the demonstrations stretched to 8 s, without the samples between two times [s]."""
    is_recorded = (first >= 4.0 * T) | (last <= 4.0 * T)
    return Demonstrations(4.0 * T[is_recorded], [y[is_recorded] for y in bundle().outputs])


def test_unobserved_share_is_a_gaussian_process_posterior():
    recordings = with_gap(3.0, 6.0)
    reference = ReferenceTrajectory.from_demonstrations(recordings, 6, num_steps=100)
    observed = (reference.times <= 3.0 + 1e-9) | (reference.times >= 6.0 - 1e-9)
    k, at = SquaredExponential(0.5), reference.times
    outputs = []
    for output in range(2):
        noise = np.diag(reference.covariances[observed, output, output])
        cross_kernel = k(at, at[observed])
        gain = np.linalg.solve(k(at[observed], at[observed]) + noise, cross_kernel.T).T
        outputs.append(1.0 - np.einsum("nm,nm->n", cross_kernel, gain))
    diagonal = ReferenceTrajectory(at, reference.means, reference.covariances * np.eye(2))
    np.testing.assert_allclose(unobserved_share(diagonal, recordings, k), np.stack(outputs, axis=1), atol=1e-6)
    share = unobserved_share(reference, recordings)
    assert share[at < 2.5].max() < 0.05
    assert share[np.abs(at - 4.5) < 0.2].min() > 0.9


@pytest.mark.parametrize("scale", [0.1, 3.0])
def test_exploration_in_a_gap_is_scaled(scale):
    """The displacement by an action is scaled by about `scale` in the gap, and is equal elsewhere."""
    recordings = with_gap(3.0, 6.0)
    plain = ReferenceTrajectory.from_demonstrations(recordings, 6, num_steps=100)
    scaled = ReferenceTrajectory.from_demonstrations(recordings, 6, num_steps=100, gap_scale=scale)
    np.testing.assert_array_equal(scaled.means, plain.means)
    ratio = scaled.standard_deviations / plain.standard_deviations
    np.testing.assert_allclose(ratio[plain.times < 2.5], 1.0, atol=0.1)
    np.testing.assert_allclose(ratio[np.abs(plain.times - 4.5) < 0.1], scale, rtol=0.25)
    primitives = [LcNsKmp(reference, horizon=10) for reference in (plain, scaled)]
    gain = authority_gains(primitives[0])

    def reach(primitive, step):
        return np.linalg.norm(primitive.predict(step, gain).output - primitive.predict(step).output)

    ratio_in_gap = reach(primitives[1], 56) / reach(primitives[0], 56)
    assert ratio_in_gap < 0.4 if scale < 1.0 else ratio_in_gap > 1.5
    assert reach(primitives[1], 10) == pytest.approx(reach(primitives[0], 10), rel=0.1)
    with pytest.raises(InputError, match="gap_scale"):
        ReferenceTrajectory.from_demonstrations(recordings, 6, gap_scale=0.0)


def test_recordings_without_a_gap_are_not_scaled():
    d = bundle()
    plain = ReferenceTrajectory.from_demonstrations(d, 6)
    scaled = ReferenceTrajectory.from_demonstrations(d, 6, gap_scale=0.01)
    np.testing.assert_allclose(scaled.standard_deviations, plain.standard_deviations, rtol=0.1)
