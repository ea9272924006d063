"""Declarations of kinds of guidance and their effect."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import PassThrough

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.guidance.guidance import FunctionGuidance, Guidance
from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.models.common.errors import InputError


@pytest.mark.parametrize("size", [2, 3])
def test_symmetry_is_absent_when_actions_do_not_displace(size, monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "of_mine", None)  # no other test has this one

    @register_guidance("of_mine")
    def of_mine(known):
        return FunctionGuidance(known, lambda action, pose, wrench: pose + 0.001 * action.sum(), action_size=size)

    env = make_env("BncConnector", guidance="of_mine")
    assert env.action_space.shape == (size,)
    assert env.task.symmetry is env.task.near_symmetry is None
    env.reset(seed=0)
    env.step(np.zeros(size))


def test_symmetry_holds_when_actions_displace_outputs():
    displacing = {name for name in GUIDANCE.names() if GUIDANCE.get(name).displaces}
    assert displacing == {
        "kgrl",
        "skgrl",
        "residual",
        "safe_residual",
        "kmp",
        "residual_covariance",
        "residual_cbf",
        "residual_tangent",
    }
    env = make_env("BncConnector", guidance="kgrl")
    np.testing.assert_array_equal(env.task.symmetry.actions, [-np.eye(2)])
    assert len(env.task.near_symmetry.actions) > 1


def test_guidance_that_lacks_a_port_is_named_by_its_kind(monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "deaf_of_mine", None)  # no other test has this one

    @register_guidance("deaf_of_mine")
    def deaf(known):
        guidance, builder = Guidance(), DiagramBuilder()
        builder.ExportInput(builder.AddSystem(PassThrough(2)).get_input_port(), "action")
        builder.BuildInto(guidance)
        return guidance

    with pytest.raises(InputError, match=r"guidance 'deaf_of_mine' lacks the port pose, wrench, .*from a PassThrough"):
        make_env("NarrowPassage", guidance="deaf_of_mine")
