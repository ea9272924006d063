"""Adversary of the contact's force: it stays below the bounds, and breaks a law that does not limit rotations."""

import pytest
from force_adversary import ANYWHERE, Anywhere, Case, run_round

from guiderail.diagrams.guidance.registry import GUIDANCE, register_guidance
from guiderail.diagrams.tasks import insertion


@pytest.fixture
def anywhere():
    """Register the guidance of the adversary for a test."""
    register_guidance(ANYWHERE)(Anywhere)
    yield
    GUIDANCE._entries.pop(ANYWHERE)


def attacked(station, stiffness, rounds):
    """Return the case of the clamp after an attack with any reference."""
    case = Case("GridClamp", station, stiffness, rounds=rounds)
    run_round(case, {}, 400, bounded=True)
    return case


@pytest.mark.parametrize(("station", "stiffness"), [("arm", 25), ("mujoco", 188)])
def test_adversary_needs_a_limit_of_the_rotation(station, stiffness, anywhere, monkeypatch):
    case = attacked(station, stiffness, 1)
    assert not case.has_failed
    assert case.transient > 0.5
    monkeypatch.setattr(insertion, "contact_lever", lambda workcell: 0.0)
    assert attacked(station, stiffness, 1).transient > case.transient_bound
