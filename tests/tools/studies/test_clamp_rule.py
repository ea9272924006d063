import numpy as np

from guiderail.diagrams.tasks.grid_clamp import CENTRE, MM, SCALE
from guiderail.tools.studies.clamp_rule import LANE_ENDS, LANES, searching_rule


def observation(x_mm=0.0, y_mm=0.0, z_mm=12.0, fx=0.0, fy=0.0, fz=4.0):
    seen = np.array([x_mm * MM, y_mm * MM, z_mm * MM, fx, fy, fz])
    return (seen - CENTRE) / SCALE


def test_goes_to_where_it_begins_before_it_comes_down():
    inputs = searching_rule(observation(z_mm=15.0, fz=0.0))
    assert inputs[0] < -0.3
    assert inputs[2] == 0.0
    there = searching_rule(observation(-LANE_ENDS / MM, LANES[0] / MM, 15.0, fz=0.0))
    np.testing.assert_allclose(there, [0.0, 0.0, -1.0], atol=1e-9)


def test_lanes_lead_each_the_other_way():
    along = [np.sign(searching_rule(observation(0.0, y / MM))[0]) for y in LANES]
    assert along == [1.0, -1.0, 1.0]
    assert searching_rule(observation(LANE_ENDS / MM, LANES[0] / MM))[1] > 0.0


def test_presses_lightly_and_gives_way_in_a_hole():
    assert searching_rule(observation(fz=8.0))[2] > 0.0 > searching_rule(observation(fz=1.0))[2]
    np.testing.assert_array_less(0.0, searching_rule(observation(z_mm=8.0, fx=2.0, fy=1.0))[:2])


def test_stays_within_an_inputs_bounds():
    for fz in (-30.0, 30.0):
        assert np.abs(searching_rule(observation(4.0, 4.0, 5.0, 20.0, -20.0, fz))).max() <= 1.0
