"""Supervisor at a page: sliders correct the policy, clicks label an episode."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from guiderail.tools.environments import make_environment
from guiderail.tools.teleop import teleoperator as supervising
from guiderail.tools.teleop.teleoperator import KEY_PAIRS, LABEL_KEYS, LABELS, LIMIT, RELEASE, MeshcatSupervisor


class Page:
    """Meshcat with the methods that a supervisor needs: sliders keep their values, buttons count their clicks."""

    def __init__(self):
        self.sliders, self.clicks = {}, {}

    def AddSlider(self, name, low, high, step, value, lower, higher):
        assert (low, high) == (-LIMIT, LIMIT)
        self.sliders[name] = value

    def AddButton(self, name, key):
        self.clicks[name] = 0

    def SetSliderValue(self, name, value):
        self.sliders[name] = value

    def GetSliderValue(self, name):
        return self.sliders[name]

    def GetButtonClicks(self, name):
        return self.clicks[name]


@pytest.fixture
def env():
    env = make_environment("NarrowPassage", {"guidance": "kgrl", "action_repeat": 10})
    yield env
    env.close()


def add_sliders(supervisor, env):
    # Without `View`, which needs a real Meshcat.
    supervisor._add_sliders(env.unwrapped)
    supervisor.panel.reset()
    return supervisor


def test_correction_follows_the_sliders_until_released(env):
    page = Page()
    supervisor = add_sliders(MeshcatSupervisor(print, page), env)
    assert supervisor.correction(None) is None
    page.sliders["push 2"] = -2.5
    np.testing.assert_array_equal(supervisor.correction(None), [0.0, -2.5])
    page.clicks[RELEASE] += 1
    assert supervisor.correction(None) is None
    assert page.sliders == {"push 1": 0.0, "push 2": 0.0}


def test_label_is_returned_once_per_click(env):
    page = Page()
    supervisor = add_sliders(MeshcatSupervisor(print, page), env)
    assert supervisor.label() is None
    for name, label in LABELS.items():
        page.clicks[name] += 2
        assert supervisor.label() == label
        assert supervisor.label() is None


def test_only_a_stop_outlasts_the_start_of_an_episode(env, monkeypatch):
    page = Page()
    supervisor = MeshcatSupervisor(print, page)
    monkeypatch.setattr(supervising, "set_camera", lambda page, declaration: None)
    monkeypatch.setattr(supervising, "View", lambda query, page: SimpleNamespace(follow=lambda context: None))
    for name, label in LABELS.items():
        page.clicks[name] += 1
        supervisor.on_episode_start(env)
        assert supervisor.label() == ("stop" if label == "stop" else None)
        assert supervisor.label() is None


def test_pending_stop_outlasts_other_labels(env, monkeypatch):
    page = Page()
    supervisor = MeshcatSupervisor(print, page)
    monkeypatch.setattr(supervising, "set_camera", lambda page, declaration: None)
    monkeypatch.setattr(supervising, "View", lambda query, page: SimpleNamespace(follow=lambda context: None))
    page.clicks["stop (Escape)"] += 1
    supervisor.on_episode_start(env)
    page.clicks["success (Enter)"] += 1
    assert supervisor.label() == "stop"
    assert supervisor.label() is None


def test_keys_are_unique():
    keys = [key for pair in KEY_PAIRS for key in pair] + list(LABEL_KEYS.values())
    assert len(set(keys)) == len(keys)


def test_episode_is_shown_on_a_meshcat_page(env):
    supervisor = MeshcatSupervisor(print)
    assert isinstance(supervisor.panel.meshcat, Meshcat)
    env.reset(seed=0)
    supervisor.on_episode_start(env)
    assert supervisor.correction(None) is None
    env.step(np.zeros(2))
    assert supervisor.panel.meshcat.HasPath("/drake/visualizer") or supervisor.panel.meshcat.HasPath(
        "/drake/illustration"
    )
    supervisor.panel.meshcat.SetSliderValue("push 1", 1.0)
    supervisor.on_episode_start(env)
    assert supervisor.correction(None) is None  # released at the start of an episode
