"""Energy of clipped springs, and the share of a change that an energy allows."""

import numpy as np
import pytest

from guiderail.models.control.wrench import admissible_change, spring_energy

K, F = np.array([1500.0, 30.0]), np.array([15.0, 3.0])


def test_force_is_the_gradient_of_the_energy():
    for error in np.random.default_rng(0).normal(scale=0.05, size=(50, 2)):
        step = 1e-7 * np.eye(2)
        gradient = [(spring_energy(K, F, error + d) - spring_energy(K, F, error - d)) / 2e-7 for d in step]
        np.testing.assert_allclose(gradient, np.clip(K * error, -F, F), atol=1e-5)


def test_change_stores_no_more_than_the_energy():
    rng = np.random.default_rng(1)
    shares = []
    for _ in range(300):
        errors = tuple(rng.normal(scale=0.05, size=(2, 2)))
        limits = F * rng.uniform(0.2, 1.0), F
        before = spring_energy(K, limits[0], errors[0])
        energy = before + 10.0 ** rng.uniform(-4, 0)
        share, stored = admissible_change(K, limits, errors, energy)
        after = [first + share * (second - first) for first, second in (limits, errors)]
        assert stored == pytest.approx(spring_energy(K, *after), rel=1e-12)
        assert stored <= energy
        if share < 1.0:
            assert stored - before == pytest.approx(energy - before, rel=1e-6)
        shares.append(share)
    assert 0.2 < np.mean(np.array(shares) == 1.0) < 0.95
