"""Views for Safety-Gymnasium and OmniSafe."""

import sys
from abc import ABC, abstractmethod
from types import ModuleType

import gymnasium
import numpy as np
import pytest
import torch

import guiderail  # noqa: F401 (registers the environments)
from guiderail.models.common.errors import InputError
from guiderail_studies.benchmark.safety_gymnasium import SafetyGymnasiumView, register_omnisafe

OPTIONS = {"guidance": "residual", "difficulty": "hard", "bounded_force": False}


@pytest.fixture
def registered(monkeypatch):
    """Return the classes that a double of `omnisafe.envs.core` registers; OmniSafe needs other versions of packages."""

    class CMDP(ABC):
        @abstractmethod
        def __init__(self, env_id, **kwargs):
            assert env_id in self._support_envs

        action_space = property(lambda self: self._action_space)
        observation_space = property(lambda self: self._observation_space)
        num_envs = property(lambda self: self._num_envs)
        time_limit = property(lambda self: self._time_limit)
        step, reset, set_seed, render, close = (abstractmethod(lambda self: None) for _ in range(5))

    classes = []
    core = ModuleType("omnisafe.envs.core")
    core.CMDP, core.env_register = CMDP, classes.append
    for name, module in (
        ("omnisafe", ModuleType("omnisafe")),
        ("omnisafe.envs", ModuleType("omnisafe.envs")),
        ("omnisafe.envs.core", core),
    ):
        monkeypatch.setitem(sys.modules, name, module)
    return classes


def test_view_returns_the_cost_of_every_step():
    view = SafetyGymnasiumView(gymnasium.make("guiderail/GridClamp-v0", **OPTIONS))
    view.reset(seed=0)
    total, steps, is_over = 0.0, 0, False
    while not is_over:
        _, _, cost, terminated, truncated, info = view.step(view.action_space.sample())
        assert cost == info["cost"]
        total, steps, is_over = total + cost, info["control_steps"], terminated or truncated
    trace = view.unwrapped.trace
    assert total == trace.unsafe().sum() == trace.statistics()["cost"] <= steps
    view.close()


def test_view_is_refused_without_a_cost():
    view = SafetyGymnasiumView(gymnasium.make("Pendulum-v1"))
    view.reset(seed=0)
    with pytest.raises(InputError, match="info has no cost"):
        view.step(view.action_space.sample())


def test_omnisafe_environment_has_the_interface_of_a_cmdp(registered):
    names = register_omnisafe()
    assert {"guiderail/GridClamp-v0", "guiderail/NarrowPassage-v0"} <= set(names)
    (kind,) = registered
    env = kind("guiderail/GridClamp-v0", **OPTIONS)
    env.set_seed(3)
    observation, _ = env.reset(seed=3)
    assert observation.dtype == torch.float32
    assert observation.shape == env.observation_space.shape
    *tensors, info = env.step(torch.zeros(env.action_space.shape))
    assert len(tensors) == 5
    assert all(isinstance(value, torch.Tensor) for value in tensors)
    assert np.isclose(float(tensors[2]), info["cost"])
    assert env.max_episode_steps == 30
    assert (env.num_envs, env.time_limit) == (1, None)
    env.close()


def test_omnisafe_environment_is_refused_in_parallel(registered):
    register_omnisafe()
    with pytest.raises(InputError, match="one environment"):
        registered[0]("guiderail/GridClamp-v0", num_envs=2)


def test_omnisafe_is_refused_when_it_cannot_be_imported(monkeypatch):
    monkeypatch.setitem(sys.modules, "omnisafe.envs.core", None)
    with pytest.raises(InputError, match="OmniSafe cannot be imported"):
        register_omnisafe()
