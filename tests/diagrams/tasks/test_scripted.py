"""Scripted policies of BncConnector and GridClamp as functions of the observation."""

import numpy as np
import pytest

from guiderail.diagrams.tasks import bnc_connector as connector
from guiderail.diagrams.tasks.bnc_connector import (
    POSE_CENTER,
    POSE_SCALE,
    REACH,
    STEP,
    scripted_center_of_pressure,
    scripted_torque_search,
)
from guiderail.diagrams.tasks.grid_clamp import CENTER, LANE_ENDS, LANES, SCALE, scripted_search
from guiderail.diagrams.tasks.options import CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.demonstrations import RIM


def observe_plug(**values):
    """Return an observation of the connector during the search on the rim, with given values."""
    names = {
        "time": connector.TIME,
        "z": connector.Z,
        "force_z": connector.FORCE_Z,
        "torque_x": connector.TORQUE_X,
        "torque_y": connector.TORQUE_Y,
    }
    result = np.zeros(13)
    searching = {"time": -0.4, "z": 0.68, "force_z": 0.5}
    for name, value in (searching | values).items():
        result[names[name]] = value
    return result


def test_torque_search_moves_against_the_torque():
    """With an offset of the plug along +x, the rim pushes up at −x of its center, which is a torque about +y."""
    assert scripted_torque_search(observe_plug(torque_y=0.4))[0] < 0.0
    assert scripted_torque_search(observe_plug(torque_x=0.4))[1] > 0.0


@pytest.mark.parametrize("values", [{"time": -0.9}, {"time": 0.5}, {"z": 0.3}, {"force_z": 0.0}])
def test_torque_search_is_zero_when_not_on_the_rim(values):
    np.testing.assert_array_equal(
        scripted_torque_search(observe_plug(torque_x=1.0, torque_y=1.0, **values)), np.zeros(2)
    )


def test_torque_search_is_within_the_action_bounds():
    assert np.abs(scripted_torque_search(observe_plug(torque_x=3.0, torque_y=-3.0))).max() == 1.0


def observe_pressure(time=1.6, z=RIM, center=(0.0, 0.0), command=(0.0, 0.0)):
    """Return an observation with center of pressure and command [m], during the search on the rim."""
    result = np.zeros(17)
    result[0], result[3] = time / 4.0 - 1.0, (z - POSE_CENTER[2]) / POSE_SCALE[2]
    result[13:15], result[15:17] = np.array(center) / CENTER_OF_PRESSURE_SCALE, np.array(command) / COMMAND_SCALE
    return result


@pytest.mark.parametrize("length", [1.5 * MM, 5.0 * MM])
def test_pressure_policy_steps_to_the_center_of_pressure(length):
    action = scripted_center_of_pressure(observe_pressure(center=(0.0, -length), command=(1.0 * MM, 0.5 * MM)))
    np.testing.assert_allclose(action * REACH, [1.0 * MM, 0.5 * MM - STEP])


def test_pressure_policy_is_constant_when_below_the_rim():
    action = scripted_center_of_pressure(
        observe_pressure(z=RIM - 2.0 * MM, center=(5.0 * MM, 0.0), command=(1.0 * MM, 2.0 * MM))
    )
    np.testing.assert_allclose(action * REACH, [1.0 * MM, 2.0 * MM])


@pytest.mark.parametrize("time", [0.5, 3.8])
def test_pressure_policy_is_zero_before_and_after_the_search(time):
    np.testing.assert_array_equal(
        scripted_center_of_pressure(observe_pressure(time, center=(5.0 * MM, 0.0))), np.zeros(2)
    )


def test_pressure_policy_is_within_the_action_bounds():
    assert np.abs(scripted_center_of_pressure(observe_pressure(command=(6.0 * MM, -6.0 * MM)))).max() == 1.0


def test_pressure_policy_refuses_another_observation():
    with pytest.raises(InputError, match="observation"):
        scripted_center_of_pressure(np.zeros(13))


def observe_clamp(x_mm=0.0, y_mm=0.0, z_mm=12.0, fx=0.0, fy=0.0, fz=4.0):
    """Return the observation of a position [mm] and a force [N], by default on the table with 4 N."""
    return (np.array([x_mm * MM, y_mm * MM, z_mm * MM, fx, fy, fz]) - CENTER) / SCALE


def test_search_moves_to_its_start_before_the_descent():
    action = scripted_search(observe_clamp(z_mm=15.0, fz=0.0))
    assert action[0] < -0.3
    assert action[2] == 0.0
    at_start = scripted_search(observe_clamp(-LANE_ENDS / MM, LANES[0] / MM, 15.0, fz=0.0))
    np.testing.assert_allclose(at_start, [0.0, 0.0, -1.0], atol=1e-9)


def test_search_alternates_the_direction_of_lanes():
    directions = [np.sign(scripted_search(observe_clamp(0.0, y / MM))[0]) for y in LANES]
    assert directions == [1.0, -1.0, 1.0]
    assert scripted_search(observe_clamp(LANE_ENDS / MM, LANES[0] / MM))[1] > 0.0


def test_search_restarts_after_the_last_lane():
    action = scripted_search(observe_clamp(LANE_ENDS / MM, LANES[-1] / MM + 0.4))
    np.testing.assert_allclose(action, [0.0, 0.0, 1.0])
    assert scripted_search(observe_clamp(LANE_ENDS / MM - 0.5, LANES[-1] / MM))[0] > 0.0


def test_search_limits_its_force_and_yields_in_a_hole():
    assert scripted_search(observe_clamp(fz=8.0))[2] > 0.0 > scripted_search(observe_clamp(fz=1.0))[2]
    np.testing.assert_array_less(0.0, scripted_search(observe_clamp(z_mm=8.0, fx=2.0, fy=1.0))[:2])


def test_search_is_within_the_action_bounds():
    for fz in (-30.0, 30.0):
        assert np.abs(scripted_search(observe_clamp(4.0, 4.0, 5.0, 20.0, -20.0, fz))).max() <= 1.0
