"""An environment with a reused diagram equals one with a new diagram."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder

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


def test_diagram_inside_another_one_is_not_used_again():
    env = make_env("NarrowPassage", gap_width=0.041)
    builder = DiagramBuilder()
    builder.AddSystem(env.task.diagram)
    outer = builder.Build()
    env.close()
    make_env("NarrowPassage", gap_width=0.041).reset(seed=0)
    assert outer.num_input_ports() == 0
