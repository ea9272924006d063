import numpy as np
import pytest

from guiderail.diagrams.tasks.bnc_connector.rewards import POSE_CENTRE, POSE_SCALE
from guiderail.diagrams.tasks.bnc_connector.scripted import REACH, STEP, scripted_center_of_pressure
from guiderail.models.common.errors import InputError
from guiderail.models.common.units import MM
from guiderail.models.objects.bnc_connector.motion import RIM
from guiderail.models.objects.insertion import COMMAND_SCALE, LEVER_SCALE


def seen(time=1.6, z=RIM, lever=(0.0, 0.0), command=(0.0, 0.0)):
    result = np.zeros(17)
    result[0], result[3] = time / 4.0 - 1.0, (z - POSE_CENTRE[2]) / POSE_SCALE[2]
    result[13:15], result[15:17] = np.array(lever) / LEVER_SCALE, np.array(command) / COMMAND_SCALE
    return result


@pytest.mark.parametrize("length", [1.5 * MM, 5.0 * MM])
def test_steps_along_the_lever_from_where_the_command_is(length):
    action = scripted_center_of_pressure(seen(lever=(0.0, -length), command=(1.0 * MM, 0.5 * MM)))
    np.testing.assert_allclose(action * REACH, [1.0 * MM, 0.5 * MM - STEP])


def test_stays_once_the_plug_has_dropped_in():
    action = scripted_center_of_pressure(seen(z=RIM - 2.0 * MM, lever=(5.0 * MM, 0.0), command=(1.0 * MM, 2.0 * MM)))
    np.testing.assert_allclose(action * REACH, [1.0 * MM, 2.0 * MM])


@pytest.mark.parametrize("time", [0.5, 3.8])
def test_does_nothing_before_and_after_the_search(time):
    np.testing.assert_array_equal(scripted_center_of_pressure(seen(time, lever=(5.0 * MM, 0.0))), np.zeros(2))


def test_stays_within_an_actions_bounds():
    assert np.abs(scripted_center_of_pressure(seen(command=(6.0 * MM, -6.0 * MM)))).max() == 1.0


def test_says_so_where_nothing_of_a_lever_is_observed():
    with pytest.raises(InputError, match="observation"):
        scripted_center_of_pressure(np.zeros(13))
