"""Data sets of a policy's episodes."""

import json

import minari
import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail_data.episodes import record_episodes
from guiderail_data.formats.lerobot import INFO, read_lerobot

CLAMP = {"task": "GridClamp", "environment": {"difficulty": "hard", "seconds": 2.0}, "episodes": 2}


def test_lerobot_data_set_has_the_wrench_of_every_control_step(tmp_path):
    result = record_episodes("scripted", str(tmp_path / "set"), "lerobot", **CLAMP)
    features = json.loads((tmp_path / "set" / INFO).read_text())["features"]
    assert features["observation.wrench"]["names"] == ["Fx [N]", "Fy [N]", "Fz [N]", "Mx [Nm]", "My [Nm]", "Mz [Nm]"]
    wrench, pose = (read_lerobot(tmp_path / "set", f"observation.{name}") for name in ("wrench", "state"))
    assert sum(map(len, wrench.times)) == result["control_steps"]
    assert all(np.abs(force[:, 2]).max() > 1.0 for force in wrench.outputs)  # the clamp presses on the table
    assert all(motion.shape == (len(time), 6) for time, motion in zip(pose.times, pose.outputs, strict=True))


def test_minari_loads_the_episodes_and_their_environment(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    result = record_episodes("scripted", "clamp/scripted-v0", "minari", **CLAMP)
    dataset = minari.load_dataset("clamp/scripted-v0")
    assert dataset.total_episodes == result["episodes"] == 2
    episode = dataset[0]
    assert len(episode.observations) == len(episode.actions) + 1
    assert episode.rewards.shape == (len(episode.actions),)
    env = dataset.recover_environment()
    observation, _ = env.reset(seed=0)
    assert observation.shape == episode.observations[0].shape
    env.close()
    with pytest.raises(InputError, match="has a data set"):
        record_episodes("scripted", "clamp/scripted-v0", "minari", **CLAMP)
    with pytest.raises(InputError, match="is no identifier"):
        record_episodes("scripted", "clamp scripted", "minari", **CLAMP)


def test_unknown_format_is_refused(tmp_path):
    with pytest.raises(InputError, match="lerobot"):
        record_episodes("scripted", str(tmp_path / "set"), "lerobott", **CLAMP)
