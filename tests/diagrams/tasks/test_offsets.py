"""Training and held-out random streams."""

import numpy as np

from guiderail.diagrams.tasks.offsets import episode_stream


def test_held_out_starts_differ_from_training_and_repeat():
    drawn = {
        held_out: np.array(
            [episode_stream(np.random.default_rng(seed), held_out).uniform(size=3) for seed in range(50)]
        )
        for held_out in (False, True)
    }
    assert not np.isin(drawn[True], drawn[False]).any()
    second = episode_stream(np.random.default_rng(7), True).uniform(size=3)
    np.testing.assert_array_equal(second, drawn[True][7])


def test_the_next_episode_is_the_same_whichever_this_one_was():
    after = []
    for held_out in (False, True):
        rng = np.random.default_rng(3)
        episode_stream(rng, held_out).uniform(size=100)
        after.append(episode_stream(rng, False).uniform())
    assert after[0] == after[1]
