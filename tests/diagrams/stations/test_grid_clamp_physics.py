"""Contact physics of the grid clamp: pushing, tilting and pulling."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.grid_clamp import GridClampWorkcell
from guiderail.models.common.transforms import MM

WORKCELL = GridClampWorkcell()
SURFACE = WORKCELL.dimensions.peg_length  # height of the peg tips on the table, in the target frame [m]
MAX_OFFSET = 1.0 * MM  # largest distance of a peg tip in a hole from the hole's center [m]
PUSH_60_N = Impedance(limits=(60.0, 60.0, 60.0, 3.0, 3.0, 3.0))


def descend(times, z_mm, *, xy_mm=(0.0, 0.0), tilt_deg=0.0, grasp_mm=None, table_mm=None, station=GantryStation, **kw):
    """Drive along heights at a horizontal position and a tilt about x.

    Args:
        times: Times [s] of the heights `z_mm` [mm].
        grasp_mm, table_mm: Horizontal offsets [mm] of the clamp in the gripper and of the table.

    Returns:
        Driven station and recording.
    """
    poses = np.zeros((len(times), 6))
    poses[:, :2] = np.array(xy_mm) * MM
    poses[:, 2] = np.array(z_mm) * MM
    poses[:, 5] = np.deg2rad(tilt_deg)

    def set_offsets(plant, context):
        if grasp_mm is not None:
            WORKCELL.set_grasp_offset(plant, context, RigidTransform([*(np.array(grasp_mm) * MM), 0.0]))
        if table_mm is not None:
            WORKCELL.set_fixture_offset(plant, context, RigidTransform([*(np.array(table_mm) * MM), 0.0]))

    return drive_along(station(WORKCELL, **kw), times, poses, set_offsets)


@pytest.fixture(scope="module")
def inserted():
    return descend([0.0, 0.88, 1.2], [16.0, -6.0, -6.0])


def test_clamp_snaps_in_with_at_most_10_n(inserted):
    driven, recording = inserted
    X = WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context)
    assert np.abs(X.translation()).max() < 0.1 * MM
    assert recording["impedance_force"].max() <= 10.0
    assert np.abs(recording["wrench"][:, :3]).max() <= 10.0


@pytest.mark.parametrize(
    ("position_mm", "is_seated"),
    [
        ((0.0, 0.0, 0.0), True),
        ((0.0, 0.0, 0.4), True),
        ((0.0, 0.0, -0.4), True),
        ((0.0, 0.0, 0.6), False),
        ((0.0, 0.0, -0.6), False),  # the shoulder would be below the table's face
        ((0.0, 0.0, -50.0), False),
        ((1.1, 0.0, 0.0), False),
    ],
)
def test_clamp_is_seated_only_near_the_target(position_mm, is_seated):
    clamp = np.zeros(6)
    clamp[:3] = WORKCELL.X_FT.translation() + np.array(position_mm) * MM
    assert WORKCELL.is_seated(clamp) is is_seated


def test_snap_force_peaks_at_the_lip(inserted):
    """The force grows up to the lip, drops past the lip, and grows again at the shoulder."""
    _, recording = inserted
    z, force = recording["pose"][:, 2] / MM, recording["wrench"][:, 2]
    at_lip, past_lip = (z > 0.9) & (z < 1.3), (z > 0.1) & (z < 0.5)
    assert 2.0 < force[at_lip].max() < 8.0
    assert force[past_lip].max() < 0.5 * force[at_lip].max()
    assert force[-1] > force[past_lip].max()


def test_snap_holds_at_a_light_pull_but_not_at_a_strong_pull():
    _, recording = descend([0, 0.9, 1.4, 2.0, 3.5, 4.2], [16, -6, -6, 1, 1, 16])
    z, force = recording["pose"][:, 2], recording["wrench"][:, 2]
    assert z[170] < 0.6 * MM  # still inserted at a pull of 1.5 N: 1 mm of the station's spring
    assert z[-1] > 10.0 * MM
    assert -12.0 < force.min() < -2.0


@pytest.mark.parametrize(("xy_mm", "tilt_deg"), [((2.5, 0.0), 0.0), ((1.5, 1.5), 0.0), ((0.0, 0.0), 6.0), ((0, 3), 4)])
def test_pegs_do_not_tunnel_through_the_table_at_60_n(xy_mm, tilt_deg):
    """With the clamp shifted or tilted, no peg tip outside its own hole is below the table's surface."""
    driven, recording = descend(
        [0, 0.5, 1.5, 2.5], [22, 12, -40, -40], xy_mm=xy_mm, tilt_deg=tilt_deg, impedance=PUSH_60_N
    )
    assert recording["wrench"][-1, 2] == pytest.approx(60.0, abs=1.0)
    X = WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context)
    d = WORKCELL.dimensions
    tips = X @ np.column_stack([d.peg_positions, np.zeros(5)]).T
    is_outside = np.hypot(*(tips[:2] - d.peg_positions.T)) > MAX_OFFSET
    assert (tips[2][is_outside] > SURFACE - 0.2 * MM).all()
    assert is_outside.all() or tilt_deg != 0.0


def test_seated_clamp_does_not_tunnel_sideways_at_60_n():
    poses = np.zeros((4, 6))
    poses[:, 2] = np.array([16.0, -4.0, -4.0, -4.0]) * MM
    poses[2:, 0] = 60.0 * MM
    driven, recording = drive_along(GantryStation(WORKCELL, PUSH_60_N), [0, 0.8, 2.0, 2.5], poses)
    assert abs(recording["wrench"][-1, 0]) > 50.0
    assert (
        np.abs(WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context).translation()).max() < 0.3 * MM
    )


def test_snap_is_insensitive_to_the_time_step(inserted):
    _, fine = descend([0.0, 0.88, 1.2], [16.0, -6.0, -6.0], time_step=0.0025)
    assert np.abs(fine["pose"][-1, :3] - inserted[1]["pose"][-1, :3]).max() < 0.05 * MM
    peak, fine_peak = (r["wrench"][r["pose"][:, 2] > 0.9 * MM, 2].max() for r in (inserted[1], fine))
    assert fine_peak == pytest.approx(peak, rel=0.15)


@pytest.mark.parametrize("part", ["grasp_mm", "table_mm"])
def test_clamp_inserts_when_the_command_includes_the_offset(part):
    """The clamp is blocked at the nominal pose, and inserts if the command compensates the offset."""
    offset = np.array([1.8, -1.2])
    _, blocked = descend([0, 0.88, 1.2], [16, -6, -6], **{part: offset})
    assert blocked["pose"][-1, 2] > SURFACE - 0.2 * MM
    _, result = descend([0, 0.88, 1.2], [16, -6, -6], **{part: offset}, xy_mm=-offset if part == "grasp_mm" else offset)
    assert abs(result["pose"][-1, 2]) < 0.1 * MM
    assert result["impedance_force"].max() <= 10.0


def test_sticking_contact_does_not_creep():
    """Next to its holes, the clamp presses with 27 N and is pushed sideways by 2 N for 3 s; it would slip at 5.4 N."""
    sideways = 2.5 + 2.0 / 1.5  # 2 N at 1.5 N/mm [mm]
    z_x = np.array([[16.0, 2.5], [-6.0, 2.5], [-6.0, sideways], [-6.0, sideways]])
    _, recording = drive_along(
        GantryStation(WORKCELL),
        [0.0, 0.9, 1.0, 4.5],
        MM * np.column_stack([z_x[:, 1], [1.0] * 4, z_x[:, 0], np.zeros((4, 3))]),
    )
    assert recording["wrench"][-1, 2] == pytest.approx(27.0, abs=0.2)
    assert recording["wrench"][-1, 0] == pytest.approx(-2.0, abs=0.1)
    x = recording["pose"][:, 0]
    assert abs(x[-1] - x[-150]) < 0.03 * MM  # within 3 s


def test_arm_inserts_the_clamp():
    driven, recording = descend([0.0, 1.8, 2.0], [16.0, -6.0, -6.0], station=ArmStation)
    X = WORKCELL.workpiece_in_target(driven.station.plant, driven.plant_context)
    assert np.abs(X.translation()).max() < 0.3 * MM
    assert recording["impedance_force"].max() <= 10.0
