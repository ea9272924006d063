"""Episodes of a teleoperated environment that a policy controls, and the operator's inputs."""

import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.pouring import scripted_pour
from guiderail.models.policy import Policy
from guiderail_hardware.teleop.recorder import run_episode
from guiderail_hardware.teleop.teleoperator import GAMEPAD_AXES, KEY_PAIRS


@pytest.mark.filterwarnings("ignore:.*nothing to render")
def test_run_episode_accepts_a_function_and_a_network():
    assert run_episode(make_env("Pouring", action_repeat=50), scripted_pour) == "success"
    zero = (np.zeros((3, 6), np.float32), np.zeros(3, np.float32))  # weights and biases of a layer with zero output
    shapes = {"observation_shape": [6], "action_low": [-1.0] * 3, "action_high": [1.0] * 3}
    policy = Policy([zero], shapes | {"activation": "relu", "pool": 1})
    assert run_episode(make_env("Pouring", action_repeat=50, time_limit=3.0), policy) == "time_limit"


def test_each_input_has_a_separate_gamepad_axis():
    assert len(GAMEPAD_AXES) == len(KEY_PAIRS) == len({axis for axis, _ in GAMEPAD_AXES})
