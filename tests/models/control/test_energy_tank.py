"""Energy of clipped springs, and the share of a change that an energy allows."""

import numpy as np
import pytest

from guiderail.models.control.wrench import admissible_share, spring_energy

K, F = np.array([1500.0, 30.0]), np.array([15.0, 3.0])


def test_force_is_the_gradient_of_the_energy():
    for error in np.random.default_rng(0).normal(scale=0.05, size=(50, 2)):
        step = 1e-7 * np.eye(2)
        gradient = [(spring_energy(K, F, error + d) - spring_energy(K, F, error - d)) / 2e-7 for d in step]
        np.testing.assert_allclose(gradient, np.clip(K * error, -F, F), atol=1e-5)


def test_share_adds_no_more_than_the_energy():
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(300):
        errors = tuple(rng.normal(scale=0.05, size=(2, 2)))
        limits = F * rng.uniform(0.2, 1.0), F
        energy = 10.0 ** rng.uniform(-4, 0)
        share = admissible_share(K, limits, errors, energy)
        after = [first + share * (second - first) for first, second in (limits, errors)]
        added = spring_energy(K, after[0], after[1]) - spring_energy(K, limits[0], errors[0])
        assert added <= energy + 1e-12
        if share < 1.0:
            assert added == pytest.approx(energy, rel=1e-6)
        shares.append(share)
    assert 0.2 < np.mean(np.array(shares) == 1.0) < 0.95
