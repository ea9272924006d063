"""Probe of the contact on the rim: drag, lever arm and capture."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.stations.station import PLANT_PERIOD
from guiderail.diagrams.tasks.contact_probe import MAX_DRAG_ERROR, SPEEDS, drag
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects import bnc_connector
from guiderail_studies.contact_probe import ContactProbe, probe_contact

CONNECTOR = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared


@pytest.fixture(scope="module")
def probes():
    """Return the connector's contact at its default step and at half of it."""
    step = CONNECTOR.workcell().time_step
    return [probe_contact(CONNECTOR, time_step=step / division) for division in (1, 2)]


def test_contact_of_the_connector_has_converged_at_the_default_step(probes):
    """Drag, lever arm and capture are those of a finer step, and the drag is the friction at both speeds."""
    default, finer = probes
    size = CONNECTOR.workcell().dimensions
    assert drag(CONNECTOR.workcell(), CONNECTOR.rim_contact(), SPEEDS[0]) == default.drags[0]
    for probe in probes:
        assert probe.has_converged
        assert probe.friction == bnc_connector.FRICTION
        assert probe.capture == pytest.approx(size.bore_clearance + size.mouth_chamfer, rel=0.5)
    assert finer.drags == pytest.approx(default.drags, rel=MAX_DRAG_ERROR)
    assert finer.lever == pytest.approx(default.lever, rel=0.02)
    assert finer.capture == pytest.approx(default.capture, abs=0.03 * MM)


def test_drag_of_the_clamp_is_its_friction_at_20_mm_per_s():
    """At 40 mm/s it is 1.0 at the default time step, and the friction at a quarter of it."""
    clamp = EnvConfig.resolve("GridClamp", {"difficulty": "hard"}).declared
    contact = clamp.rim_contact()
    assert drag(clamp.workcell(), contact, 0.02) == pytest.approx(contact.friction, rel=0.15)
    fine = drag(clamp.workcell(), contact, 0.04, time_step=PLANT_PERIOD / 4)
    assert fine == pytest.approx(contact.friction, rel=0.15)


def test_drag_is_infinite_error_without_contact():
    probe = ContactProbe(0.2, (np.nan, 0.2), 0.0, 0.0)
    assert probe.drag_error == np.inf
    assert not probe.has_converged


def test_probe_raises_for_a_task_without_rim():
    with pytest.raises(InputError, match="no rim"):
        probe_contact(EnvConfig.resolve("NarrowPassage", {}).declared)
