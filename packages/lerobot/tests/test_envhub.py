"""Environments for LeRobot's EnvHub, as `env.py` of an exported policy makes them."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
from gymnasium.vector import AsyncVectorEnv, SyncVectorEnv

from guiderail.diagrams.envs.make import make_env
from guiderail.models.common.errors import InputError
from guiderail_lerobot.envhub import make_hub_env

RUN = Path(__file__).parents[3] / "tools" / "pretrained" / "passage"
CARD = Path(__file__).parents[1] / "src" / "lerobot_robot_guiderail" / "card.py"
OPTIONS = {"guidance": "kgrl", "action_repeat": 40}


def load(path, name, monkeypatch):
    """Return the module in a file; `card.py` is loaded alone, because its package imports LeRobot."""
    spec = importlib.util.spec_from_file_location(name, path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, name, module)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def card(monkeypatch):
    return load(CARD, "guiderail_lerobot_card", monkeypatch)


@pytest.mark.parametrize(("is_async", "kind"), [(False, SyncVectorEnv), (True, AsyncVectorEnv)])
def test_hub_environment_has_lerobots_observation(is_async, kind):
    ((task, environments),) = make_hub_env("NarrowPassage", OPTIONS, 2, is_async).items()
    env = environments[0]
    try:
        assert (task, type(env)) == ("NarrowPassage", kind)
        observation, _ = env.reset(seed=[3, 4])
        single = make_env("NarrowPassage", **OPTIONS)
        np.testing.assert_array_equal(observation["agent_pos"][0], single.reset(seed=3)[0])
        assert env.call("_max_episode_steps") == (10, 10)
        assert env.call("task_description") == ("NarrowPassage", "NarrowPassage")
    finally:
        env.close()


def test_episode_ends_within_the_stated_number_of_steps():
    env = make_hub_env("NarrowPassage", OPTIONS)["NarrowPassage"][0]
    env.reset(seed=[0])
    steps = 0
    while True:
        _, _, terminated, truncated, info = env.step(np.zeros(env.action_space.shape, np.float32))
        steps += 1
        if (terminated | truncated).all():
            break
    assert steps <= env.call("_max_episode_steps")[0]
    assert "is_success" in info["final_info"]


def test_number_of_hub_environments_is_checked():
    with pytest.raises(InputError, match="at least 1"):
        make_hub_env("NarrowPassage", OPTIONS, 0)


def test_environment_of_images_is_refused():
    with pytest.raises(InputError, match="image"):
        make_hub_env("NarrowPassage", OPTIONS | {"observation": "pixels"})


def test_written_environment_equals_that_of_the_run(card, tmp_path, monkeypatch):
    card.write_environment(RUN, tmp_path)
    module = load(tmp_path / "env.py", "guiderail_hub_env", monkeypatch)
    env = module.make_env(n_envs=1)["NarrowPassage"][0]
    run = make_hub_env(str(RUN), {})[str(RUN)][0]
    for seed in (0, 7):
        np.testing.assert_array_equal(env.reset(seed=[seed])[0]["agent_pos"], run.reset(seed=[seed])[0]["agent_pos"])
    assert "guiderail-lerobot" in (tmp_path / "requirements.txt").read_text()


def test_environment_is_left_out_when_its_files_are_missing(card, tmp_path):
    for text in ("task: NarrowPassage\nenvironment: {}\nimports: [own.py]\n", f"task: {tmp_path}\nenvironment: {{}}\n"):
        (tmp_path / "config.yaml").write_text(text)
        card.write_environment(tmp_path, tmp_path)
    assert not (tmp_path / "env.py").exists()


def test_card_has_the_evaluation_of_the_run(card, tmp_path):
    card.write_card(RUN, tmp_path)
    text = (tmp_path / "README.md").read_text()
    assert text.startswith("---\nlibrary_name: lerobot\n")
    assert "# NarrowPassage, skgrl" in text
    assert "| this policy | 100 |" in text
    assert "| demonstration alone | 0 |" in text


def test_card_states_no_result_without_an_evaluation(card, tmp_path):
    (tmp_path / "config.yaml").write_text("task: NarrowPassage\nenvironment: {guidance: kgrl}\n")
    card.write_card(tmp_path, tmp_path)
    text = (tmp_path / "README.md").read_text()
    assert "# NarrowPassage, kgrl" in text
    assert "success" not in text
