"""Frames that show an episode in a picture."""

import numpy as np
import pytest

from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import constant_policy
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.visualization.camera import MAX_FRAMES, Frames


@pytest.mark.parametrize("actions", [6, 13, 23, 24, 25, 100, 250])
def test_frames_are_evenly_spaced_for_any_episode_length(actions):
    env = make_environment("Bead", {}, render_mode="human")
    env.unwrapped.length = actions
    frames = Frames(env)
    rollout(env, constant_policy(env, np.array([-1.0, -1.0])), frames)
    assert len(frames.frames) <= MAX_FRAMES
    images = [image for _, _, image in frames.select(6)]
    assert (images[0], images[-1]) == (0, actions)
    steps = np.diff(images)
    assert steps.min() > 0
    assert steps.max() <= 0.4 * actions
