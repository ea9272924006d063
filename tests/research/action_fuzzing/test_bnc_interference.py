"""Interference between plug and jack of the rigid connector."""

import numpy as np
import pytest
from pydrake.math import RotationMatrix

from guiderail.models.objects.bnc_connector import BncDimensions
from research.action_fuzzing.bnc_connector import interference, slot_path

MM = 1e-3
D = BncDimensions()


def depth(lug_angle, lug_depth, x=0.0, y=0.0):
    """Return the interference [mm] of an upright plug.

    Args:
        lug_angle: Angle of a lug [degrees].
        lug_depth: Depth of the lug in the slot [mm].
        x: Offset of the plug along x [mm].
        y: Offset of the plug along y [mm].
    """
    R_JP = RotationMatrix.MakeZRotation(-np.deg2rad(lug_angle)).matrix()
    return max(interference(D, R_JP, np.array([x * MM, y * MM, D.lug_height - lug_depth * MM]))) / MM


def test_lug_path_is_free():
    for arc, lug_depth in slot_path(D):
        for lug_offset in (0.0, 180.0):  # angles of the two lugs [degrees]
            angle = np.rad2deg(arc / D.slot_radius) + lug_offset
            assert depth(angle, max(lug_depth / MM, -5.0)) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("lug_angle", [30.0, 60.0, 120.0, 150.0])
def test_mouth_face_stops_lugs_outside_the_slot(lug_angle):
    radius = D.lug_radius / MM
    assert depth(lug_angle, -radius - 0.01) == 0.0
    assert depth(lug_angle, -radius + 0.4) == pytest.approx(0.4)


def test_slot_walls_stop_lugs():
    clearance = D.slot_clearance / MM
    assert depth(0.0, 4.4) == pytest.approx(1.0 - clearance, abs=0.1)  # below the bottom of the entry
    assert depth(45.0, 3.0) > 0.8  # above the ramp
    # 10 degrees behind the detent:
    assert depth(100.0, 5.0) == pytest.approx(np.deg2rad(10.0) * D.slot_radius / MM - clearance, abs=1e-6)
    assert depth(20.0, 1.5) > 1.0  # turned in the straight entry


def test_lugs_and_barrel_have_separate_depths():
    upright = np.eye(3)
    lugs, barrel = interference(D, upright, np.array([0.0, 0.0, D.lug_height - 4.4 * MM]))
    assert lugs > 0.8 * MM
    assert barrel == 0.0
    lugs, barrel = interference(D, upright, np.array([3.0 * MM, 0.0, D.barrel_height - 0.2 * MM]))
    assert lugs == 0.0
    assert barrel == pytest.approx(0.2 * MM)


def test_bore_stops_the_barrel():
    deep = 3.0
    assert depth(0.0, deep, x=0.09) == 0.0
    assert depth(0.0, deep, x=1.1) == pytest.approx(1.0)
    # The plug does not touch the jack above the rim or next to the jack.
    on_rim = (D.lug_height - D.barrel_height) / MM
    assert depth(0.0, on_rim, x=3.0) == 0.0
    assert depth(0.0, on_rim + 0.2, x=3.0) == pytest.approx(0.2)
    assert depth(0.0, on_rim + 5.0, x=12.0) == 0.0
