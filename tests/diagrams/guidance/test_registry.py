"""Registration of guidance: symmetry, ports, requirements and builders."""

import numpy as np
import pytest
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import PassThrough

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.guidance.guidance import Guidance
from guiderail.diagrams.guidance.registry import GUIDANCE, check_guidance, register_guidance
from guiderail.models.common.errors import InputError
from guiderail.models.laws import Law


class Offset(Law):
    """Law that displaces the measured pose by the sum of the action."""

    def command(self, last, action, pose, wrench):
        return pose + 0.001 * action.sum()


class Incomplete(Law):
    """Law whose command lacks parameters."""

    def command(self, action, pose):
        return pose


@pytest.mark.parametrize("size", [2, 3])
def test_symmetry_is_absent_when_actions_do_not_displace(size, monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "own", None)

    @register_guidance("own")
    def build(prior):
        return Offset(prior.pose_size, size)

    env = make_env("BncConnector", guidance="own")
    assert env.action_space.shape == (size,)
    assert env.diagram.symmetry is env.diagram.near_symmetry is None
    env.reset(seed=0)
    env.step(np.zeros(size))


def test_symmetry_is_present_when_actions_displace_outputs():
    displacing = {name for name in GUIDANCE.names() if GUIDANCE.get(name).displaces}
    assert displacing == {
        "kgrl", "skgrl", "residual", "safe_residual", "kmp", "residual_covariance", "residual_cbf",
        "residual_tangent",
    }  # fmt: skip
    env = make_env("BncConnector", guidance="kgrl")
    np.testing.assert_array_equal(env.diagram.symmetry.actions, [-np.eye(2)])
    assert len(env.diagram.near_symmetry.actions) > 1


def test_guidance_without_a_port_is_refused_by_its_name(monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "incomplete", None)

    @register_guidance("incomplete")
    def build(prior):
        guidance, builder = Guidance(), DiagramBuilder()
        builder.ExportInput(builder.AddSystem(PassThrough(2)).get_input_port(), "action")
        builder.BuildInto(guidance)
        return guidance

    with pytest.raises(InputError, match=r"guidance 'incomplete' lacks the port pose, wrench, .*from a PassThrough"):
        make_env("NarrowPassage", guidance="incomplete")


def test_unknown_need_is_refused():
    with pytest.raises(InputError, match="guidance 'wrong' needs 'demonstration': did you mean demonstrations"):
        register_guidance("wrong", needs=(("demonstration",),))
    for needs in (("demonstrations",), "demonstrations"):
        with pytest.raises(
            InputError, match=r"needs of 'wrong' is a tuple of tuples, as in \(\(\"demonstrations\",\),\)"
        ):
            register_guidance("wrong", needs=needs)


def test_guidance_without_an_alternative_names_the_prior():
    with pytest.raises(InputError, match=r"which lab/Post doesn't have: return a Prior with it from prior\(\)$"):
        check_guidance("skgrl", (), "lab/Post")


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda prior: Incomplete(prior.pose_size),
            r"command of Incomplete must have the parameters .*, not \(self, action, pose\)$",
        ),
        (lambda prior: Offset(3), "the pose has size 2: give the law as many outputs, not 3"),
    ],
)
def test_builder_is_refused_when_returning_no_guidance(build, message, monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "wrong", None)
    register_guidance("wrong")(build)
    with pytest.raises(InputError, match=message):
        make_env("NarrowPassage", guidance="wrong")


def test_law_with_memory_runs_as_registered_class(monkeypatch):
    monkeypatch.setitem(GUIDANCE._entries, "integrator", None)

    @register_guidance("integrator")
    class Integrator(Law):
        def command(self, last, action, pose, wrench):
            return last + 0.01 * action / (1.0 + self.known.period)

    env = make_env("NarrowPassage", guidance="integrator", action_repeat=5)
    for _ in range(2):
        env.reset(seed=0)
        for _ in range(4):
            env.step(np.array([0.0, 0.5]))
        moved = np.ptp(env.trace.commanded, axis=0)
        assert moved[0] == 0.0
        np.testing.assert_allclose(np.diff(env.trace.commanded[:, 1], n=2), 0.0, atol=1e-12)
        assert moved[1] > 0.05
