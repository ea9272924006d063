"""Fast training step compared with Stable-Baselines3's, on the same parameters, batches and random numbers."""

import numpy as np
import pytest
import torch
from gymnasium import Env, spaces
from sb3_contrib import TQC
from sb3_contrib.common.utils import quantile_huber_loss
from stable_baselines3 import SAC
from torch.nn.utils import parameters_to_vector

from guiderail.tools.evaluation.episode import Transition
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.learning.off_policy import OffPolicyLearner, SacLearner, TqcLearner

STEPS, BATCH = 6, 64


class Vector(Env):
    observation_space = spaces.Box(-10, 10, (13,), np.float32)
    action_space = spaces.Box(-1, 1, (2,), np.float32)


class Image(Vector):
    observation_space = spaces.Box(0, 255, (10, 15, 3), np.uint8)


class PlainSac(OffPolicyLearner):
    algorithm = SAC


class PlainTqc(OffPolicyLearner):
    algorithm = TQC


PAIRS = [(PlainSac, SacLearner), (PlainTqc, TqcLearner)]


def make(kind, preset="tqc_contact", env=Vector, **settings):
    settings = {"net_arch": "32,24", "batch_size": BATCH, "symmetry": False, "learning_rate": 1e-4} | settings
    learner = kind(resolve_preset(preset, "tqc", settings), env(), action_repeat=10, seed=0, max_transitions=300)
    random, space = np.random.default_rng(0), env.observation_space
    for index in range(200):
        observations = random.uniform(0, 2, (2, *space.shape)).astype(space.dtype)
        if len(space.shape) == 3:
            observations = np.moveaxis(observations, 1, -1)
        action, reward = random.uniform(-1, 1, 2).astype(np.float32), float(3 * random.normal())
        learner.store(Transition(observations[0], action, reward, observations[1], index % 50 == 49, False, {}))
    return learner


def train_both(plain, ensemble, seed=0):
    """Train both on the same batches: Stable-Baselines3 samples them one by one, the fast step all at once."""
    np.random.seed(seed)  # noqa: NPY002 (Stable-Baselines3 samples from it)
    batches = plain.model.replay_buffer.sample(STEPS * BATCH)
    single_batches = iter(zip(*[array.split(BATCH) for array in batches if array is not None], strict=True))
    for learner, sample in (
        (plain, lambda _, env=None: type(batches)(*next(single_batches))),
        (ensemble, lambda _, env=None: batches),
    ):
        learner.model.replay_buffer.sample = sample
        torch.manual_seed(seed)
        learner.model.train(STEPS, BATCH)
        del learner.model.replay_buffer.sample


def assert_equal(plain, ensemble, tolerance):
    """Compare the parameters of all networks and the entropy coefficient."""
    for network in ("actor", "critic", "critic_target"):
        expected, result = (parameters_to_vector(getattr(x.model, network).parameters()) for x in (plain, ensemble))
        torch.testing.assert_close(result.detach(), expected.detach(), rtol=0, atol=tolerance)
    if plain._log_ent_coef() is not None:
        torch.testing.assert_close(ensemble._log_ent_coef(), plain._log_ent_coef().detach(), rtol=0, atol=tolerance)


@pytest.mark.parametrize(("plain", "ensemble"), PAIRS)
@pytest.mark.parametrize(
    ("preset", "settings"), [("tqc_contact", {}), ("tqc_fast", {"ent_coef": "0.2", "net_arch": "16"})]
)
def test_fast_step_equals_the_step_of_stable_baselines3(plain, ensemble, preset, settings):
    expected, result = make(plain, preset, **settings), make(ensemble, preset, **settings)
    assert_equal(expected, result, 0.0)
    for seed in range(2):
        train_both(expected, result, seed)
        assert_equal(expected, result, 2e-6)
    # Adam's step is independent of the gradient's scale, so the gradients of the actor are normalized.
    gradient = torch.cat([p.grad.flatten() for p in expected.model.actor.parameters()])
    largest = gradient.abs().max()
    torch.testing.assert_close(result.model.actor.optimizer.gradient / largest, gradient / largest, rtol=0, atol=2e-5)


@pytest.mark.parametrize(("plain", "ensemble"), PAIRS)
def test_fast_step_on_images_equals_stable_baselines3(plain, ensemble):
    expected, result = make(plain, env=Image), make(ensemble, env=Image)
    train_both(expected, result)
    assert_equal(expected, result, 2e-6)


def test_tqc_critic_gradient_is_the_gradient_of_its_loss():
    learner = make(TqcLearner)
    generator = torch.Generator().manual_seed(0)
    values = (2 * torch.randn(2, BATCH, 25, generator=generator)).requires_grad_()
    target = 2 * torch.randn(BATCH, 46, generator=generator)
    loss = quantile_huber_loss(values.transpose(0, 1), target[:, None], sum_over_quantiles=False)
    (expected,) = torch.autograd.grad(loss, values)
    result = learner.model._critic_gradient(values.detach(), target)
    torch.testing.assert_close(result, expected, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize(("plain", "ensemble"), PAIRS)
def test_fast_step_continues_stable_baselines3_state(plain, ensemble):
    expected, result = make(plain), make(ensemble)
    train_both(expected, make(ensemble))
    arrays, values = expected.state()
    contiguous = {key: np.ascontiguousarray(value).copy() for key, value in arrays.items()}  # as in a file
    result.restore(contiguous, values)
    assert result.state()[0].keys() == arrays.keys()
    train_both(expected, result, seed=1)
    assert_equal(expected, result, 2e-6)


def test_learning_does_not_import_pytorchs_compiler(forks):
    code = """
import sys
from guiderail.tools.learning.fast_sb3 import FastSac, FastTqc
from gymnasium import Env, spaces
class Vector(Env):
    observation_space = action_space = spaces.Box(-1, 1, (2,))
for algorithm in (FastSac, FastTqc):
    algorithm("MlpPolicy", Vector())
sys.exit("torch._dynamo" in sys.modules)
"""
    assert forks.run("-c", code).returncode == 0
