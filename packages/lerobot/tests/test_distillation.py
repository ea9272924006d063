"""Policy distillation: commands of the teacher as labels, prediction by the student, resumed runs."""

from contextlib import nullcontext

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.policy import FORMAT, Policy
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.learning.learner_config import make_config
from guiderail.tools.learning.train import train
from guiderail_lerobot.base_policy import chunk_samples, find_base_policy
from guiderail_lerobot.config import DistillationConfig
from guiderail_lerobot.distillation import DistillationLearner

OPTIONS = {"guidance": "kgrl", "action_repeat": 10}
SETTINGS = {"chunk_steps": 10, "gradient_steps": 1000, "net_arch": (32,), "batch_size": 64, "learning_rate": 5e-3}


@pytest.fixture(scope="module")
def teacher(tmp_path_factory):
    """Return the folder of a linear policy with random weights."""
    env = make_environment("NarrowPassage", OPTIONS)
    size = env.observation_space.shape[0]
    weight = 0.3 * np.random.default_rng(0).standard_normal((2, size)).astype(np.float32)
    description = {"format": FORMAT, "observation_shape": [size], "action_low": [-1.0] * 2, "action_high": [1.0] * 2}
    folder = tmp_path_factory.mktemp("teacher")
    Policy([(weight, np.zeros(2, np.float32))], description).save(folder)
    return folder


def make(source, options=OPTIONS, **settings):
    env = make_environment("NarrowPassage", options)
    config = DistillationConfig(**SETTINGS | {"teacher": str(source), **settings})
    return DistillationLearner(config, env, action_repeat=10, seed=0, max_transitions=100), env


def test_labels_are_the_commands_of_the_teacher(teacher):
    learner, env = make(teacher, action_noise=0.0)
    rollout(env, learner.act, learner, seed=5)
    commanded = env.unwrapped.trace.commanded
    for observation, step in zip(learner._observations, learner._steps, strict=True):
        executed = commanded[step : step + 10]
        np.testing.assert_allclose(learner.label(observation, step)[: len(executed)], executed, atol=1e-7)


def test_student_predicts_the_commands_of_the_teacher(teacher, tmp_path):
    arguments = {"episodes": 3, "seed": 1, "algorithm": "distillation", "pictures": False, **OPTIONS}
    arguments["settings"] = SETTINGS | {"teacher": str(teacher)}
    run = train("NarrowPassage", out=tmp_path / "run", **arguments)
    learner, env = make(teacher)
    observation, _ = env.reset(seed=7)
    errors, student = [], find_base_policy(str(run.path))
    for step in range(0, 100, 10):
        chunk = chunk_samples(student, observation, 2)
        errors.append(np.abs(chunk[0] - learner.label(observation, step)).max())
        observation, *_ = env.step(learner._teacher(observation))
    assert np.median(errors) < 0.02  # [m]; the passage is 0.9 m long


def test_resumed_student_is_that_of_an_uninterrupted_run(teacher, tmp_path):
    settings = SETTINGS | {"teacher": str(teacher), "gradient_steps": 20}
    arguments = {"seed": 1, "algorithm": "distillation", "pictures": False, "settings": settings, **OPTIONS}
    whole = train("NarrowPassage", out=tmp_path / "whole", episodes=3, **arguments)
    parts = train("NarrowPassage", out=tmp_path / "parts", episodes=2, **arguments)
    resumed = train("NarrowPassage", out=parts.path, resume=True, episodes=3, pictures=False)
    assert (whole.path / "policy.safetensors").read_bytes() == (resumed.path / "policy.safetensors").read_bytes()


def test_entries_that_depend_on_the_step_alone_are_found():
    observations = np.array([[0.0, 1.0], [0.5, 2.0], [0.0, 3.0], [0.5, 2.0]])
    assert DistillationLearner._clocks(observations, np.array([0, 10, 0, 10])).tolist() == [True, False]


def test_noise_of_copies_needs_a_second_episode(teacher):
    for settings in ({}, {"copy_noise": 0.0}, {"noisy_copies": 0}):
        learner, env = make(teacher, **settings | {"gradient_steps": 1})
        rollout(env, learner.act, learner, seed=5)
        with nullcontext() if settings else pytest.raises(InputError, match="at least 2 --episodes"):
            learner.finish()


@pytest.mark.parametrize(
    ("settings", "options", "message"),
    [
        ({"teacher": ""}, {}, "teacher=RUN"),
        ({}, {"action_dims": (0,)}, "other observations or actions"),
        ({}, {"guidance": "skgrl"}, "--guidance kgrl"),
        ({}, {"max_speed": (5.0,)}, "--guidance kgrl"),
    ],
)
def test_distillation_is_refused_when_the_teacher_does_not_fit(teacher, settings, options, message):
    with pytest.raises(InputError, match=message):
        make(settings.pop("teacher", teacher), OPTIONS | options, **settings)


def test_distillation_refuses_demonstrations():
    with pytest.raises(InputError, match="demonstration_episodes"):
        make_config("distillation", {"demonstration_episodes": 1})
