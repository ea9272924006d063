"""Checks of a plug and its socket: overlap, clearance of the walls, path to the target, and symmetries."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import DEGREE
from guiderail_parts.geometry.assembly_check import (
    SYMMETRIES,
    OverlapError,
    check_target,
    compute_center_of_mass,
    compute_radius_of_gyration,
    find_obstructions,
    find_symmetries,
    make_solids,
    measure_side_clearance,
    plan_motion,
    shrink,
)
from guiderail_parts.geometry.demonstrator import plan_straight_insertion
from guiderail_parts.geometry.mesh_file import Part, load_part

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")
pytest.importorskip("igl")

from manifold3d import CrossSection, Manifold

from guiderail_parts.create_task import read_parts
from oracles.parts import PARTS, screw
from oracles.parts import Part as PartDrawing


def load(name, folder):
    """Return plug and socket of the drawing `name`, written to and read from a folder."""
    return tuple(load_part(path, "mm") for path in PARTS[name]().write(folder))


@pytest.mark.parametrize("name", PARTS)
def test_side_clearance_equals_that_of_the_drawing(name, tmp_path):
    assert measure_side_clearance(*load(name, tmp_path)) == pytest.approx(1e-3 * PARTS[name]().clearance, abs=2e-6)


def test_mass_properties_are_those_of_the_solid(tmp_path):
    corner = CrossSection.square((30.0, 10.0)) + CrossSection.square((10.0, 30.0))  # L-shaped outline, 500 mm²
    solid = Manifold.extrude(corner, 20.0)
    PartDrawing([solid], [solid], 0.0).write(tmp_path)
    part = load_part(tmp_path / "plug.stl", "mm")
    np.testing.assert_allclose(compute_center_of_mass(part), [11e-3, 11e-3, 10e-3], atol=1e-9)
    # Variance of x [mm²]: squares of 10 mm at x = 5, 15 and 25 mm with weights 3, 1 and 1; the mean of x is 11 mm.
    variance = (3 * 25 + 225 + 625) / 5 + 100 / 12 - 121
    expected = np.sqrt(2.0 / 3.0 * (2.0 * variance + 400 / 12))
    assert compute_radius_of_gyration(part) == pytest.approx(1e-3 * expected, rel=1e-6)
    two_bodies = Part(part.path, (*part.bodies, *part.transform(np.eye(3), np.array([0.1, 0.0, 0.0])).bodies))
    expected = np.sqrt(expected**2 + 2.0 / 3.0 * 50.0**2)
    assert compute_radius_of_gyration(two_bodies) == pytest.approx(1e-3 * expected, rel=1e-6)


def test_plan_motion_refuses_a_plug_above_the_socket(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    assert plan_motion(plug, socket, 0.0).rim == pytest.approx(15e-3)
    with pytest.raises(InputError, match=r"ends 5\.0 mm above the socket"):
        plan_motion(plug.transform(np.eye(3), np.array([0, 0, 0.02])), socket, 0.0)


@pytest.mark.parametrize(("depth", "is_accepted"), [(0.5, False), (0.51, True)])
def test_plan_motion_refuses_a_depth_within_the_slow_motion(depth, is_accepted, tmp_path):
    plug, socket = load("square_peg", tmp_path)  # the plug enters 15 mm
    raised = plug.transform(np.eye(3), np.array([0.0, 0.0, 0.015 - 1e-3 * depth]))
    with nullcontext() if is_accepted else pytest.raises(InputError, match="must enter more than"):
        motion = plan_motion(raised, socket, 0.0)
        assert np.diff(plan_straight_insertion(motion.travel, motion.rim, 0.0, push=0.0)[0]).min() > 0.0


def test_find_obstructions_finds_snaps_and_accepts_turns(tmp_path):
    plug, socket = load("snap_fit", tmp_path)
    obstructions = find_obstructions(plug, socket, plan_motion(plug, socket, 0.0))
    assert [depth > 2e-6 for depth, _ in obstructions] == [False, True, True]
    plug, socket = load("bayonet", tmp_path)
    turning, straight = (
        find_obstructions(plug, socket, plan_motion(plug, socket, np.deg2rad(turn)))[0] for turn in (40, 0)
    )
    assert turning[0] < 2e-6 < straight[0]


def test_screw_passes_only_with_its_own_pitch_and_direction(tmp_path):
    plug, socket = (load_part(path, "mm") for path in screw(pitch=8.0).write(tmp_path))
    motion = plan_motion(plug, socket, -np.pi, advance=4e-3)
    assert motion.pitch == pytest.approx(8e-3)
    assert motion.path()[-1] == (0.0, 0.0)
    assert (4e-3, -motion.turn) in motion.path()
    assert find_obstructions(plug, socket, motion)[0][0] < 2e-6
    for turn, advance in ((-np.pi, 0.0), (-np.pi, 3e-3), (np.pi, 4e-3)):
        assert find_obstructions(plug, socket, plan_motion(plug, socket, turn, advance=advance))[0][0] > 1e-5
    with pytest.raises(InputError, match="enters only 14 mm"):
        plan_motion(plug, socket, -np.pi, advance=13.6e-3)


def test_make_solids_refuses_faces_that_cross():
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.01
    flat = np.array([[0, 1, 2], [0, 2, 1], [0, 1, 3]])
    with pytest.raises(InputError, match="cross each other"):
        make_solids(Part(Path("x.stl"), ((tetrahedron, flat),)))


def test_overlap_error_suggests_a_shrink_distance(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    check_target(plug, socket)
    shifted = plug.transform(np.eye(3), np.array([1.5e-4, 0.0, 0.0]))  # 0.15 mm with a clearance of 0.1 mm
    with pytest.raises(OverlapError, match=r"overlap at the target by about 0\.05 mm.*--shrink 0\.06") as error:
        check_target(shifted, socket)
    assert error.value.shrink == pytest.approx(6e-5)
    check_target(shrink(shifted, error.value.shrink), socket)


def test_overlap_error_suggests_poses_when_not_assembled(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    with pytest.raises(OverlapError, match="--plug-pose") as error:
        check_target(plug.transform(np.eye(3), np.array([5e-3, 0.0, 0.0])), socket)
    assert error.value.shrink is None


@pytest.mark.parametrize("name", ["square_peg", "keyed_peg"])
def test_shrink_moves_every_face_inwards(name, tmp_path):
    plug, _ = load(name, tmp_path)
    (vertices, triangles), (moved, _) = plug.bodies[0], shrink(plug, 5e-5).bodies[0]
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    large = np.linalg.norm(normals, axis=1) > 1e-8
    normals = normals[large] / np.linalg.norm(normals[large], axis=1, keepdims=True)
    inwards = -np.einsum("tij,tj->ti", (moved - vertices)[triangles][large], normals)
    np.testing.assert_allclose(inwards, 5e-5, rtol=0.05)


@pytest.mark.parametrize(
    ("name", "turn", "symmetries", "rim_symmetries"),
    [
        ("square_peg", 0.0, set(SYMMETRIES), set()),
        ("keyed_peg", 0.0, {"mirrored across x"}, set(SYMMETRIES) - {"mirrored across x"}),
        ("snap_fit", 0.0, {"half turn", "mirrored across x", "mirrored across y"}, None),
        ("dovetail", 0.0, {"mirrored across y"}, set()),
        ("bayonet", 40.0, set(), None),  # a reflection reverses the direction of the turn
    ],
)
def test_find_symmetries_returns_symmetries_of_the_drawing(name, turn, symmetries, rim_symmetries, tmp_path):
    parts = read_parts(*PARTS[name]().write(tmp_path), "mm", (0.0,) * 6, "+z", None)
    exact, approximate = find_symmetries(*parts, plan_motion(*parts, turn * DEGREE))
    assert set(exact) == symmetries
    assert rim_symmetries is None or set(approximate) == rim_symmetries
    assert not set(exact) & set(approximate)


@pytest.mark.parametrize(("height", "symmetries"), [(0.1, set(SYMMETRIES)), (0.6, {"mirrored across x"})])
def test_find_symmetries_ignores_keys_within_the_clearance(height, symmetries, tmp_path):
    def shaft_with_key(grown, low):
        """Return a shaft with a key, grown by a distance [mm], whose lower end is at the height `low` [mm]."""
        shaft = Manifold.cylinder(15.0, 10.0 + grown, circular_segments=96)
        key = Manifold.cube((1.0, 1.2 + 2.0 * grown, 15.0)).translate((9.0 + height + grown, -0.6 - grown, 0.0))
        return (shaft + key).translate((0.0, 0.0, low))

    socket = Manifold.cube((40.0, 40.0, 20.0)).translate((-20.0, -20.0, -20.0)) - shaft_with_key(0.15, -14.9)
    PartDrawing([shaft_with_key(0.0, -14.9)], [socket], 0.15).write(tmp_path)
    parts = read_parts(tmp_path / "plug.stl", tmp_path / "socket.stl", "mm", (0.0,) * 6, "+z", (0.0, 0.0, 0.0))
    exact, approximate = find_symmetries(*parts, plan_motion(*parts, 0.0))
    assert set(exact) == symmetries
    assert set(exact) | set(approximate) == set(SYMMETRIES)
