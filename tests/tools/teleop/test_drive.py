import numpy as np
import pytest

from guiderail.diagrams.envs.make import make_env
from guiderail.diagrams.tasks.pouring.scripted import scripted_pour
from guiderail.models.policy import Policy
from guiderail.tools.teleop.teleoperator import AXES, KEYS, drive


@pytest.mark.filterwarnings("ignore:.*nothing to render")
def test_whoever_drives_drives_the_same_diagram():
    assert drive(make_env("Pouring", action_repeat=50), scripted_pour, episodes=1) == ["success"]
    still = (np.zeros((3, 6), np.float32), np.zeros(3, np.float32))  # a network that always says zero
    shapes = {"observation_shape": [6], "action_low": [-1.0] * 3, "action_high": [1.0] * 3}
    policy = Policy([still], shapes | {"activation": "relu", "pool": 1})
    assert drive(make_env("Pouring", action_repeat=50, time_limit=3.0), policy, episodes=1) == ["time_limit"]


def test_every_input_has_keys_and_an_axis_of_its_own():
    assert len(AXES) == len(KEYS) == len({axis for axis, _ in AXES})
    keys = [key for pair in KEYS for key in pair]
    assert len(set(keys)) == len(keys)
