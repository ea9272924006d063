import numpy as np
import pytest

from guiderail.tools.bnc_rule import FORCE_Z, TIME, TORQUE_X, TORQUE_Y, Z, reactive_rule


def observation(**values):
    names = {"time": TIME, "z": Z, "force_z": FORCE_Z, "torque_x": TORQUE_X, "torque_y": TORQUE_Y}
    result = np.zeros(13)
    searching = {"time": -0.4, "z": 0.68, "force_z": 0.5}
    for name, value in (searching | values).items():
        result[names[name]] = value
    return result


def test_moves_against_the_torque():
    """Off by +x, the rim pushes up at −x of the centre: that turns the plug about +y."""
    assert reactive_rule(observation(torque_y=0.4))[0] < 0.0
    assert reactive_rule(observation(torque_x=0.4))[1] > 0.0


@pytest.mark.parametrize("elsewhere", [{"time": -0.9}, {"time": 0.5}, {"z": 0.3}, {"force_z": 0.0}])
def test_stands_still_unless_it_stands_on_the_rim(elsewhere):
    np.testing.assert_array_equal(reactive_rule(observation(torque_x=1.0, torque_y=1.0, **elsewhere)), np.zeros(2))


def test_stays_within_an_actions_bounds():
    assert np.abs(reactive_rule(observation(torque_x=3.0, torque_y=-3.0))).max() == 1.0
