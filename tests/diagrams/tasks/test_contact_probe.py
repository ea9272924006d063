"""Probe of the contact on the rim: drag, lever arm and capture."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.stations.station import PLANT_PERIOD
from guiderail.diagrams.tasks.contact_probe import SPEEDS, ContactProbe, drag, probe_contact
from guiderail.models.common.errors import InputError
from guiderail.models.objects.bnc_connector import sdf

CONNECTOR = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared


def test_contact_of_the_connector_has_not_converged_at_the_default_step():
    """The chamfer is inside the margin, and extrapolated contact on it stops a plug that would slide past it."""
    probe = probe_contact(CONNECTOR)
    assert not probe.has_converged
    assert min(probe.drags) > 2.0 * sdf.FRICTION
    size = CONNECTOR.workcell().dimensions
    assert probe.capture == pytest.approx(size.bore_clearance + size.mouth_chamfer, rel=0.5)


def test_drag_of_the_connector_approaches_its_friction_with_fine_contact():
    fine = EnvConfig.resolve("BncConnector", {"difficulty": "hard", "contact_margin": 0.0, "equal_area": True})
    task = fine.declared
    ratio = drag(task.workcell(), task.rim_contact(), SPEEDS[0], time_step=PLANT_PERIOD / 4)
    assert ratio == pytest.approx(sdf.FRICTION, rel=0.2)


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
