"""Supervisor on a Meshcat page: sliders correct the policy, and clicks label an episode."""

from types import SimpleNamespace

import numpy as np
import pytest
from page_double import PageDouble
from pydrake.geometry import Meshcat

from guiderail.tools.environments import make_environment
from guiderail_hardware.teleop import teleoperator as supervising
from guiderail_hardware.teleop.teleoperator import KEY_PAIRS, LABEL_KEYS, LABELS, LIMIT, RELEASE, MeshcatSupervisor


class Page(PageDouble):
    """Double of a page that checks the limits of its sliders."""

    def AddSlider(self, name, low, high, *arguments):
        assert (low, high) == (-LIMIT, LIMIT)
        super().AddSlider(name, low, high, *arguments)


@pytest.fixture
def env():
    env = make_environment("NarrowPassage", {"guidance": "kgrl", "action_repeat": 10})
    yield env
    env.close()


@pytest.fixture
def page(monkeypatch):
    """Return the double of a page; camera and view, which need a Meshcat page, are replaced."""
    monkeypatch.setattr(supervising, "set_camera", lambda page, declaration: None)
    monkeypatch.setattr(supervising, "View", lambda query, page: SimpleNamespace(follow=lambda context: None))
    return Page()


def make_supervisor(page, env):
    """Return a supervisor with sliders for the actions of an environment."""
    supervisor = MeshcatSupervisor(print, page)
    supervisor._add_sliders(env.unwrapped)
    supervisor.panel.reset()
    return supervisor


def test_correction_equals_the_sliders_until_the_release(env, page):
    supervisor = make_supervisor(page, env)
    assert supervisor.correction(None) is None
    page.sliders["push 2"] = -2.5
    np.testing.assert_array_equal(supervisor.correction(None), [0.0, -2.5])
    page.clicks[RELEASE] += 1
    assert supervisor.correction(None) is None
    assert page.sliders == {"push 1": 0.0, "push 2": 0.0}


def test_label_is_returned_once_after_several_clicks(env, page):
    supervisor = make_supervisor(page, env)
    assert supervisor.label() is None
    for name, label in LABELS.items():
        page.clicks[name] += 2
        assert supervisor.label() == label
        assert supervisor.label() is None


def test_episode_start_clears_all_labels_except_a_stop(env, page):
    supervisor = MeshcatSupervisor(print, page)
    for name, label in LABELS.items():
        page.clicks[name] += 1
        supervisor.on_episode_start(env)
        assert supervisor.label() == ("stop" if label == "stop" else None)
        assert supervisor.label() is None


def test_pending_stop_has_priority_over_other_labels(env, page):
    supervisor = MeshcatSupervisor(print, page)
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
    meshcat = supervisor.panel.meshcat
    assert meshcat.HasPath("/drake/visualizer") or meshcat.HasPath("/drake/illustration")
    meshcat.SetSliderValue("push 1", 1.0)
    supervisor.on_episode_start(env)
    assert supervisor.correction(None) is None  # the start of an episode releases the sliders
