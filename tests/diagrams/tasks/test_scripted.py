import numpy as np
import pytest

from guiderail.diagrams.tasks.bnc_connector import task as connector
from guiderail.diagrams.tasks.bnc_connector.task import (
    POSE_CENTER,
    POSE_SCALE,
    REACH,
    STEP,
    scripted_center_of_pressure,
    scripted_torque_search,
)
from guiderail.diagrams.tasks.grid_clamp.task import CENTER, LANE_ENDS, LANES, SCALE, scripted_search
from guiderail.diagrams.tasks.options import CENTER_OF_PRESSURE_SCALE, COMMAND_SCALE
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.demonstrations import RIM


def seen_plug(**values):
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
    """Off by +x, the rim pushes up at −x of the center: that turns the plug about +y."""
    assert scripted_torque_search(seen_plug(torque_y=0.4))[0] < 0.0
    assert scripted_torque_search(seen_plug(torque_x=0.4))[1] > 0.0


@pytest.mark.parametrize("elsewhere", [{"time": -0.9}, {"time": 0.5}, {"z": 0.3}, {"force_z": 0.0}])
def test_torque_search_stands_still_off_the_rim(elsewhere):
    np.testing.assert_array_equal(
        scripted_torque_search(seen_plug(torque_x=1.0, torque_y=1.0, **elsewhere)), np.zeros(2)
    )


def test_torque_search_stays_within_bounds():
    assert np.abs(scripted_torque_search(seen_plug(torque_x=3.0, torque_y=-3.0))).max() == 1.0


def seen_pressure(time=1.6, z=RIM, lever=(0.0, 0.0), command=(0.0, 0.0)):
    result = np.zeros(17)
    result[0], result[3] = time / 4.0 - 1.0, (z - POSE_CENTER[2]) / POSE_SCALE[2]
    result[13:15], result[15:17] = np.array(lever) / CENTER_OF_PRESSURE_SCALE, np.array(command) / COMMAND_SCALE
    return result


@pytest.mark.parametrize("length", [1.5 * MM, 5.0 * MM])
def test_center_of_pressure_policy_steps_towards_it(length):
    action = scripted_center_of_pressure(seen_pressure(lever=(0.0, -length), command=(1.0 * MM, 0.5 * MM)))
    np.testing.assert_allclose(action * REACH, [1.0 * MM, 0.5 * MM - STEP])


def test_center_of_pressure_policy_stays_after_the_drop():
    action = scripted_center_of_pressure(
        seen_pressure(z=RIM - 2.0 * MM, lever=(5.0 * MM, 0.0), command=(1.0 * MM, 2.0 * MM))
    )
    np.testing.assert_allclose(action * REACH, [1.0 * MM, 2.0 * MM])


@pytest.mark.parametrize("time", [0.5, 3.8])
def test_center_of_pressure_policy_waits_outside_the_search(time):
    np.testing.assert_array_equal(scripted_center_of_pressure(seen_pressure(time, lever=(5.0 * MM, 0.0))), np.zeros(2))


def test_center_of_pressure_policy_stays_within_bounds():
    assert np.abs(scripted_center_of_pressure(seen_pressure(command=(6.0 * MM, -6.0 * MM)))).max() == 1.0


def test_center_of_pressure_policy_refuses_another_observation():
    with pytest.raises(InputError, match="observation"):
        scripted_center_of_pressure(np.zeros(13))


def seen_clamp(x_mm=0.0, y_mm=0.0, z_mm=12.0, fx=0.0, fy=0.0, fz=4.0):
    seen = np.array([x_mm * MM, y_mm * MM, z_mm * MM, fx, fy, fz])
    return (seen - CENTER) / SCALE


def test_search_goes_to_its_start_before_it_descends():
    inputs = scripted_search(seen_clamp(z_mm=15.0, fz=0.0))
    assert inputs[0] < -0.3
    assert inputs[2] == 0.0
    there = scripted_search(seen_clamp(-LANE_ENDS / MM, LANES[0] / MM, 15.0, fz=0.0))
    np.testing.assert_allclose(there, [0.0, 0.0, -1.0], atol=1e-9)


def test_search_alternates_the_direction_of_lanes():
    along = [np.sign(scripted_search(seen_clamp(0.0, y / MM))[0]) for y in LANES]
    assert along == [1.0, -1.0, 1.0]
    assert scripted_search(seen_clamp(LANE_ENDS / MM, LANES[0] / MM))[1] > 0.0


def test_search_that_missed_all_lanes_lifts_and_starts_again():
    lifts = scripted_search(seen_clamp(LANE_ENDS / MM, LANES[-1] / MM + 0.4))
    np.testing.assert_allclose(lifts, [0.0, 0.0, 1.0])
    assert scripted_search(seen_clamp(LANE_ENDS / MM - 0.5, LANES[-1] / MM))[0] > 0.0


def test_search_presses_lightly_and_yields_in_a_hole():
    assert scripted_search(seen_clamp(fz=8.0))[2] > 0.0 > scripted_search(seen_clamp(fz=1.0))[2]
    np.testing.assert_array_less(0.0, scripted_search(seen_clamp(z_mm=8.0, fx=2.0, fy=1.0))[:2])


def test_search_stays_within_bounds():
    for fz in (-30.0, 30.0):
        assert np.abs(scripted_search(seen_clamp(4.0, 4.0, 5.0, 20.0, -20.0, fz))).max() <= 1.0
