"""Contact physics of the connector on the gantry: pushing, turning and pulling, at both difficulties."""

from functools import cache

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.config import EnvConfig
from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.tasks.bnc_connector import BncWorkcell
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.demonstrations import CLEAR, poses
from oracles.connector import insert_and_lock

STIFFNESS = 1500.0  # of the station's translations [N/m]
HARD = EnvConfig.resolve("BncConnector", {"difficulty": "hard"}).declared
WORKCELL, HARD_WORKCELL = BncWorkcell(), HARD.workcell()
CASES = {"standard": (WORKCELL, 15.0), "hard": (HARD_WORKCELL, HARD.collision.above)}
"""Workcell, and largest force while the plug is locked [N]."""
# Height of the lugs at the ends of the slots' straight entries, relative to the locked pose [mm].
ENTRY_BOTTOM = (
    WORKCELL.dimensions.lug_height - WORKCELL.dimensions.entry_height - WORKCELL.dimensions.locked_height
) / MM
BARREL, LUG_TIP = WORKCELL.dimensions.barrel_radius, WORKCELL.dimensions.lug_tip_radius
JACK = np.array([3.0 * MM, -2.0 * MM, 1.0 * MM, 0.0, 0.0, 0.0])  # pose of the moved jack and of its motions


def lug_top(workcell):
    """Return the height of the plug's mouth on top of the lugs, relative to the locked pose [mm]."""
    size = workcell.dimensions
    return (size.lug_height + size.lug_radius - size.locked_height) / MM


def drive(times, z_mm, yaw_deg, case="standard", offset=0.0 * JACK):
    """Drive a plug along heights [mm] and yaw angles [degrees] at times [s]; return the recorded signals by name.

    Jack and motion are moved by `offset`, a pose (6,) without rotation; the recorded poses are relative to it.
    """
    workcell, _ = CASES[case]
    motion = poses(np.array(z_mm) * MM, np.deg2rad(yaw_deg)) + offset

    def move(plant, context):
        workcell.set_fixture_offset(plant, context, RigidTransform(offset[:3]))

    signals = drive_along(GantryStation(workcell), times, motion, move)[1].signals
    return signals | {"pose": signals["pose"] - offset}


@cache
def lock_pull_and_unlock(case):
    """Lock the plug in a moved jack, pull it for 1 s, and turn it back; return the signals of each motion."""
    lock_times, lock_poses = insert_and_lock()
    pull = 40.0 / STIFFNESS / MM + 5.0  # 5 mm more than the spring's extension [mm] at the limit of 40 N
    t = np.concatenate([lock_times, lock_times[-1] + np.array([0.5, 1.0, 1.5, 3.0, 3.2])])
    z = np.concatenate([lock_poses[:, 2] / MM, [pull, pull, 0, 0, 0]])
    yaw = np.concatenate([np.rad2deg(lock_poses[:, 3]), [0, 0, 0, 80, 80]])
    end = len(t) if case == "standard" else len(t) - 3  # a hard connector is not unlocked
    signals, locked = drive(t[:end], z[:end], yaw[:end], case, JACK), round(lock_times[-1] / 0.02)
    parts = slice(locked), slice(locked, locked + 50), slice(locked + 50, None)
    return [{name: signal[part] for name, signal in signals.items()} for part in parts]


def test_hard_connector_differs_from_the_standard():
    assert HARD_WORKCELL.dimensions != WORKCELL.dimensions


@pytest.mark.parametrize("case", CASES)
def test_plug_locks_at_the_nominal_pose(case):
    locked, _, _ = lock_pull_and_unlock(case)
    final = locked["pose"][-1]
    assert np.abs(final[:3]).max() < 0.3 * MM
    assert np.abs(np.rad2deg(final[3:])).max() < 1.0
    assert locked["impedance_force"].max() < CASES[case][1]
    assert case != "standard" or not locked["saturation"].any()


def test_wrench_equals_the_force_of_the_impedance():
    """While the plug turns slowly, from 3.0 s to 4.6 s."""
    turning, (locked, _, _) = slice(150, 230), lock_pull_and_unlock("standard")
    np.testing.assert_allclose(
        np.linalg.norm(locked["wrench"][turning, :3], axis=1), locked["impedance_force"][turning, 0], atol=0.6
    )


@pytest.mark.parametrize("case", CASES)
def test_rotation_is_blocked_before_insertion(case):
    """At a yaw of 45°, the mouth rests on the lugs under a push of 30 N."""
    top = lug_top(CASES[case][0])
    depth = top - 30.0 / STIFFNESS / MM
    recording = drive([0, 1.0, 2.0, 2.5], [CLEAR / MM, top + 1, depth, depth], [45, 45, 45, 45], case)
    assert recording["wrench"][-1, 2] == pytest.approx(30.0, abs=1.5)
    assert recording["pose"][-1, 2] == pytest.approx(top * MM, abs=0.1 * MM)


@pytest.mark.parametrize("lug_depth_in_slot", [1.5, 2.4])
def test_rotation_is_blocked_in_the_entry_slot(lug_depth_in_slot):
    """The walls of the entry stop a commanded quarter turn after a few degrees of play."""
    z = WORKCELL.dimensions.lug_height / MM - WORKCELL.dimensions.locked_height / MM - lug_depth_in_slot
    recording = drive([0, 1.5, 3.0, 3.5], [CLEAR / MM, z, z, z], [90, 90, 0, 0])
    assert np.rad2deg(recording["pose"][-1, 3]) > 80.0
    assert abs(recording["wrench"][-1, 5]) > 1.0


@pytest.mark.parametrize("case", CASES)
def test_locked_plug_resists_a_pull(case):
    _, recording, _ = lock_pull_and_unlock(case)
    assert recording["saturation"][-1, 0] == 1.0
    assert recording["wrench"][-1, 2] == pytest.approx(-40.0, abs=0.5)
    assert recording["pose"][-1, 2] < 0.5 * MM


def test_detent_has_a_break_out_torque():
    """The apex of the ramp resists turning back by at most 2 Nm."""
    _, _, recording = lock_pull_and_unlock("standard")
    resistance = np.abs(recording["wrench"][:, 5])
    in_detent = np.rad2deg(recording["pose"][:, 3]) < 8.0
    assert 0.02 < resistance[in_detent].max() < 2.0
    assert np.rad2deg(recording["pose"][-1, 3]) > 40.0


@pytest.mark.parametrize(("z_mm", "yaw_deg"), [(-40.0, 45.0), (-40.0, 90.0)])
def test_plug_does_not_tunnel_at_the_effort_limit(z_mm, yaw_deg):
    """At 45° the mouth rests on the lugs, and at 90° the lugs are at the end of their entries."""
    recording = drive([0, 1.0, 2.0, 3.0], [CLEAR / MM, 9.0, z_mm, z_mm], [yaw_deg] * 4)
    floor = lug_top(WORKCELL) if yaw_deg == 45.0 else ENTRY_BOTTOM
    assert recording["wrench"][-1, 2] == pytest.approx(40.0, abs=0.5)
    assert recording["pose"][-1, 2] > (floor - 0.6) * MM


@pytest.mark.parametrize(
    ("axis", "z_mm", "jack_radius"), [(0, 2.5, BARREL), (0, 8.9, BARREL), (1, 2.5, LUG_TIP), (1, 8.9, BARREL)]
)
def test_plug_from_the_side_stops_at_the_jack(axis, z_mm, jack_radius):
    """Without the ring's outer wall, its face entered the barrel, whose contact threw the plug out."""
    motion = np.zeros((3, 6))
    motion[:, axis], motion[:, 2] = np.array([-14.0, -10.0, -8.0]) * MM, z_mm * MM
    pose = drive_along(GantryStation(WORKCELL), np.array([0.0, 0.5, 1.0]), motion)[1]["pose"]
    assert pose[-1, axis] == pytest.approx(-WORKCELL.dimensions.ring_radius - jack_radius, abs=0.06 * MM)
    assert np.abs(pose[:, 2] - motion[0, 2]).max() < 0.01 * MM


def test_plug_beside_the_jack_stops_at_the_board():
    """Under the barrel, surfaces that are open would throw it out."""
    motion = np.zeros((3, 6))
    motion[:, 0], motion[:, 2] = -14.0 * MM, np.array([2.0, -6.0, -6.0]) * MM
    pose = drive_along(GantryStation(WORKCELL), np.array([0.0, 0.5, 1.0]), motion)[1]["pose"]
    assert pose[-1, 2] == pytest.approx(-2.0 * MM - WORKCELL.dimensions.locked_height, abs=0.02 * MM)


def test_lugs_do_not_tunnel_at_the_effort_limit():
    recording = drive([0, 1.0, 2.5, 3.5], [CLEAR / MM, 3.0, 3.0, 3.0], [90, 90, -90, -90])
    assert recording["saturation"][-1, 0] == 1.0
    assert np.rad2deg(recording["pose"][-1, 3]) > 80.0


def test_locked_pose_is_insensitive_to_the_time_step():
    locked, _, _ = lock_pull_and_unlock("standard")
    times, motion = insert_and_lock()
    _, recording = drive_along(GantryStation(WORKCELL, time_step=0.0025), times, motion)
    difference = recording["pose"][-1] - locked["pose"][-1]
    assert np.abs(difference[:3]).max() < 0.1 * MM
    assert np.abs(np.rad2deg(difference[3:])).max() < 0.5


def test_plug_locks_with_a_grasp_offset():
    offset = np.array([1.5 * MM, 0.0, 0.0])
    times, motion = insert_and_lock()

    def grasp(plant, context):
        WORKCELL.set_grasp_offset(plant, context, RigidTransform(offset))

    # The offset turns with the tool, so the tool center moves along an arc while the plug turns about its axis.
    fine = np.linspace(0.0, times[-1], 401)
    dense = np.stack([np.interp(fine, times, column) for column in motion.T], axis=1)
    dense[:, 0] -= offset[0] * np.cos(dense[:, 3])
    dense[:, 1] -= offset[0] * np.sin(dense[:, 3])
    driven, _ = drive_along(GantryStation(WORKCELL), fine, dense, grasp)
    X = WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context)
    assert np.abs(X.translation()).max() < 0.3 * MM


def test_uncorrected_offset_of_1_5_mm_jams():
    def move(plant, context):
        WORKCELL.set_fixture_offset(plant, context, RigidTransform([1.5 * MM, 0.0, 0.0]))

    times, motion = insert_and_lock()
    _, recording = drive_along(GantryStation(WORKCELL), times, motion, move)
    assert recording["pose"][-1, 2] > ENTRY_BOTTOM * MM + 2.0 * MM
    assert recording["impedance_force"].max() > 15.0
