"""Random streams of training episodes and held-out episodes."""

import numpy as np

from guiderail.diagrams.tasks.options import episode_stream


def test_held_out_samples_differ_from_training_and_repeat():
    samples = {
        held_out: np.array(
            [episode_stream(np.random.default_rng(seed), held_out).uniform(size=3) for seed in range(50)]
        )
        for held_out in (False, True)
    }
    assert not np.isin(samples[True], samples[False]).any()
    second = episode_stream(np.random.default_rng(7), True).uniform(size=3)
    np.testing.assert_array_equal(second, samples[True][7])


def test_next_episode_is_independent_of_the_kind_of_episode():
    next_samples = []
    for held_out in (False, True):
        rng = np.random.default_rng(3)
        episode_stream(rng, held_out).uniform(size=100)
        next_samples.append(episode_stream(rng, False).uniform())
    assert next_samples[0] == next_samples[1]
