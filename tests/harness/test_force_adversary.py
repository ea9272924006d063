"""Adversary of the contact's force: it stays below the bounds, and breaks a law that does not limit rotations."""

import pytest
from force_adversary import ANYWHERE, Anywhere, Case, replay, run_round, transient_bound

from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.diagrams.stations.station import CONTACT_STIFFNESS
from guiderail.diagrams.tasks import insertion
from guiderail.models.control.wrench import impact_ratio


@pytest.fixture
def anywhere():
    """Register the guidance of the adversary for a test."""
    register_guidance(ANYWHERE)(Anywhere)
    yield
    GUIDANCE._entries.pop(ANYWHERE)


def attacked(station, stiffness, step_ms, rounds, episodes=None):
    """Return the case of the clamp after an attack with any reference; `episodes` collects those of largest force."""
    case, found = Case("GridClamp", station, stiffness, step_ms, rounds=rounds), {} if episodes is None else episodes
    run_round(case, {}, 400, True, found.__setitem__)
    return case


@pytest.mark.parametrize("attack", [("arm", 29, 5.0, 2), ("mujoco", 188, 1.0, 5)])
def test_adversary_needs_a_limit_of_the_rotation(attack, anywhere, monkeypatch, tmp_path):
    episodes = {}
    case = attacked(*attack, episodes)
    assert not case.has_failed
    assert case.transient > 0.5
    (episode,) = episodes.values()
    (tmp_path / "episode.json").write_text(episode)
    assert round(replay(tmp_path / "episode.json"), 3) == case.transient
    monkeypatch.setattr(insertion, "contact_lever", lambda workcell: 0.0)
    assert attacked(*attack).transient > case.transient_bound


@pytest.mark.parametrize("ratio", [0.5, 4.0, 40.0])
@pytest.mark.parametrize("share", [0.4, 1.0])
def test_bound_is_the_impact_ratio_and_increases_with_mass_delay_and_damping(ratio, share):
    plain = transient_bound(ratio * CONTACT_STIFFNESS, 1.5, 0.0, share)
    assert plain == pytest.approx(impact_ratio(ratio, share), rel=1e-3)
    for further in ({"heavier": 1.2}, {"damping": 5.0}):
        bound = transient_bound(ratio * CONTACT_STIFFNESS, 1.5, 0.0, share, **further)
        assert bound > plain or ratio < 1.0
    assert transient_bound(ratio * CONTACT_STIFFNESS, 1.5, 0.005, share) > plain
