"""An environment with a reused diagram equals one with a new diagram."""

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env

CASES = {
    "passage": ("NarrowPassage", {"difficulty": "hard", "guidance": "kgrl"}),
    "pouring": ("Pouring", {"difficulty": "hard"}),
    "connector": ("BncConnector", {"fixture_offset": "per_episode"}),
}


def first_observations(task, options):
    """Return the first two observations and the sampled values of two episodes."""
    env = make_env(task, **options)
    diagram, result = env.task.diagram, []
    for seed in (1, 2):
        observation, info = env.reset(seed=seed)
        after = env.step(env.action_space.low)
        result.append((observation, after[0], after[1], {k: v for k, v in info.items() if isinstance(v, np.ndarray)}))
    env.close()
    return diagram, result


@pytest.mark.parametrize("case", CASES)
def test_reset_values_reach_a_reused_diagram(case):
    first, expected = first_observations(*CASES[case])
    second, result = first_observations(*CASES[case])
    assert second is first
    for one, other in zip(expected, result, strict=True):
        np.testing.assert_equal(other, one)
    (*_, before), (*_, after) = expected
    assert not all(np.array_equal(before[name], after[name]) for name in before)
