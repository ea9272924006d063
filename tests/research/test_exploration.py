"""Samplers of exploration noise."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from research.exploration import RMS, low_pass, open_loop, ornstein_uhlenbeck, pink, state_dependent, uniform

STEPS, SIZE = 400, 2
SAMPLERS = {
    "uniform": (uniform, {}),
    "repeat": (uniform, {"action_repeat": 7}),
    "pink": (pink, {}),
    "ou": (ornstein_uhlenbeck, {}),
    "low_pass": (low_pass, {"cutoff": 1.0}),
}


def sequence(name, seed=0):
    """Return the actions of a sampler, (STEPS, SIZE)."""
    sample, arguments = SAMPLERS[name]
    act = open_loop(sample, np.random.default_rng(seed), STEPS, SIZE, **arguments)
    return np.array([act(np.zeros(3)) for _ in range(STEPS)])


def roughness(actions):
    """Return the RMS of the third differences of actions."""
    return np.sqrt(np.mean(np.diff(actions, 3, axis=0) ** 2))


@pytest.mark.parametrize("name", SAMPLERS)
def test_samplers_have_the_same_rms_and_limits(name):
    actions = sequence(name)
    np.testing.assert_allclose(np.sqrt(np.mean(actions**2, axis=0)), RMS, rtol=1e-3)
    assert np.abs(actions).max() <= 1.0
    np.testing.assert_array_equal(actions, sequence(name))
    assert not np.array_equal(actions, sequence(name, seed=1))


def test_uniform_repeats_each_action():
    actions = sequence("repeat")
    changes = np.flatnonzero(np.abs(np.diff(actions, axis=0)).sum(axis=1)) + 1
    np.testing.assert_array_equal(changes, np.arange(7, STEPS, 7))


def test_filtered_noise_is_smoother_than_uniform():
    assert roughness(sequence("low_pass")) < 0.05 * roughness(sequence("uniform"))
    assert roughness(sequence("pink")) < roughness(sequence("uniform"))
    assert roughness(sequence("ou")) < roughness(sequence("uniform"))


def test_pink_noise_has_the_same_power_in_every_octave():
    rng = np.random.default_rng(0)
    power = np.mean([np.abs(np.fft.rfft(pink(rng, 1024, 1)[:, 0])) ** 2 for _ in range(200)], axis=0)
    octaves = [power[n : 2 * n].sum() for n in (8, 16, 32, 64, 128)]
    assert max(octaves) < 1.2 * min(octaves)


def test_state_dependent_noise_is_resampled_after_the_interval():
    act = state_dependent(np.random.default_rng(0), STEPS, SIZE, interval=3)
    states = [np.ones(5), np.ones(5), 2.0 * np.ones(5) - np.arange(5), np.ones(5)]
    first, repeated, other_state, resampled = (act(state) for state in states)
    np.testing.assert_array_equal(first, repeated)
    assert not np.allclose(first, other_state)
    assert not np.allclose(first, resampled)


def test_state_dependent_noise_is_zero_for_a_zero_observation():
    act = state_dependent(np.random.default_rng(0), STEPS, SIZE, interval=3)
    np.testing.assert_array_equal(act(np.zeros(5)), np.zeros(SIZE))


def test_open_loop_refuses_zero_steps():
    with pytest.raises(InputError):
        open_loop(uniform, np.random.default_rng(0), 0, 2)
