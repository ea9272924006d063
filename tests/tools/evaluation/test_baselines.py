import numpy as np
import pytest

from guiderail.diagrams.tasks.bnc_connector import GAIN, NUM_STEPS, PRESSING, SCALED_RIM, TIME, TORQUE_X, TORQUE_Y, Z
from guiderail.diagrams.tasks.grid_clamp import (
    scripted_fast_search,
    scripted_gentle_search,
    scripted_search,
    straight_descent,
)
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy
from guiderail.tools.evaluation.baselines import find_scripted_policy, scripted_policies
from guiderail.tools.evaluation.evaluate import evaluate
from guiderail.tools.learning.run_folder import RunFolder, configure
from guiderail.tools.visualization import replay


def scripted_network():
    """Return the scripted policy as the weights of a network."""
    first, last = (2.0 * step / NUM_STEPS - 1.0 for step in PRESSING)
    features = np.zeros((7, 13), np.float32)  # torques of both signs; too early, too late, too low
    features[[0, 1, 2, 3], [TORQUE_Y, TORQUE_Y, TORQUE_X, TORQUE_X]] = [-1.0, 1.0, 1.0, -1.0]
    features[[4, 5, 6], [TIME, TIME, Z]] = [-1.0, 1.0, -1.0]
    thresholds = np.array([0.0, 0.0, 0.0, 0.0, first, -last, SCALED_RIM], np.float32)
    gates = np.hstack([np.eye(4), np.full((4, 3), -100.0)]).astype(np.float32)
    actions = 2.0 * GAIN * np.array([[1, -1, 0, 0], [0, 0, 1, -1]], np.float32)
    layers = [(features, thresholds), (gates, np.zeros(4, np.float32)), (actions, np.zeros(2, np.float32))]
    spaces = {"observation_shape": [13], "action_low": [-1, -1], "action_high": [1, 1]}
    return Policy(layers, {"format": FORMAT, "pool": 1} | spaces)


def test_policy_of_a_gantry_run_succeeds_on_the_arm(tmp_path):
    folder = RunFolder(tmp_path / "run")
    config = configure("BncConnector", {"guidance": "kgrl", "fixture_offset": "per_episode"}, episodes=1, seed=3)
    folder.create(config)
    scripted_network().save(folder.path)

    arm = {"station": "arm"}
    assert evaluate(folder.path, episodes=1, environment=arm, seed=1_000_003, baselines=())["success_rate"] == 1.0
    assert replay.default_page(folder.path, arm) == folder.path / "replay-arm.html"


def test_scripted_policy_is_found_by_name_or_as_the_default():
    assert find_scripted_policy("GridClamp", "scripted") is scripted_search
    assert find_scripted_policy("GridClamp", "scripted", "hard") is scripted_fast_search
    assert find_scripted_policy("GridClamp", "scripted", "hard_6s") is scripted_gentle_search
    assert find_scripted_policy("GridClamp", "straight_descent") is straight_descent
    with pytest.raises(InputError, match="did you mean scripted_torque_search"):
        find_scripted_policy("BncConnector", "scripted_torqe_search")
    with pytest.raises(InputError, match="lab/Peg has no policy 'scripted'"):
        find_scripted_policy("lab/Peg", "scripted")


@pytest.mark.parametrize("task", ["BncConnector", "GridClamp", "NarrowPassage", "Pouring"])
def test_scripted_policies_have_the_same_names_per_difficulty(task):
    names = [set(scripted_policies(task, difficulty)) for difficulty in ("standard", *TASKS.get(task).presets)]
    assert names[0]
    assert all(names_of_difficulty == names[0] for names_of_difficulty in names)
