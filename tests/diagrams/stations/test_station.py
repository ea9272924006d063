"""Arguments that every simulated station refuses."""

import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_station
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.errors import InputError

STATIONS = [("NarrowPassage", "plane"), ("Pouring", "pouring"), ("BncConnector", "gantry"), ("BncConnector", "arm")]


@pytest.mark.parametrize(("task", "name"), STATIONS)
def test_set_pose_raises_when_the_pose_is_not_finite(task, name):
    station = make_station(EnvConfig.resolve(task, {"station": name}))
    context = station.CreateDefaultContext()
    zero = np.zeros(station.pose_size)
    invalid = [np.r_[np.nan, zero[1:]], np.r_[zero[1:], -np.inf], zero[1:], [*zero, 0.0], ["a"] * len(zero), None]
    for pose in invalid:
        with pytest.raises(InputError, match=f"pose must be {station.pose_size} finite numbers, not"):
            station.set_pose(context, pose)


@pytest.mark.parametrize("station", [ArmStation, GantryStation])
@pytest.mark.parametrize("time_step", [0.0, -0.01, np.nan])
def test_station_raises_when_the_time_step_is_not_positive(station, time_step):
    with pytest.raises(InputError, match="whole multiple"):
        station(BncWorkcell(), time_step=time_step)
