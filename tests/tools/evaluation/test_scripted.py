import numpy as np
import pytest

from guiderail.diagrams.tasks.bnc_connector.task import NUM_STEPS
from guiderail.diagrams.tasks.grid_clamp.task import CENTRE, SCALE
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.policy import FORMAT, Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.scripted import (
    FORCE_Z,
    GAIN,
    LANE_ENDS,
    LANES,
    ON_RIM,
    SCRIPTED_POLICIES,
    SEARCH,
    TIME,
    TORQUE_X,
    TORQUE_Y,
    Z,
    find_scripted_policy,
    scripted_search,
    scripted_torque_search,
)
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.learning.train import configure
from guiderail.tools.visualization import replay
from guiderail.tools.visualization.episode_spec import EpisodeSpec


def seen_plug(**values):
    names = {"time": TIME, "z": Z, "force_z": FORCE_Z, "torque_x": TORQUE_X, "torque_y": TORQUE_Y}
    result = np.zeros(13)
    searching = {"time": -0.4, "z": 0.68, "force_z": 0.5}
    for name, value in (searching | values).items():
        result[names[name]] = value
    return result


def test_moves_against_the_torque():
    """Off by +x, the rim pushes up at −x of the centre: that turns the plug about +y."""
    assert scripted_torque_search(seen_plug(torque_y=0.4))[0] < 0.0
    assert scripted_torque_search(seen_plug(torque_x=0.4))[1] > 0.0


@pytest.mark.parametrize("elsewhere", [{"time": -0.9}, {"time": 0.5}, {"z": 0.3}, {"force_z": 0.0}])
def test_stands_still_unless_it_stands_on_the_rim(elsewhere):
    np.testing.assert_array_equal(
        scripted_torque_search(seen_plug(torque_x=1.0, torque_y=1.0, **elsewhere)), np.zeros(2)
    )


def test_stays_within_an_actions_bounds():
    assert np.abs(scripted_torque_search(seen_plug(torque_x=3.0, torque_y=-3.0))).max() == 1.0


def rule_as_a_network():
    """The rule as weights of a policy: what a run leaves, and what learning could arrive at."""
    first, last = (2.0 * step / NUM_STEPS - 1.0 for step in SEARCH)
    features = np.zeros((7, 13), np.float32)  # both torques with either sign; too early, too late, too low
    features[[0, 1, 2, 3], [TORQUE_Y, TORQUE_Y, TORQUE_X, TORQUE_X]] = [-1.0, 1.0, 1.0, -1.0]
    features[[4, 5, 6], [TIME, TIME, Z]] = [-1.0, 1.0, -1.0]
    thresholds = np.array([0.0, 0.0, 0.0, 0.0, first, -last, ON_RIM], np.float32)
    gates = np.hstack([np.eye(4), np.full((4, 3), -100.0)]).astype(np.float32)
    actions = 2.0 * GAIN * np.array([[1, -1, 0, 0], [0, 0, 1, -1]], np.float32)
    layers = [(features, thresholds), (gates, np.zeros(4, np.float32)), (actions, np.zeros(2, np.float32))]
    spaces = {"observation_shape": [13], "action_low": [-1, -1], "action_high": [1, 1]}
    return Policy(layers, {"format": FORMAT, "pool": 1} | spaces)


def test_a_policy_of_a_run_on_rails_drives_the_arm_too_and_is_shown_there(tmp_path, monkeypatch):
    folder = RunFolder(tmp_path / "run")
    config = configure("BncConnector", {"guidance": "kgrl", "fixture_offset": "per_episode"}, episodes=1, seed=3)
    folder.create(config)
    rule_as_a_network().save(folder.path)

    rails = make_environment(config.task, config.environment)
    row = rollout(rails, Policy.load(folder.path), seed=1_000_003, held_out=True)
    assert row["success"]
    assert row["max_commanded_violation"] <= 1e-9

    monkeypatch.setattr(replay, "EPISODES", 1)
    arm = {"station": "arm"}
    html = replay.default_page(folder.path, arm)
    replay.write_page(html, EpisodeSpec.of_run(folder.path, arm, 1_000_003))
    page = html.read_text()
    assert '"outcome":"success after' in page.partition('"name":"after"')[2]
    assert "the arm</button>" in page
    assert html == folder.path / "replay-arm.html"


def seen_clamp(x_mm=0.0, y_mm=0.0, z_mm=12.0, fx=0.0, fy=0.0, fz=4.0):
    seen = np.array([x_mm * MM, y_mm * MM, z_mm * MM, fx, fy, fz])
    return (seen - CENTRE) / SCALE


def test_goes_to_where_it_begins_before_it_comes_down():
    inputs = scripted_search(seen_clamp(z_mm=15.0, fz=0.0))
    assert inputs[0] < -0.3
    assert inputs[2] == 0.0
    there = scripted_search(seen_clamp(-LANE_ENDS / MM, LANES[0] / MM, 15.0, fz=0.0))
    np.testing.assert_allclose(there, [0.0, 0.0, -1.0], atol=1e-9)


def test_lanes_lead_each_the_other_way():
    along = [np.sign(scripted_search(seen_clamp(0.0, y / MM))[0]) for y in LANES]
    assert along == [1.0, -1.0, 1.0]
    assert scripted_search(seen_clamp(LANE_ENDS / MM, LANES[0] / MM))[1] > 0.0


def test_presses_lightly_and_gives_way_in_a_hole():
    assert scripted_search(seen_clamp(fz=8.0))[2] > 0.0 > scripted_search(seen_clamp(fz=1.0))[2]
    np.testing.assert_array_less(0.0, scripted_search(seen_clamp(z_mm=8.0, fx=2.0, fy=1.0))[:2])


def test_the_clamps_rule_stays_within_an_inputs_bounds():
    for fz in (-30.0, 30.0):
        assert np.abs(scripted_search(seen_clamp(4.0, 4.0, 5.0, 20.0, -20.0, fz))).max() <= 1.0


def test_a_rule_is_found_by_its_name_or_as_the_tasks_own():
    assert find_scripted_policy("GridClamp", "scripted") is scripted_search
    assert find_scripted_policy("GridClamp", "straight_descent") is SCRIPTED_POLICIES["GridClamp"]["straight_descent"]
    with pytest.raises(InputError, match="did you mean scripted_torque_search"):
        find_scripted_policy("BncConnector", "reactiv_rule")
    with pytest.raises(InputError, match="lab/Peg has no policy 'rule'"):
        find_scripted_policy("lab/Peg", "scripted")
