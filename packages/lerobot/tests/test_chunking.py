"""Chunk cloning: base policy from demonstrations, export as one network, resumed runs."""

import gymnasium
import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.learning.train import train
from guiderail_lerobot.base_policy import chunk_samples, find_base_policy
from guiderail_lerobot.chunking import ChunkLearner
from guiderail_lerobot.config import ChunkConfig

SETTINGS = {"demonstration_episodes": 4, "gradient_steps": 400, "members": 3, "chunk_steps": 4, "net_arch": (16,)}
SETTINGS |= {"learning_rate": 1e-2, "observation_noise": 0.01}
OPTIONS = {"action_repeat": 10, "difficulty": "hard"}


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    return train_chunks(tmp_path_factory.mktemp("chunk") / "run")


def train_chunks(out, **settings):
    """Return the run of a base policy that is trained on four demonstrations."""
    arguments = {"episodes": 4, "seed": 3, "algorithm": "chunk", "settings": SETTINGS | settings, "pictures": False}
    return train("NarrowPassage", "kgrl", out=out, **arguments, **OPTIONS)


def test_chunks_follow_the_commands_of_the_demonstrations(trained):
    env = make_environment("NarrowPassage", {"guidance": "kgrl", **OPTIONS})
    demonstrate = make_baseline("NarrowPassage", "scripted")(env)
    observation, _ = env.reset(seed=3)
    for _ in range(8):
        observation, *_ = env.step(demonstrate(observation))
    samples = chunk_samples(find_base_policy(str(trained.path)), observation, 2)
    assert samples.shape == (3, 4, 2)
    env.step(demonstrate(observation))
    y = 1  # entry along the passage; demonstrations pass the obstacle on either side in x, with equal y
    assert np.abs(samples.mean(axis=0) - env.unwrapped.trace.commanded[80:84])[:, y].max() < 0.06
    assert samples.std(axis=0).max() > 0.0
    assert trained.summary["success_in_training"].startswith("only demonstrations")


def test_seed_determines_the_policy_also_when_resumed(tmp_path):
    run, second = (train_chunks(tmp_path / name, gradient_steps=20) for name in ("run", "again"))
    for path in ("policy.safetensors", "policy.json"):
        assert (run.path / path).read_bytes() == (second.path / path).read_bytes()
    for episodes in (5, 6):  # the second resume starts from a checkpoint with an episode after the demonstrations
        resumed = train("NarrowPassage", out=second.path, resume=True, episodes=episodes, pictures=False)
        assert (run.path / "policy.safetensors").read_bytes() == (resumed.path / "policy.safetensors").read_bytes()


def test_state_before_the_first_demonstration_is_restored():
    env = make_environment("NarrowPassage", {"guidance": "kgrl"})
    before, after = (
        ChunkLearner(ChunkConfig(**SETTINGS), env, action_repeat=1, seed=0, max_transitions=10) for _ in range(2)
    )
    after.restore(*before.state())
    arrays, values = after.state()
    assert {name: len(array) for name, array in arrays.items()} == {"observations": 0, "actions": 0, "groups": 0}
    assert values["episodes"] == 0


def test_learner_refuses_an_environment_without_a_diagram():
    env = gymnasium.make("CartPole-v1")
    with pytest.raises(InputError, match="chunk needs an environment that is built"):
        ChunkLearner(ChunkConfig(), env, action_repeat=1, seed=0, max_transitions=10)
