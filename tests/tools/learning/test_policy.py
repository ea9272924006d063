import json

import numpy as np
import pytest
from gymnasium import spaces
from spaces_only_env import SpacesOnlyEnv

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.learning.learner import LEARNERS
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.learning.networks import export_policy, pack_observation

STATE = spaces.Box(-np.inf, np.inf, (5,))
IMAGE = spaces.Box(0, 255, (22, 29, 3), np.uint8)


@pytest.fixture(
    params=[("tqc", STATE, 0), ("sac", STATE, 0), ("tqc", STATE, 1), ("tqc", IMAGE, 0)],
    ids=["tqc", "sac", "normalized", "image"],
)
def learner(request):
    algorithm, observation_space, layer_norm = request.param
    env = SpacesOnlyEnv(observation_space, spaces.Box(np.array([-1, -2]), np.array([1, 3]), dtype=np.float32))
    config = resolve_preset("tqc_contact", algorithm, {"net_arch": "32,16", "net_arch.layer_norm": layer_norm})
    return LEARNERS.get(algorithm)(config, env, action_repeat=1, seed=3, max_transitions=10)


def sample_observation(learner, seed):
    random = np.random.default_rng(seed)
    if learner.model.observation_space.dtype == np.uint8:
        return random.integers(0, 256, IMAGE.shape, dtype=np.uint8)
    return random.normal(scale=3, size=STATE.shape).astype(np.float32)


@pytest.fixture
def policy(learner):
    return export_policy(learner.model.actor, {"observation_shape": list(sample_observation(learner, 0).shape)})


def test_policy_acts_as_stable_baselines3_predicts(learner, policy, tmp_path):
    space = learner.model.actor.action_space
    policy.save(tmp_path)
    loaded = Policy.load(tmp_path)
    for observation in (sample_observation(learner, seed) for seed in range(20)):
        packed = pack_observation(observation, IMAGE.shape) if observation.ndim == 3 else observation
        expected, _ = learner.model.predict(packed, deterministic=True)
        np.testing.assert_allclose(loaded(observation), expected, atol=2e-5 * (space.high - space.low).max())


def test_policy_refuses_an_observation_of_another_shape(policy):
    with pytest.raises(ValueError, match="trained on observations"):
        policy(np.zeros(4))


def test_load_refuses_a_truncated_policy(policy, tmp_path):
    policy.save(tmp_path)
    weights = tmp_path / "policy.safetensors"
    weights.write_bytes(weights.read_bytes()[:-5])
    with pytest.raises(InputError, match="damaged"):
        Policy.load(tmp_path)


def test_load_refuses_an_unknown_activation(policy, tmp_path):
    policy.save(tmp_path)
    description = json.loads((tmp_path / "policy.json").read_text())
    (tmp_path / "policy.json").write_text(json.dumps(description | {"activation": "gelu"}))
    with pytest.raises(InputError, match="of another version"):
        Policy.load(tmp_path)


@pytest.mark.parametrize("file", ["policy.safetensors", "policy.json"])
def test_load_refuses_a_flipped_bit(policy, file, tmp_path):
    policy.save(tmp_path)
    content = bytearray((tmp_path / file).read_bytes())
    position = content.index(b"action_high") + 14 if file.endswith("json") else len(content) - 4
    content[position] ^= 1
    (tmp_path / file).write_bytes(content)
    with pytest.raises(InputError, match="damaged"):
        Policy.load(tmp_path)


def test_load_names_a_missing_policy(tmp_path):
    with pytest.raises(InputError, match="holds no policy"):
        Policy.load(tmp_path)
