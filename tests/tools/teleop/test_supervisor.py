"""Who watches a run through a page: sliders are a push while they are not let go, and each click is one word."""

from types import SimpleNamespace

import numpy as np
import pytest
from pydrake.geometry import Meshcat

from guiderail.tools.environments import make_environment
from guiderail.tools.teleop import supervisor as page_person
from guiderail.tools.teleop.supervisor import FARTHEST, KEYS, LET_GO, SAYS, MeshcatSupervisor


class Page:
    """What is asked of a Meshcat: sliders that stay where they are, buttons that count their clicks."""

    def __init__(self):
        self.sliders, self.clicks = {}, {}

    def AddSlider(self, name, low, high, step, value, lower, higher):
        assert (low, high) == (-FARTHEST, FARTHEST)
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


def watched(supervisor, env):
    # A page that is no Meshcat shows nothing.
    supervisor._name_sliders(env.unwrapped)
    supervisor._let_go()
    return supervisor


def test_sliders_push_until_they_are_let_go(env):
    page = Page()
    supervisor = watched(MeshcatSupervisor(print, page), env)
    assert supervisor.correction(None) is None
    page.sliders["push 2"] = -2.5
    np.testing.assert_array_equal(supervisor.correction(None), [0.0, -2.5])
    page.clicks[LET_GO] += 1
    assert supervisor.correction(None) is None
    assert page.sliders == {"push 1": 0.0, "push 2": 0.0}


def test_a_click_is_one_word(env):
    page = Page()
    supervisor = watched(MeshcatSupervisor(print, page), env)
    assert supervisor.label() is None
    for name, (_, word) in SAYS.items():
        page.clicks[name] += 2
        assert supervisor.label() == word
        assert supervisor.label() is None


def test_of_what_is_said_between_two_episodes_a_stop_alone_counts(env, monkeypatch):
    page = Page()
    supervisor = MeshcatSupervisor(print, page)
    monkeypatch.setattr(page_person, "look_at", lambda page, declaration: None)
    monkeypatch.setattr(page_person, "View", lambda query, page: SimpleNamespace(follow=lambda context: None))
    for name, (_, word) in SAYS.items():
        page.clicks[name] += 1
        supervisor.on_episode_start(env)
        assert supervisor.label() == ("stop" if word == "stop" else None)
        assert supervisor.label() is None


def test_no_key_has_two_meanings():
    keys = [key for pair in KEYS for key in pair] + [key for key, _ in SAYS.values()]
    assert len(set(keys)) == len(keys)


def test_an_episode_is_shown_on_a_real_page(env):
    supervisor = MeshcatSupervisor(print)
    assert isinstance(supervisor.meshcat, Meshcat)
    env.reset(seed=0)
    supervisor.on_episode_start(env)
    assert supervisor.correction(None) is None
    env.step(np.zeros(2))
    assert supervisor.meshcat.HasPath("/drake/visualizer") or supervisor.meshcat.HasPath("/drake/illustration")
    supervisor.meshcat.SetSliderValue("push 1", 1.0)
    supervisor.on_episode_start(env)
    assert supervisor.correction(None) is None  # let go at the beginning of an episode
