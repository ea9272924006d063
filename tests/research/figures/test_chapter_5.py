"""What a figure shows is what it says."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.visualization.episode_spec import EpisodeSpec
from research.figures.chapter_5 import _first


def sometimes(rng, size):
    """One action an episode, to the goal or away from it."""
    action = np.full(size, rng.choice([-1.0, 1.0]))
    return lambda observation: action


def acting(seed):
    return EpisodeSpec("Bead", {}, lambda env: BaselinePolicy(sometimes, env, seed=seed), "at random", "", seed=5)


@pytest.mark.parametrize("success", [True, False])
def test_the_first_episode_that_ends_so_ends_so_where_it_is_shown(success):
    found = _first(acting(seed=3), success=success)
    env = make_environment(found.task, found.environment)
    env.reset(seed=found.run_seed)
    row = rollout(env, found.policy(env), seed=found.seed, held_out=True)
    env.close()
    assert bool(row["success"]) == success


def test_an_episode_that_only_who_goes_on_would_have_is_none():
    """Whoever acts at random begins anew where he is shown: with this seed, away from the goal."""
    with pytest.raises(InputError, match="all ended alike"):
        _first(acting(seed=6), success=True)
