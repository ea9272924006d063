import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.pouring.task import scripted_pour
from guiderail.models.policy import Policy
from guiderail.tools.teleop.recorder import run_episode
from guiderail.tools.teleop.teleoperator import GAMEPAD_AXES, KEY_PAIRS


@pytest.mark.filterwarnings("ignore:.*nothing to render")
def test_scripted_policy_and_network_run_the_same_episode():
    assert run_episode(make_env("Pouring", action_repeat=50), scripted_pour) == "success"
    zero = (np.zeros((3, 6), np.float32), np.zeros(3, np.float32))  # a layer with zero output
    shapes = {"observation_shape": [6], "action_low": [-1.0] * 3, "action_high": [1.0] * 3}
    policy = Policy([zero], shapes | {"activation": "relu", "pool": 1})
    assert run_episode(make_env("Pouring", action_repeat=50, time_limit=3.0), policy) == "time_limit"


def test_inputs_have_keys_and_axes_of_their_own():
    assert len(GAMEPAD_AXES) == len(KEY_PAIRS) == len({axis for axis, _ in GAMEPAD_AXES})
    keys = [key for pair in KEY_PAIRS for key in pair]
    assert len(set(keys)) == len(keys)
