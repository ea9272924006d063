"""Plug-in in LeRobot; run by `make lerobot`. GUIDERAIL_PYTHON is the interpreter with guiderail."""

import json
import os
import shutil
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest
import torch
from lerobot.datasets.lerobot_dataset import LeRobotDataset
from lerobot.policies.factory import get_policy_class, make_pre_post_processors
from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.utils.constants import ACTION, OBS_STATE, OBS_STR
from lerobot.utils.feature_utils import build_dataset_frame, hw_to_dataset_features
from lerobot.utils.import_utils import register_third_party_plugins
from lerobot_robot_guiderail.export import FORMAT, export, push_to_hub
from lerobot_robot_guiderail.modeling_guiderail import GuiderailPolicy
from safetensors.numpy import save_file

PYTHON = os.environ["GUIDERAIL_PYTHON"]
ENVIRONMENT, OPTIONS = "NarrowPassage", {"guidance": "kgrl", "action_repeat": 20}
CONNECTOR = {"guidance": "kgrl", "station": "gantry", "action_repeat": 10}


@pytest.fixture(autouse=True)
def home(tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    return tmp_path


def make(environment=ENVIRONMENT, options=OPTIONS, python=PYTHON, **values):
    register_third_party_plugins()
    kind = RobotConfig.get_choice_class("guiderail")
    return make_robot_from_config(kind(environment=environment, options=options, python=python, **values))


@pytest.fixture
def robot(tmp_path):
    robot = make(id="test", calibration_dir=tmp_path)
    robot.connect()
    yield robot
    if robot.is_connected:
        robot.disconnect()


def action(robot, value):
    return dict.fromkeys(robot.action_features, value)


def test_features_match_observation_and_action(robot):
    observation = robot.get_observation()
    assert list(observation) == list(robot.observation_features)
    assert all(type(value) is float for value in observation.values())
    assert set(robot.send_action(action(robot, 0.5))) == set(robot.action_features)
    assert robot.is_calibrated


def test_features_are_known_before_connecting(tmp_path, robot):
    other = make(calibration_dir=tmp_path)
    assert other.observation_features == robot.observation_features
    assert other.action_features == robot.action_features
    assert not other.is_connected


def test_connection_is_required_and_made_once(robot):
    with pytest.raises(ConnectionError, match="already connected"):
        robot.connect()
    robot.disconnect()
    assert not robot.is_connected
    for call in (robot.get_observation, robot.disconnect, lambda: robot.send_action({})):
        with pytest.raises(ConnectionError, match="not connected"):
            call()
    robot.connect()
    assert robot.is_connected


def test_process_that_ended_is_a_lost_connection(robot):
    robot._process.kill()
    robot._process.wait()
    with pytest.raises(ConnectionError):
        robot.send_action(action(robot, 0.0))


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_actions_that_are_not_finite_are_refused(robot, value):
    before = robot.get_observation()
    with pytest.raises(ValueError, match="must be finite"):
        robot.send_action(action(robot, value))
    with pytest.raises(ValueError, match="has the numbers"):
        robot.send_action({"other.pos": 0.0})
    assert robot.get_observation() == before


def test_actions_are_clipped(robot):
    assert set(robot.send_action(action(robot, 7.0)).values()) == {1.0}


def test_episode_restarts_after_its_end(robot):
    while not robot.get_observation()["episode_done.pos"]:
        robot.send_action(action(robot, 0.0))
    robot.send_action(action(robot, 0.0))
    assert not robot.get_observation()["episode_done.pos"]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"environment": "Nowhere"}, "Nowhere"),
        ({"options": {"guidance": "none of these"}}, "guidance"),
        ({"environment": "BncConnector", "options": {"station": "hardware"}}, "real robot"),
    ],
)
def test_wrong_configuration_is_refused_with_guiderails_message(tmp_path, values, message):
    with pytest.raises(ConnectionError, match=message):
        make(calibration_dir=tmp_path, **values).connect()


def test_data_set_with_wrench_is_recorded_and_replayed(tmp_path):
    robot = make("BncConnector", CONNECTOR, calibration_dir=tmp_path, seed=5)
    robot.connect()
    features = hw_to_dataset_features(robot.observation_features, OBS_STR) | hw_to_dataset_features(
        robot.action_features, ACTION
    )
    assert {"wrench_fx.pos", "wrench_tz.pos"} < set(features[OBS_STATE]["names"])
    data = LeRobotDataset.create("lab/connector", fps=10, features=features, root=tmp_path / "data", use_videos=False)
    rng, observations = np.random.default_rng(0), []
    for _ in range(30):
        observation = robot.get_observation()
        observations.append(observation)
        sent = robot.send_action({name: float(rng.uniform(-1, 1)) for name in robot.action_features})
        frame = build_dataset_frame(features, observation, OBS_STR) | build_dataset_frame(features, sent, ACTION)
        data.add_frame(frame | {"task": "insert the connector"})
    data.save_episode()
    data.finalize()
    robot.disconnect()

    stored = LeRobotDataset("lab/connector", root=tmp_path / "data")
    assert len(stored) == 30
    wrench = [features[OBS_STATE]["names"].index(f"wrench_{name}.pos") for name in ("fx", "fy", "fz")]
    robot.connect()
    forces = []
    for k in range(30):
        observation = robot.get_observation()
        np.testing.assert_allclose(list(observation.values()), stored[k][OBS_STATE].numpy(), rtol=1e-6, atol=1e-5)
        forces.append(np.linalg.norm(stored[k][OBS_STATE].numpy()[wrench]))
        robot.send_action(dict(zip(robot.action_features, stored[k][ACTION].tolist(), strict=True)))
    assert max(forces) > 0.0
    robot.disconnect()


def write_policy(folder, sizes, activation="relu", squash="tanh"):
    rng, weights, layers = np.random.default_rng(1), {}, []
    for i, (into, out) in enumerate(pairwise(sizes)):
        layers.append((rng.normal(size=(out, into)).astype("f4") / 3, rng.normal(size=out).astype("f4") / 3))
        weights |= {f"layers.{i}.weight": layers[-1][0], f"layers.{i}.bias": layers[-1][1]}
    n = sizes[-1]
    description = {
        "format": FORMAT,
        "observation_shape": [sizes[0]],
        "action_low": [-1.0] * n,
        "action_high": [1.0] * n,
    }
    folder.mkdir()
    (folder / "policy.json").write_text(json.dumps(description | {"activation": activation, "squash": squash}))
    save_file(weights, folder / "policy.safetensors")


REFERENCE = """
import json, sys
import numpy as np
from safetensors.numpy import load_file
from guiderail.models.policy import Policy
weights = load_file(sys.argv[1] + "/policy.safetensors")
layers = [(weights[f"layers.{i}.weight"], weights[f"layers.{i}.bias"]) for i in range(len(weights) // 2)]
policy = Policy(layers, json.load(open(sys.argv[1] + "/policy.json")))
print(json.dumps([policy(np.array(x, "f4")).tolist() for x in json.loads(sys.argv[2])]))
"""


@pytest.mark.parametrize(("activation", "squash"), [("relu", "tanh"), ("normalized_relu", "tanh"), ("tanh", "clip")])
def test_exported_policy_acts_as_guiderails(tmp_path, activation, squash):
    write_policy(tmp_path / "run", [7, 16, 16, 3], activation, squash)
    export(tmp_path / "run", tmp_path / "out")
    policy = get_policy_class("guiderail").from_pretrained(tmp_path / "out")
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(tmp_path / "out"))
    states = np.random.default_rng(2).normal(size=(5, 20)).astype("f4")
    command = [PYTHON, "-c", REFERENCE, str(tmp_path / "run"), json.dumps(states[:, :7].tolist())]
    expected = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    for state, reference in zip(states, expected, strict=True):
        chosen = after(policy.select_action(before({OBS_STATE: torch.from_numpy(state)})))
        np.testing.assert_allclose(chosen.squeeze(0).numpy(), reference, atol=1e-6)


def test_rollout_of_lerobot_executes_an_exported_policy(tmp_path):
    robot = make(calibration_dir=tmp_path)
    observed = sum(name.startswith("observation_") for name in robot.observation_features)
    write_policy(tmp_path / "run", [observed, 8, len(robot.action_features)])
    export(tmp_path / "run", tmp_path / "out")
    command = [
        os.path.join(os.path.dirname(sys.executable), "lerobot-rollout"),
        "--strategy.type=base",
        f"--policy.path={tmp_path / 'out'}",
        "--robot.type=guiderail",
        f"--robot.environment={ENVIRONMENT}",
        f"--robot.options={json.dumps(OPTIONS)}",
        f"--robot.python={PYTHON}",
        "--fps=10",
        "--duration=3",
        "--device=cpu",
        "--return_to_initial_position=false",
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "Duration limit reached" in done.stderr + done.stdout


COMMIT = "0123456789abcdef0123456789abcdef01234567"


class LocalHub:
    """Double of `HfApi` that stores an upload where the library keeps downloads."""

    def __init__(self, cache):
        self.cache = cache

    def create_repo(self, repo_id, **_):
        self.repository = self.cache / f"models--{repo_id.replace('/', '--')}"

    def upload_folder(self, *, repo_id, folder_path, **_):
        shutil.copytree(folder_path, self.repository / "snapshots" / COMMIT)
        (self.repository / "refs").mkdir()
        (self.repository / "refs" / "main").write_text(COMMIT)
        return f"https://huggingface.co/{repo_id}/commit/{COMMIT}"


def test_pushed_policy_is_loaded_from_the_local_cache(tmp_path, monkeypatch):
    write_policy(tmp_path / "run", [7, 8, 3])
    (tmp_path / "run" / "config.yaml").write_text("task: NarrowPassage\nenvironment: {guidance: kgrl}\nimports: []\n")
    written = export(tmp_path / "run", tmp_path / "out")
    monkeypatch.setattr("lerobot_robot_guiderail.export.HfApi", lambda: LocalHub(tmp_path / "cache"))
    assert push_to_hub(tmp_path / "out", "lab/passage").endswith(COMMIT)
    loaded = GuiderailPolicy.from_pretrained("lab/passage", cache_dir=tmp_path / "cache", local_files_only=True)
    state = {OBS_STATE: torch.linspace(-1.0, 1.0, 7)[None]}
    torch.testing.assert_close(loaded.select_action(state), written.select_action(state), rtol=0.0, atol=0.0)
    snapshot = tmp_path / "cache" / "models--lab--passage" / "snapshots" / COMMIT
    assert {"README.md", "env.py", "requirements.txt"} < {path.name for path in snapshot.iterdir()}


RECORD = """
import sys
from guiderail_data.episodes import record_episodes
options = {"guidance": "kgrl", "station": "gantry"}
record_episodes("scripted", sys.argv[1], "lerobot", task="BncConnector", environment=options, episodes=2)
"""


def test_recorded_episodes_have_the_wrench_as_a_feature(tmp_path):
    subprocess.run([PYTHON, "-c", RECORD, str(tmp_path / "data")], check=True)
    data = LeRobotDataset("lab/connector", root=tmp_path / "data")
    assert data.num_episodes == 2
    assert data.meta.features["observation.wrench"]["names"] == [
        "Fx [N]", "Fy [N]", "Fz [N]", "Mx [Nm]", "My [Nm]", "Mz [Nm]",
    ]  # fmt: skip
    forces = torch.stack([data[k]["observation.wrench"][:3].norm() for k in range(len(data))])
    assert torch.isfinite(forces).all()
    assert forces.max() > 1.0  # [N], the plug presses on the rim
    assert data[0]["action"].shape == data[0][OBS_STATE].shape
