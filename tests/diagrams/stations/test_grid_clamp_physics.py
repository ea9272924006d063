"""The grid clamp's physics, by pushing, tilting and pulling it."""

import numpy as np
import pytest
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.recording import drive_along
from guiderail.diagrams.stations.arm import ArmStation
from guiderail.diagrams.stations.gantry import GantryStation
from guiderail.diagrams.stations.station import Impedance
from guiderail.diagrams.tasks.grid_clamp.workcell import GridClampWorkcell
from guiderail.models.common.units import MM

WORKCELL = GridClampWorkcell()
SURFACE = WORKCELL.dimensions.peg_length  # height of the tips in T when they stand on the table
BESIDE = 1.0 * MM  # farther than this from its hole's centre a tip is not in the hole
PUSH_60_N = Impedance(limits=(60.0, 60.0, 60.0, 3.0, 3.0, 3.0))


def descend(times, z_mm, *, xy_mm=(0.0, 0.0), tilt_deg=0.0, grasp_mm=None, table_mm=None, station=GantryStation, **kw):
    """Drives along z at a place and a tilt; returns the driven station and the recording."""
    poses = np.zeros((len(times), 6))
    poses[:, :2] = np.array(xy_mm) * MM
    poses[:, 2] = np.array(z_mm) * MM
    poses[:, 5] = np.deg2rad(tilt_deg)

    def offset(plant, context):
        if grasp_mm is not None:
            WORKCELL.set_grasp_offset(plant, context, RigidTransform([*(np.array(grasp_mm) * MM), 0.0]))
        if table_mm is not None:
            WORKCELL.set_table_offset(plant, context, RigidTransform([*(np.array(table_mm) * MM), 0.0]))

    return drive_along(station(WORKCELL, **kw), times, poses, offset)


@pytest.fixture(scope="module")
def inserted():
    return descend([0.0, 0.88, 1.2], [16.0, -6.0, -6.0])


def test_known_pose_snaps_in_with_at_most_ten_newtons(inserted):
    driven, recording = inserted
    X = WORKCELL.clamp_in_target(driven.station.plant, driven.plant_context)
    assert np.abs(X.translation()).max() < 0.1 * MM
    assert recording["contact_force"].max() <= 10.0
    assert np.abs(recording["wrench"][:, :3]).max() <= 10.0


def test_the_snap_resists_and_then_gives_way(inserted):
    """Force grows over the lip, falls away past it, and only then comes back: from the shoulder."""
    _, recording = inserted
    z, force = recording["pose"][:, 2] / MM, recording["wrench"][:, 2]
    at_lip, past_lip = (z > 0.9) & (z < 1.3), (z > 0.1) & (z < 0.5)
    assert 2.0 < force[at_lip].max() < 8.0
    assert force[past_lip].max() < 0.5 * force[at_lip].max()
    assert force[-1] > force[past_lip].max()


def test_the_snap_holds_against_a_light_pull_and_yields_to_a_strong_one():
    _, recording = descend([0, 0.9, 1.4, 2.0, 3.5, 4.2], [16, -6, -6, 1, 1, 16])
    z, force = recording["pose"][:, 2], recording["wrench"][:, 2]
    assert z[170] < 0.6 * MM  # pulled by 1 mm of spring, 1.5 N, and still in
    assert z[-1] > 10.0 * MM
    assert -12.0 < force.min() < -2.0


@pytest.mark.parametrize(("xy_mm", "tilt_deg"), [((2.5, 0.0), 0.0), ((1.5, 1.5), 0.0), ((0.0, 0.0), 6.0), ((0, 3), 4)])
def test_sixty_newtons_do_not_force_the_pegs_through_the_table(xy_mm, tilt_deg):
    """Beside its hole or tilted: no tip gets below the table's face anywhere but in its own hole."""
    driven, recording = descend(
        [0, 0.5, 1.5, 2.5], [22, 12, -40, -40], xy_mm=xy_mm, tilt_deg=tilt_deg, impedance=PUSH_60_N
    )
    assert recording["wrench"][-1, 2] == pytest.approx(60.0, abs=1.0)
    X = WORKCELL.clamp_in_target(driven.station.plant, driven.plant_context)
    d = WORKCELL.dimensions
    tips = X @ np.column_stack([d.peg_positions, np.zeros(5)]).T
    beside = np.hypot(*(tips[:2] - d.peg_positions.T)) > BESIDE
    assert (tips[2][beside] > SURFACE - 0.2 * MM).all()
    assert beside.all() or tilt_deg != 0.0


def test_sixty_newtons_sideways_do_not_pull_a_seated_clamp_through_the_walls():
    poses = np.zeros((4, 6))
    poses[:, 2] = np.array([16.0, -4.0, -4.0, -4.0]) * MM
    poses[2:, 0] = 60.0 * MM
    driven, recording = drive_along(GantryStation(WORKCELL, PUSH_60_N), [0, 0.8, 2.0, 2.5], poses)
    assert abs(recording["wrench"][-1, 0]) > 50.0
    assert np.abs(WORKCELL.clamp_in_target(driven.station.plant, driven.plant_context).translation()).max() < 0.3 * MM


def test_halving_the_plant_step_changes_the_snap_little(inserted):
    _, fine = descend([0.0, 0.88, 1.2], [16.0, -6.0, -6.0], time_step=0.0025)
    assert np.abs(fine["pose"][-1, :3] - inserted[1]["pose"][-1, :3]).max() < 0.05 * MM
    peak, fine_peak = (r["wrench"][r["pose"][:, 2] > 0.9 * MM, 2].max() for r in (inserted[1], fine))
    assert fine_peak == pytest.approx(peak, rel=0.15)


@pytest.mark.parametrize("moved", ["grasp_mm", "table_mm"])
def test_offsets_moved_in_the_context_are_where_the_clamp_goes_in(moved):
    """Blocked where the nominal pose leads; in where the command makes up for the offset."""
    offset = np.array([1.8, -1.2])
    _, blocked = descend([0, 0.88, 1.2], [16, -6, -6], **{moved: offset})
    assert blocked["pose"][-1, 2] > SURFACE - 0.2 * MM
    _, found = descend(
        [0, 0.88, 1.2], [16, -6, -6], **{moved: offset}, xy_mm=-offset if moved == "grasp_mm" else offset
    )
    assert abs(found["pose"][-1, 2]) < 0.1 * MM
    assert found["contact_force"].max() <= 10.0


def test_what_friction_bears_does_not_creep():
    """Beside its holes, 27 N down and 2 N sideways, where 5.4 N would slip: it keeps its place for three seconds."""
    poses = np.array([[16.0, 2.5], [-6.0, 2.5], [-6.0, 2.5 + 2.0 / 1.5], [-6.0, 2.5 + 2.0 / 1.5]])  # 1.5 N/mm
    _, recording = drive_along(
        GantryStation(WORKCELL),
        [0.0, 0.9, 1.0, 4.5],
        MM * np.column_stack([poses[:, 1], [1.0] * 4, poses[:, 0], np.zeros((4, 3))]),
    )
    assert recording["wrench"][-1, 2] == pytest.approx(27.0, abs=0.2)
    assert recording["wrench"][-1, 0] == pytest.approx(-2.0, abs=0.1)
    x = recording["pose"][:, 0]
    assert abs(x[-1] - x[-150]) < 0.03 * MM


def test_the_arm_inserts_too():
    driven, recording = descend([0.0, 1.8, 2.0], [16.0, -6.0, -6.0], station=ArmStation)
    X = WORKCELL.clamp_in_target(driven.station.plant, driven.plant_context)
    assert np.abs(X.translation()).max() < 0.3 * MM
    assert recording["contact_force"].max() <= 10.0
