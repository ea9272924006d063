"""Probe of the contact on the rim: drag, lever arm and capture."""

from dataclasses import replace

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.stations.station import PLANT_PERIOD
from guiderail.diagrams.tasks.contact_probe import MAX_DRAG_ERROR, SPEEDS, drag, press_on_rim
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects import bnc_connector
from guiderail_studies.contact_probe import DROPPED, ContactProbe, _lever, probe_contact

CONNECTOR = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared


def test_contact_of_the_connector_has_converged_at_the_default_step():
    """Drag, lever arm and capture are those of half the step, and the drag is the friction at both speeds."""
    workcell, contact = CONNECTOR.workcell(), CONNECTOR.rim_contact()
    default, finer = probe_contact(CONNECTOR), {"time_step": 0.5 * workcell.time_step}
    assert default.has_converged
    assert default.friction == bnc_connector.FRICTION
    size = workcell.dimensions
    assert default.capture == pytest.approx(size.bore_clearance + size.mouth_chamfer, rel=0.5)
    drags = tuple(drag(workcell, contact, speed, **finer) for speed in SPEEDS)
    on_rim, drops, stays = (
        press_on_rim(workcell, contact, [(offset, 0.0)], "gantry", finer)[0]
        for offset in (contact.radius, default.capture - 0.03 * MM, default.capture + 0.03 * MM)
    )
    assert ContactProbe(default.friction, drags, 0.0, 0.0).has_converged
    assert drags == pytest.approx(default.drags, rel=MAX_DRAG_ERROR)
    assert _lever(on_rim) == pytest.approx(default.lever, rel=0.02)
    assert drops["pose"][-1, 2] < contact.height - DROPPED < stays["pose"][-1, 2]


@pytest.mark.parametrize("speed", SPEEDS)
def test_drag_of_the_clamp_is_its_friction(speed):
    """It is at the default time step and at a quarter of it."""
    clamp = EnvConfig.resolve("GridClamp", {"difficulty": "hard"}).declared
    workcell, contact = clamp.workcell(), clamp.rim_contact()
    for step in (PLANT_PERIOD, PLANT_PERIOD / 4):
        assert drag(workcell, contact, speed, time_step=step) == pytest.approx(contact.friction, rel=MAX_DRAG_ERROR)


@pytest.mark.parametrize("speed", SPEEDS)
def test_drag_to_and_fro_is_that_around_the_rim_of_a_round_workpiece(speed):
    workcell, contact = CONNECTOR.workcell(), CONNECTOR.rim_contact()
    around, along = (drag(workcell, c, speed) for c in (contact, replace(contact, all_round=False)))
    assert along == pytest.approx(around, rel=0.1)


def test_workpiece_that_does_not_touch_has_no_drag():
    contact = replace(CONNECTOR.rim_contact(), height=0.2, all_round=False)
    assert np.isnan(drag(CONNECTOR.workcell(), contact, SPEEDS[0]))


def test_drag_is_infinite_error_without_contact():
    probe = ContactProbe(0.2, (np.nan, 0.2), 0.0, 0.0)
    assert probe.drag_error == np.inf
    assert not probe.has_converged


def test_probe_raises_for_a_task_without_rim():
    with pytest.raises(InputError, match="no rim"):
        probe_contact(EnvConfig.resolve("NarrowPassage", {}).declared)
