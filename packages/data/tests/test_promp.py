"""Probabilistic movement primitive: fit, conditioning on via-points and blending."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import Demonstrations, ReferenceTrajectory
from guiderail_data.promp import ProMp, blend

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
    with pytest.raises(InputError, match="num_basis must be a whole number from 2 to 50, not 51"):
        ProMp.fit(bundle(), 51)
    with pytest.raises(InputError, match="resampled"):
        ProMp.fit(Demonstrations([T, 2.0 * T], [T[:, None], T[:, None]]))


def test_reference_from_promp_has_its_moments_and_a_floor():
    promp = ProMp.fit(bundle())
    means, covariances = promp.moments(PHASES)
    reference = promp.reference(T, floor=[0.01, 0.02])
    np.testing.assert_allclose(reference.means, means, atol=1e-12)
    np.testing.assert_allclose(reference.covariances, covariances + np.diag([1e-4, 4e-4]), atol=1e-12)
    for floor in (-0.01, [0.01, np.nan], [0.01] * 3):
        with pytest.raises(InputError, match="floor"):
            promp.reference(T, floor=floor)


def random_reference(scale, seed):
    """Return a reference with random means, and random covariances in proportion to the square of the scale."""
    rng = np.random.default_rng(seed)
    roots = scale * rng.standard_normal((100, 2, 2))
    covariances = roots @ roots.transpose(0, 2, 1) + 1e-3 * scale**2 * np.eye(2)
    return ReferenceTrajectory(T, rng.standard_normal((100, 2)), covariances)


def test_blend_is_the_product_of_the_gaussians():
    first, second, share = random_reference(1.0, 0), random_reference(0.1, 1), np.linspace(0.05, 0.95, 100)
    blended = blend(first, second, share)
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
        np.testing.assert_allclose(blend(first, second, share).means, expected.means, rtol=1e-9)
        np.testing.assert_allclose(blend(first, second, share).covariances, expected.covariances, rtol=1e-9)
    for share in (-0.1, np.nan, np.zeros(3)):
        with pytest.raises(InputError, match="share"):
            blend(first, second, share)
    with pytest.raises(InputError, match="same times"):
        blend(first, ReferenceTrajectory(2.0 * T, first.means, first.covariances), 0.5)
