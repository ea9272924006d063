"""Physics of the connector: pushing, turning and pulling."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.bnc_connector.task import BncWorkcell
from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector.demonstrations import CLEAR, insert_and_lock, poses

STIFFNESS = 1500.0
WORKCELL = BncWorkcell()
# Heights of the mouth in the locked frame: on top of the lugs,
LUG_TOP = (WORKCELL.dimensions.lug_height + WORKCELL.dimensions.lug_radius - WORKCELL.dimensions.locked_height) / MM
# and with the lugs at the bottom of the straight entries.
ENTRY_BOTTOM = (
    WORKCELL.dimensions.lug_height - WORKCELL.dimensions.entry_height - WORKCELL.dimensions.locked_height
) / MM


def run(times, z_mm, yaw_deg, *, time_step=0.005, impedance=None, prepare=None):
    station = GantryStation(WORKCELL, impedance or Impedance(), time_step)
    motion = poses(np.array(z_mm) * MM, np.deg2rad(yaw_deg))
    return drive_along(station, times, motion, prepare)


def lock_and(times, z_mm, yaw_deg):
    """Return the recordings until the plug is locked, and along further poses."""
    lock_times, lock_poses = insert_and_lock()
    t = np.concatenate([lock_times, lock_times[-1] + np.array(times)])
    z = np.concatenate([lock_poses[:, 2] / MM, z_mm])
    yaw = np.concatenate([np.rad2deg(lock_poses[:, 3]), yaw_deg])
    signals, end = run(t, z, yaw)[1].signals, round(lock_times[-1] / 0.02)
    return tuple({name: signal[part] for name, signal in signals.items()} for part in (slice(end), slice(end, None)))


@pytest.fixture(scope="module")
def locked_and_pulled():
    pull = 40.0 / STIFFNESS / MM + 5.0  # beyond the effort limit
    return lock_and([0.5, 1.0], [pull, pull], [0, 0])


@pytest.fixture(scope="module")
def locked(locked_and_pulled):
    return locked_and_pulled[0]


def test_plug_locks_at_the_nominal_pose(locked):
    final = locked["pose"][-1]
    assert np.abs(final[:3]).max() < 0.3 * MM
    assert np.abs(np.rad2deg(final[3:])).max() < 1.0
    assert locked["contact_force"].max() < 15.0
    assert not locked["saturation"].any()


def test_wrench_equals_the_force_of_the_impedance(locked):
    """At rest on the seat, and while turning slowly."""
    turning = slice(250, 330)
    np.testing.assert_allclose(
        np.linalg.norm(locked["wrench"][turning, :3], axis=1), locked["contact_force"][turning, 0], atol=0.6
    )


def test_rotation_is_blocked_before_insertion():
    """Turned by 45°, the mouth's face rests on the lugs, with and without a push of 30 N."""
    depth = LUG_TOP - 30.0 / STIFFNESS / MM
    _, recording = run([0, 1.5, 2.5, 3.5], [CLEAR / MM, LUG_TOP + 1, depth, depth], [45, 45, 45, 45])
    assert recording["wrench"][-1, 2] == pytest.approx(30.0, abs=1.5)
    assert recording["pose"][-1, 2] == pytest.approx(LUG_TOP * MM, abs=0.1 * MM)


@pytest.mark.parametrize("lug_depth_in_slot", [1.5, 2.4])
def test_rotation_is_blocked_in_the_entry_slot(lug_depth_in_slot):
    """With the lugs between the walls of the entry, a commanded quarter turn turns it by a few degrees of play."""
    z = WORKCELL.dimensions.lug_height / MM - WORKCELL.dimensions.locked_height / MM - lug_depth_in_slot
    _, recording = run([0, 1.5, 3.0, 3.5], [CLEAR / MM, z, z, z], [90, 90, 0, 0])
    assert np.rad2deg(recording["pose"][-1, 3]) > 80.0
    assert abs(recording["wrench"][-1, 5]) > 1.0


def test_locked_plug_resists_a_pull(locked_and_pulled):
    _, recording = locked_and_pulled
    assert recording["saturation"][-1, 0] == 1.0
    assert recording["wrench"][-1, 2] == pytest.approx(-40.0, abs=0.5)
    assert recording["pose"][-1, 2] < 0.5 * MM


def test_detent_has_a_break_out_torque():
    """The ramp's apex resists turning back without a push, up to a torque."""
    _, recording = lock_and([1.5, 1.7], [0, 0], [80, 80])
    resistance = np.abs(recording["wrench"][:, 5])
    in_detent = np.rad2deg(recording["pose"][:, 3]) < 8.0
    assert 0.02 < resistance[in_detent].max() < 2.0
    assert np.rad2deg(recording["pose"][-1, 3]) > 40.0


@pytest.mark.parametrize(("z_mm", "yaw_deg"), [(-40.0, 45.0), (-40.0, 90.0)])
def test_plug_does_not_tunnel_at_the_effort_limit(z_mm, yaw_deg):
    """On the lugs and on the seat, with the largest force."""
    _, recording = run([0, 1.0, 2.0, 3.0], [CLEAR / MM, 9.0, z_mm, z_mm], [yaw_deg] * 4)
    floor = (
        LUG_TOP
        if yaw_deg == 45.0
        else WORKCELL.dimensions.lug_height / MM - 3.4 - WORKCELL.dimensions.locked_height / MM
    )
    assert recording["wrench"][-1, 2] == pytest.approx(40.0, abs=0.5)
    assert recording["pose"][-1, 2] > (floor - 0.6) * MM


def test_lugs_do_not_tunnel_at_the_effort_limit():
    _, recording = run([0, 1.0, 2.5, 3.5], [CLEAR / MM, 3.0, 3.0, 3.0], [90, 90, -90, -90])
    assert recording["saturation"][-1, 0] == 1.0
    assert np.rad2deg(recording["pose"][-1, 3]) > 80.0


def test_locked_pose_is_insensitive_to_the_time_step(locked):
    times, motion = insert_and_lock()
    _, recording = drive_along(GantryStation(WORKCELL, time_step=0.0025), times, motion)
    difference = recording["pose"][-1] - locked["pose"][-1]
    assert np.abs(difference[:3]).max() < 0.1 * MM
    assert np.abs(np.rad2deg(difference[3:])).max() < 0.5


def test_plug_locks_on_a_jack_moved_in_the_context():
    X_TTactual = RigidTransform([3.0 * MM, -2.0 * MM, 1.0 * MM])
    times, motion = insert_and_lock()
    shifted = motion + np.array([*X_TTactual.translation(), 0, 0, 0])

    def move(plant, context):
        WORKCELL.set_fixture_offset(plant, context, X_TTactual)

    driven, recording = drive_along(GantryStation(WORKCELL), times, shifted, move)
    X = WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context)
    assert np.abs(X.translation()).max() < 0.3 * MM
    np.testing.assert_allclose(recording["pose"][-1, :3], X_TTactual.translation(), atol=0.3 * MM)


def test_plug_locks_with_a_grasp_offset():
    offset = np.array([1.5 * MM, 0.0, 0.0])
    times, motion = insert_and_lock()

    def grasp(plant, context):
        WORKCELL.set_grasp_offset(plant, context, RigidTransform(offset))

    # The offset turns with the tool, so the path of the tool center is an arc.
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
    assert recording["contact_force"].max() > 15.0
