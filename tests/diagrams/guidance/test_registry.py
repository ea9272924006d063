"""What a kind of guidance declares, and what follows from it."""

import numpy as np
import pytest

from guiderail.diagrams.guidance.law import LawGuidance
from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.diagrams.make import make_env


@pytest.mark.parametrize("size", [2, 3])
def test_a_tasks_symmetry_is_not_one_of_actions_that_mean_something_else(size, monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "of_mine", None)  # no other test has this one

    @register_guidance("of_mine")
    def of_mine(known):
        return LawGuidance(known, lambda action, pose, wrench: pose + 0.001 * action.sum(), action_size=size)

    env = make_env("BncConnector", guidance="of_mine")
    assert env.action_space.shape == (size,)
    assert env.task.symmetry is env.task.near_symmetry is None
    env.reset(seed=0)
    env.step(np.zeros(size))


def test_where_an_action_displaces_the_explored_outputs_the_tasks_symmetry_holds():
    displacing = {name for name in GUIDANCE.names() if GUIDANCE.get(name).displaces}
    assert displacing == {"kgrl", "skgrl", "residual", "safe_residual", "kmp"}
    env = make_env("BncConnector", guidance="kgrl")
    np.testing.assert_array_equal(env.task.symmetry.actions, [-np.eye(2)])
    assert len(env.task.near_symmetry.actions) > 1
