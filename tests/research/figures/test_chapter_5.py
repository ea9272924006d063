"""Selection of the episodes in figure 5.7."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import EpisodeSpec
from research.figures.chapter_5 import _first


def random_direction(rng, size):
    """Return a policy whose constant action points to the goal or away from the goal, at random."""
    action = np.full(size, rng.choice([-1.0, 1.0]))
    return lambda observation: action


def random_spec(seed):
    """Return a subject whose policy has a random direction in each episode."""
    return EpisodeSpec(
        "Bead", {}, lambda env: BaselinePolicy(random_direction, env, seed=seed), "at random", "", seed=5
    )


@pytest.mark.parametrize("success", [True, False])
def test_selected_episode_ends_as_requested_when_repeated(success):
    selected = _first(random_spec(seed=3), success=success)
    env = make_environment(selected.task, selected.environment)
    env.reset(seed=selected.run_seed)
    row = rollout(env, selected.policy(env), seed=selected.seed, held_out=True)
    env.close()
    assert bool(row["success"]) == success


def test_selection_uses_a_new_random_stream_per_episode():
    """The first direction of each new stream of this seed points away from the goal."""
    with pytest.raises(InputError, match="all ended alike"):
        _first(random_spec(seed=6), success=True)
