import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_station
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.mujoco import MujocoStation
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.errors import InputError

PLACES = [
    ("NarrowPassage", "plane"),
    ("Pouring", "pouring"),
    ("BncConnector", "gantry"),
    ("BncConnector", "mujoco"),
    ("BncConnector", "arm"),
]


@pytest.mark.parametrize(("task", "place"), PLACES)
def test_set_pose_raises_when_the_pose_is_not_finite(task, place):
    station = make_station(EnvConfig.resolve(task, {"station": place}).make_task())
    context = station.CreateDefaultContext()
    whole = np.zeros(station.pose_size)
    broken = [np.r_[np.nan, whole[1:]], np.r_[whole[1:], -np.inf], whole[1:], [*whole, 0.0], ["a"] * len(whole), None]
    for pose in broken:
        with pytest.raises(InputError, match=f"pose must be {station.pose_size} finite numbers, not"):
            station.set_pose(context, pose)


@pytest.mark.parametrize("station", [ArmStation, GantryStation, MujocoStation])
@pytest.mark.parametrize("time_step", [0.0, -0.01, np.nan])
def test_station_raises_when_the_time_step_is_not_positive(station, time_step):
    with pytest.raises(InputError, match="whole multiple"):
        station(BncWorkcell(), time_step=time_step)
