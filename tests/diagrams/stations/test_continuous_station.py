"""A station whose measured angles continue beyond ±π, alone and in an environment."""

from dataclasses import replace

import numpy as np
import pytest
from pydrake.systems.analysis import Simulator

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.make import make_guidance, make_station
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.wrapped_stations import ContinuousStation
from guiderail.diagrams.tasks.bnc_connector import BncConnector, BncWorkcell
from guiderail.models.primitives import ReferenceTrajectory

HEIGHT = 0.06  # height above the socket [m]


@pytest.fixture(scope="module")
def turning():
    """Measured poses of an arm that turns beyond half a turn, by the station and by its inner station."""
    inner = ArmStation(BncWorkcell())
    start = np.array([0.0, 0.0, HEIGHT, 3.0, 0.0, 0.0])
    station = ContinuousStation(inner, start)
    simulator = Simulator(station)
    context = simulator.get_mutable_context()
    station.set_pose(context, start)
    port = station.get_desired_pose_input_port().FixValue(context, start)
    simulator.Initialize()
    poses, inner_poses = [], []
    for step in range(40):
        port.GetMutableData().set_value(start + [0, 0, 0, 0.01 * step, 0, 0])
        simulator.AdvanceTo((step + 1) * station.control_period)
        poses.append(station.get_pose_output_port().Eval(context).copy())
        inner_poses.append(inner.get_pose_output_port().Eval(inner.GetMyContextFromRoot(context)).copy())
    return station, np.array(poses), np.array(inner_poses)


def test_pose_continues_beyond_half_a_turn(turning):
    _, poses, inner_poses = turning
    assert np.abs(np.diff(inner_poses[:, 3])).max() > 6.0
    assert np.abs(np.diff(poses[:, 3])).max() < 0.05
    assert poses[-1, 3] > np.pi
    turns = (poses - inner_poses) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)


def test_station_has_the_ports_and_attributes_of_the_inner_station(turning):
    station, _, _ = turning
    inner = station.GetSubsystemByName("station")
    for kind in ("input", "output"):
        numbers = range(getattr(inner, f"num_{kind}_ports")())
        names = [getattr(inner, f"get_{kind}_port")(number).get_name() for number in numbers]
        assert [getattr(station, f"get_{kind}_port")(number).get_name() for number in numbers] == names
    assert not station.wraps_angles
    assert station.arm is inner.arm
    assert station.nominal_period == inner.nominal_period
    with pytest.raises(AttributeError, match="nothing"):
        station.nothing  # noqa: B018


class Turned(BncConnector):
    """The connector with angles of its demonstrations near half a turn."""

    turn: float = np.pi

    def reference(self):
        reference = super().reference()
        return ReferenceTrajectory(reference.times, reference.means + [0, 0, 0, self.turn, 0, 0], reference.covariances)


@pytest.mark.parametrize("turn", [np.pi, -np.pi, 0.0])
def test_demonstrations_near_half_a_turn_are_guided_on_an_arm(turn):
    config = EnvConfig.resolve("BncConnector", {"station": "arm", "guidance": "skgrl"})
    config = replace(config, parts={**config.parts, "task": Turned(turn=turn)})
    station = make_station(config)
    assert isinstance(station, ContinuousStation) == (turn != 0.0)
    make_guidance(config, station)
    if turn:
        near = station.GetSubsystemByName("continuous_pose").CreateDefaultContext().get_discrete_state().value(0)
        np.testing.assert_array_equal(near, config.reference().means[0])
