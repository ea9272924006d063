"""Sampled offsets of jack and plug, and tilt of the plug in the tool."""

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.bnc_connector.options import LARGEST_GRASP_ANGLE, BncUncertainty
from guiderail.diagrams.tasks.bnc_connector.task import scripted_torque_search
from guiderail.diagrams.tasks.insertion import InsertionReset
from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.evaluate import evaluate_policy


def sample_offsets(uncertainty, count, seed=0):
    """Return `count` samples of the offset of the jack, followed by offset and tilt of the plug."""
    rng = np.random.default_rng(seed)
    return [np.concatenate(uncertainty.draw(rng, InsertionReset())) for _ in range(count)]


@pytest.mark.parametrize("kind", ["per_run", "per_episode", "none"])
def test_tilt_is_within_its_range_and_changes_no_offset(kind):
    straight, tilted = (
        sample_offsets(BncUncertainty(kind), 50),
        sample_offsets(BncUncertainty(kind, grasp_angle=1.0), 50),
    )
    assert np.shape(straight) == (50, 4)
    angles = np.linalg.norm(np.array(tilted)[:, 4:], axis=1)
    assert 0.8 < np.rad2deg(angles.max()) <= 1.0
    assert len(np.unique(angles)) == 50
    np.testing.assert_array_equal(np.array(tilted)[:, :4], straight)


def test_tilt_is_zero_when_the_offset_is_given():
    reset = InsertionReset(offset=(0.0, 1e-3))
    _, plug = BncUncertainty("per_episode", grasp_angle=1.0).draw(np.random.default_rng(0), reset)
    np.testing.assert_array_equal(plug, 0.0)


@pytest.mark.parametrize("angle", [-0.1, LARGEST_GRASP_ANGLE + 0.1, np.nan])
def test_grasp_angle_is_refused_when_out_of_range(angle):
    with pytest.raises(InputError, match="grasp_angle"):
        make_env("BncConnector", grasp_angle=angle)


def test_plug_is_tilted_in_the_tool():
    env = make_env("BncConnector", guidance="kmp", fixture_offset="per_episode", grasp_angle=1.0)
    _, info = env.reset(seed=0)
    plant = env.diagram.diagram.GetSubsystemByName("station").plant
    context = plant.GetMyContextFromRoot(env.simulator.get_context())
    tool, plug = plant.GetBodyByName("tool_center"), plant.GetBodyByName("plug")
    tilt = plug.body_frame().CalcRotationMatrix(context, tool.body_frame()).ToAngleAxis().angle()
    assert tilt == pytest.approx(np.linalg.norm(info["grasp_offset"][2:]), rel=1e-3)


def test_torque_search_locks_a_tilted_plug():
    env = make_env("BncConnector", guidance="kgrl", fixture_offset="per_episode", grasp_angle=1.0)
    assert evaluate_policy(env, scripted_torque_search, episodes=2, options={"new_run": True})["success"].sum() == 2
