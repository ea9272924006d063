import numpy as np
import pytest

from guiderail.tools.viewing.film import FRAMES, Frames


@pytest.mark.parametrize("decisions", [6, 13, 23, 24, 25, 100, 250])
def test_moments_are_spread_over_an_episode_of_any_length(decisions):
    frames = Frames([0])
    for decision in range(1, decisions + 1):
        if decision == decisions or frames.due(decision):
            frames.keep(decision)
    assert len(frames.seen) <= FRAMES
    moments = frames.spread(6)
    assert (moments[0], moments[-1]) == (0, decisions)
    apart = np.diff(moments)
    assert apart.min() > 0
    assert apart.max() <= 0.4 * decisions
