"""Adversary of the contact's force: it stays below the bounds, and breaks a law that does not limit rotations."""

import pytest
from force_adversary import ANYWHERE, Anywhere, Case, replay, run_round

from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.diagrams.tasks import insertion


@pytest.fixture
def anywhere():
    """Register the guidance of the adversary for a test."""
    register_guidance(ANYWHERE)(Anywhere)
    yield
    GUIDANCE._entries.pop(ANYWHERE)


def attacked(station, stiffness, rounds, episodes=None):
    """Return the case of the clamp after an attack with any reference; `episodes` collects those of largest force."""
    case, found = Case("GridClamp", station, stiffness, rounds=rounds), {} if episodes is None else episodes
    run_round(case, {}, 400, True, found.__setitem__)
    return case


@pytest.mark.parametrize(("station", "stiffness"), [("arm", 25), ("mujoco", 188)])
def test_adversary_needs_a_limit_of_the_rotation(station, stiffness, anywhere, monkeypatch, tmp_path):
    episodes = {}
    case = attacked(station, stiffness, 1, episodes)
    assert not case.has_failed
    assert case.transient > 0.5
    (episode,) = episodes.values()
    (tmp_path / "episode.json").write_text(episode)
    assert round(replay(tmp_path / "episode.json"), 3) == case.transient
    monkeypatch.setattr(insertion, "contact_lever", lambda workcell: 0.0)
    assert attacked(station, stiffness, 1).transient > case.transient_bound
