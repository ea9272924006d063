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


@pytest.mark.parametrize("needs", [("template",), "template", (("demos",),), None, (3,)])
def test_needs_that_are_no_tuples_of_names_are_refused(needs):
    with pytest.raises(
        InputError, match=r"^needs of guidance 'wrong' must be tuples of .*, such as \(\('template',\),\)"
    ):
        register_guidance("wrong", needs=needs)


def test_blank_name_is_refused():
    with pytest.raises(InputError, match=r"a guidance is registered by a name, .*, not ' '"):
        register_guidance(" ")


@pytest.mark.parametrize(
    ("build", "says"),
    [
        (lambda known: None, "the builder of guidance 'wrong' must return a diagram, .*, not None"),
        (lambda known: np.zeros, "the builder of guidance 'wrong' must return a diagram, .*, not <"),
        (
            lambda known: FunctionGuidance(known, lambda action, pose: pose, action_size=2),
            r"a function of action, pose and wrench, and this one has the parameters \(action, pose\)$",
        ),
        (
            lambda known: FunctionGuidance(known, lambda action, pose, wrench: pose, action_size=1.5),
            "action_size must be a whole number of at least 1, not 1.5$",
        ),
    ],
)
def test_builder_that_returns_no_guidance_is_refused(build, says, monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "wrong", None)
    register_guidance("wrong")(build)
    with pytest.raises(InputError, match=says):
        make_env("NarrowPassage", guidance="wrong")
