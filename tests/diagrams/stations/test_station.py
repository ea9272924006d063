import numpy as np
import pytest

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_station
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
        with pytest.raises(InputError, match=f"put to a pose of {station.pose_size} finite numbers, not"):
            station.set_pose(context, pose)
