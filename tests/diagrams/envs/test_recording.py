"""Recording of a station that follows a motion."""

import numpy as np

from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell


def test_station_stays_at_rest_from_its_first_plant_step():
    pose = np.array([0.01, 0.0, 0.03, 1.5, 0.0, 0.0])
    _, recording = drive_along(GantryStation(BncWorkcell()), [0.0, 0.2], [pose, pose])
    np.testing.assert_allclose(recording["pose"], np.tile(pose, (10, 1)), atol=1e-9)
