"""NarrowPassage at difficulty `hard`: half the gap width, and two obstacles whose contact ends the episode."""

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.narrow_passage import HARD, NarrowPassage, scripted_slalom
from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.tools.evaluation.baselines import BASELINES, constant_policy, zero_policy
from guiderail.tools.evaluation.rollout import rollout


@pytest.fixture(scope="module", params=["skgrl", "kgrl"])
def env(request):
    return make_env("NarrowPassage", difficulty="hard", guidance=request.param)


def test_scripted_policy_succeeds_and_zero_policy_collides(env):
    row = rollout(env, scripted_slalom, seed=0, held_out=True)
    assert row["success"]
    assert row["max_commanded_violation"] <= 1e-9
    row = rollout(env, zero_policy(env), seed=0, held_out=True)
    assert row["termination"] == "collision"


def test_constant_action_collides_on_both_sides(env):
    for side in (-1.0, 1.0):
        row = rollout(env, constant_policy(env, np.array([side, 0.0])), seed=1)
        assert row["termination"] == "collision"


@pytest.mark.parametrize("name", ["uniform_random", "random_hold", "bang_bang", "random_corner"])
def test_commands_satisfy_the_constraints_under_any_action(env, name):
    for seed in range(2):
        row = rollout(env, BASELINES[name](np.random.default_rng(seed), 2), seed=seed)
        assert row["max_commanded_violation"] <= 1e-9


def test_obstacles_are_on_opposite_sides_and_observed(env):
    nominal, sides = NarrowPassage(**HARD).geometry.obstacles, []
    starts = []
    for seed in range(8):
        observation, info = env.reset(seed=seed)
        offsets = (info["obstacles"] - nominal) / HARD["obstacle_beside"]
        np.testing.assert_allclose(observation[1:], offsets.ravel(), atol=1e-6)
        np.testing.assert_allclose(np.abs(offsets), [[1.0, 0.0], [1.0, 0.0]], atol=1e-9)
        assert offsets[0, 0] == pytest.approx(-offsets[1, 0])
        sides.append(np.sign(offsets[0, 0]))
        starts.append(info["start"])
    assert set(sides) == {-1.0, 1.0}
    assert 0.01 < np.std(starts, axis=0).min() < 0.1


def test_plant_has_the_obstacles_at_their_sampled_positions(env):
    _, info = env.reset(seed=2)
    plant = env.diagram.diagram.GetSubsystemByName("station").plant
    context = plant.GetMyContextFromRoot(env.simulator.get_context())
    for number, obstacle in enumerate(info["obstacles"]):
        X_WO = plant.GetBodyByName(f"obstacle_{number}").EvalPoseInWorld(context)
        np.testing.assert_allclose(X_WO.translation()[:2], obstacle, atol=1e-12)


def test_standard_has_the_default_geometry_and_start():
    assert NarrowPassage().geometry == PassageGeometry()
    standard = make_env("NarrowPassage")
    assert standard.observation_space.shape == (1,)
    _, info = standard.reset(seed=3)
    np.testing.assert_array_equal(info["start"], standard.diagram.config.reference().means[0])
