"""Contact physics of the hard connector at its default time step and at half of it."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import BncDimensions
from guiderail.models.objects.bnc_connector.demonstrations import CLEAR, poses
from oracles.connector import insert_and_lock

HARD = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared
WORKCELL = HARD.workcell()
STIFFNESS = Impedance().stiffness[2]
# Height of the plug's mouth on top of the lugs, relative to the locked pose [m].
LUG_TOP = WORKCELL.dimensions.lug_height + WORKCELL.dimensions.lug_radius - WORKCELL.dimensions.locked_height


@pytest.fixture(scope="module", params=[None, WORKCELL.time_step / 2], ids=["default", "half"])
def build(request):
    """Return a function that builds a gantry station with one of the time steps."""
    return lambda: GantryStation(WORKCELL, time_step=request.param)


@pytest.fixture(scope="module")
def locked_and_pulled(build):
    """Lock the plug, then command a pull of 45 N, above the limit of 40 N; return the recording."""
    times, motion = insert_and_lock()
    pull = np.array([0.0, 0.0, 45.0 / STIFFNESS, 0.0, 0.0, 0.0])
    times = np.concatenate([times, times[-1] + [1.0, 1.5]])
    _, recording = drive_along(build(), times, np.concatenate([motion, [pull, pull]]))
    return recording


def test_hard_connector_differs_from_the_standard():
    assert WORKCELL.dimensions != BncDimensions()


def test_plug_locks_at_the_nominal_pose(locked_and_pulled):
    final = locked_and_pulled["pose"][round(insert_and_lock()[0][-1] / 0.02) - 1]
    assert np.abs(final[:3]).max() < 0.3 * MM
    assert np.abs(np.rad2deg(final[3:])).max() < 1.0
    assert locked_and_pulled["impedance_force"][:300].max() < HARD.collision.above


def test_locked_plug_resists_a_pull(locked_and_pulled):
    assert locked_and_pulled["wrench"][-1, 2] == pytest.approx(-40.0, abs=0.5)
    assert locked_and_pulled["pose"][-1, 2] < 0.5 * MM


def test_rotation_is_blocked_before_insertion(build):
    depth = LUG_TOP - 30.0 / STIFFNESS
    motion = poses(np.array([CLEAR, LUG_TOP + 1.0 * MM, depth, depth]), np.deg2rad(45.0))
    _, recording = drive_along(build(), np.array([0.0, 1.0, 2.0, 2.5]), motion)
    assert recording["wrench"][-1, 2] == pytest.approx(30.0, abs=1.5)
    assert recording["pose"][-1, 2] == pytest.approx(LUG_TOP, abs=0.1 * MM)
