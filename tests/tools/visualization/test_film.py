import numpy as np
import pytest

from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import always
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.visualization.film import MOST, Frames


@pytest.mark.parametrize("decisions", [6, 13, 23, 24, 25, 100, 250])
def test_moments_are_spread_over_an_episode_of_any_length(decisions):
    env = make_environment("Bead", {}, render_mode="human")
    env.unwrapped.length = decisions
    frames = Frames(env)
    rollout(env, always(env, np.array([-1.0, -1.0])), frames)
    assert len(frames.seen) <= MOST
    moments = [image for _, _, image in frames.spread(6)]
    assert (moments[0], moments[-1]) == (0, decisions)
    apart = np.diff(moments)
    assert apart.min() > 0
    assert apart.max() <= 0.4 * decisions
