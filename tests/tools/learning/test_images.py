"""Off-policy learners of observations with images."""

import numpy as np
import pytest
import torch
from gymnasium import spaces
from spaces_only_env import SpacesOnlyEnv

from guiderail.diagrams.envs.observation import ImageAndStateSpace
from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner import LEARNERS, describe_interface
from guiderail.tools.learning.learner_config import resolve_preset

SHAPE = (16, 17, 3)
IMAGE = spaces.Box(0, 255, SHAPE, np.uint8)
IMAGE_AND_STATE = ImageAndStateSpace(SHAPE, spaces.Box(-3, 3, (2,), np.float32))
SETTINGS = {
    "net_arch.image_encoder": "convolutional", "net_arch": "8", "batch_size": 4, "learning_starts": 4,
    "train_freq": 4, "gradient_steps": 2, "exploration.constant_episodes": 0,
}  # fmt: skip


def make(space, algorithm="tqc", **settings):
    config = resolve_preset("tqc_contact", algorithm, SETTINGS | settings)
    return LEARNERS.get(algorithm)(config, SpacesOnlyEnv(space), action_repeat=1, seed=3, max_transitions=40)


def observe(space, rng):
    if space is IMAGE:
        return rng.integers(0, 256, SHAPE, dtype=np.uint8)
    pixels = rng.integers(0, 256, np.prod(SHAPE)) / 255
    return np.concatenate([pixels, rng.normal(size=2)]).astype(np.float32)


def learn(learner, space, rng, episodes=2):
    for _ in range(episodes):
        learner.on_episode_start()
        for step in range(6):
            observation = observe(space, rng)
            action = learner.act(observation)
            learner.on_step(Transition(observation, action, 1.0, observe(space, rng), False, step == 5, {}))
        learner.on_episode_end({"success": 0})


@pytest.mark.parametrize("space", [IMAGE, IMAGE_AND_STATE], ids=["image", "image_and_state"])
@pytest.mark.parametrize(
    ("algorithm", "encoder"), [("tqc", "convolutional"), ("crossq", "convolutional"), ("sac", "average_pooling")]
)
def test_policy_acts_as_its_learner(space, algorithm, encoder, tmp_path):
    learner, rng = make(space, algorithm, **{"net_arch.image_encoder": encoder}), np.random.default_rng(0)
    learn(learner, space, rng)
    assert learner.model.replay_buffer.observations.dtype == np.uint8
    learner.policy(describe_interface(SpacesOnlyEnv(space))).save(tmp_path)
    policy, learner.is_greedy = Policy.load(tmp_path), True
    for _ in range(5):
        observation = observe(space, rng)
        np.testing.assert_allclose(policy(observation), learner.act(observation), atol=1e-4)


def test_only_the_critic_trains_the_shared_encoder():
    learner, rng = make(IMAGE_AND_STATE), np.random.default_rng(0)
    encoder = learner.model.critic.features_extractor
    assert learner.model.actor.features_extractor.features is encoder
    trained = {id(value) for group in learner.model.actor.optimizer.param_groups for value in group["params"]}
    assert not trained & {id(value) for value in encoder.parameters()}
    before = [value.clone() for value in encoder.parameters()]
    learn(learner, IMAGE_AND_STATE, rng)
    assert all((old != new).any() for old, new in zip(before, encoder.parameters(), strict=True))


def test_images_are_shifted_in_training_only():
    encoder = make(IMAGE_AND_STATE).model.critic.features_extractor
    packed = torch.randint(0, 256, (1, 3 * 16 * 17 + 8), dtype=torch.uint8)
    packed[:, -8:] = torch.tensor([0.5, -2.0]).view(torch.uint8)
    encoder.eval()
    assert torch.equal(encoder(packed), encoder(packed))
    assert encoder(packed)[0, -2:].tolist() == [0.5, -2.0]
    encoder.train()
    assert not all(torch.equal(encoder(packed), encoder(packed)) for _ in range(5))


def test_restored_learner_continues_as_without_interruption():
    learner, restored = make(IMAGE_AND_STATE), make(IMAGE_AND_STATE)
    learn(learner, IMAGE_AND_STATE, np.random.default_rng(0))
    arrays, values = learner.state()
    arrays = {name: array.copy() for name, array in arrays.items()}
    learn(learner, IMAGE_AND_STATE, np.random.default_rng(1))
    restored.restore(arrays, values)
    learn(restored, IMAGE_AND_STATE, np.random.default_rng(1))
    observation = observe(IMAGE_AND_STATE, np.random.default_rng(2))
    np.testing.assert_array_equal(restored.act(observation), learner.act(observation))


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a CUDA device")
def test_cuda_is_refused_when_absent():
    with pytest.raises(InputError, match="no CUDA device"):
        make(IMAGE_AND_STATE, device="cuda")
