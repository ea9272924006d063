"""Probe of the contact on the rim: drag, lever arm and capture."""

import dataclasses

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.stations.station import PLANT_PERIOD
from guiderail.diagrams.tasks.contact_probe import SPEEDS, ContactProbe, drag, probe_contact
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import sdf

CONNECTOR = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).make_task()


@pytest.fixture(scope="module")
def probes():
    """Return the connector's probes at the default time step and at half of it."""
    return [probe_contact(CONNECTOR, time_step=step) for step in (PLANT_PERIOD, PLANT_PERIOD / 2)]


def test_drag_of_the_connector_is_its_friction(probes):
    for probe in probes:
        assert probe.drags == pytest.approx([sdf.FRICTION] * len(SPEEDS), rel=0.05)
        assert probe.has_converged


def test_lever_arm_and_capture_of_the_connector_do_not_depend_on_the_step(probes):
    default, half = probes
    assert default.lever == pytest.approx(half.lever, rel=0.02)
    assert default.capture == pytest.approx(half.capture, abs=0.03 * MM)
    size = CONNECTOR.workcell().dimensions
    assert default.capture == pytest.approx(size.bore_clearance + size.mouth_chamfer, abs=0.05 * MM)


def test_drag_of_the_clamp_is_its_friction_at_20_mm_per_s():
    """At 40 mm/s it is 1.0 at the default time step, and the friction at a quarter of it."""
    clamp = EnvConfig.resolve("GridClamp", {"difficulty": "hard"}).make_task()
    contact = clamp.rim_contact()
    assert drag(clamp.workcell(), contact, 0.02) == pytest.approx(contact.friction, rel=0.15)
    fine = drag(clamp.workcell(), contact, 0.04, time_step=PLANT_PERIOD / 4)
    assert fine == pytest.approx(contact.friction, rel=0.15)


def test_probe_finds_a_chamfer_inside_the_margin(monkeypatch):
    """Extrapolated contact on the chamfer stops a plug that would slide past it."""
    monkeypatch.setattr(sdf, "BARREL", dataclasses.replace(sdf.BARREL, margin=0.1 * MM))
    friction = 0.2 + 1e-9  # a value without stored files
    workcell = dataclasses.replace(CONNECTOR.workcell(), friction=friction)
    ratio = drag(workcell, CONNECTOR.rim_contact(), 0.02)
    assert ratio > 2.0 * friction


def test_drag_is_infinite_error_without_contact():
    probe = ContactProbe(0.2, (np.nan, 0.2), 0.0, 0.0)
    assert probe.drag_error == np.inf
    assert not probe.has_converged


def test_probe_raises_for_a_task_without_rim():
    with pytest.raises(InputError, match="no rim"):
        probe_contact(EnvConfig.resolve("NarrowPassage", {}).make_task())
