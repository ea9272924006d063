"""Parts are checked for overlap, clearance between walls and a free path to the target."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import DEGREE
from guiderail.models.parts.assembly_check import (
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
from guiderail.models.parts.demonstrator import plan_straight_insertion
from guiderail.models.parts.mesh_file import Part, load_part

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")
pytest.importorskip("igl")

from manifold3d import CrossSection, Manifold

from guiderail.tools.parts.create_task import read_parts
from oracles.parts import PARTS, screw
from oracles.parts import Part as PartDrawing


def load(name, folder):
    return tuple(load_part(path, "mm") for path in PARTS[name]().write(folder))


@pytest.mark.parametrize("name", PARTS)
def test_side_clearance_equals_that_of_the_drawing(name, tmp_path):
    assert measure_side_clearance(*load(name, tmp_path)) == pytest.approx(1e-3 * PARTS[name]().clearance, abs=2e-6)


def test_mass_properties_are_those_of_the_solid(tmp_path):
    corner = CrossSection.square((30.0, 10.0)) + CrossSection.square((10.0, 30.0))  # L-shaped, 500 mm²
    solid = Manifold.extrude(corner, 20.0)
    PartDrawing([solid], [solid], 0.0).write(tmp_path)
    part = load_part(tmp_path / "plug.stl", "mm")
    np.testing.assert_allclose(compute_center_of_mass(part), [11e-3, 11e-3, 10e-3], atol=1e-9)
    # About the origin, the mean of x² is that of three squares of 10 mm, centered at 5, 15 and 25 mm: weights 3, 1, 1.
    mean_square = (3 * 25 + 225 + 625) / 5 + 100 / 12 - 121
    expected = np.sqrt(2.0 / 3.0 * (2.0 * mean_square + 400 / 12))
    assert compute_radius_of_gyration(part) == pytest.approx(1e-3 * expected, rel=1e-6)
    twice = Part(part.path, (*part.bodies, *part.transform(np.eye(3), np.array([0.1, 0.0, 0.0])).bodies))
    apart = np.sqrt(expected**2 + 2.0 / 3.0 * 50.0**2)
    assert compute_radius_of_gyration(twice) == pytest.approx(1e-3 * apart, rel=1e-6)


def test_plan_motion_refuses_a_plug_above_its_socket(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    assert plan_motion(plug, socket, 0.0).rim == pytest.approx(15e-3)
    with pytest.raises(InputError, match=r"ends 5\.0 mm above the socket"):
        plan_motion(plug.transform(np.eye(3), np.array([0, 0, 0.02])), socket, 0.0)


@pytest.mark.parametrize(("depth", "is_accepted"), [(0.5, False), (0.51, True)])
def test_plug_enters_more_than_the_slow_motion_at_the_rim(depth, is_accepted, tmp_path):
    plug, socket = load("square_peg", tmp_path)  # it enters 15 mm
    raised = plug.transform(np.eye(3), np.array([0.0, 0.0, 0.015 - 1e-3 * depth]))
    with nullcontext() if is_accepted else pytest.raises(InputError, match="must enter more than"):
        motion = plan_motion(raised, socket, 0.0)
        assert np.diff(plan_straight_insertion(motion.travel, motion.rim, 0.0, push=0.0)[0]).min() > 0.0


def test_find_obstructions_finds_snaps_and_passes_turns(tmp_path):
    plug, socket = load("snap_fit", tmp_path)
    obstructions = find_obstructions(plug, socket, plan_motion(plug, socket, 0.0))
    assert [depth > 2e-6 for depth, _ in obstructions] == [False, True, True]
    plug, socket = load("bayonet", tmp_path)
    turning, straight = (
        find_obstructions(plug, socket, plan_motion(plug, socket, np.deg2rad(turn)))[0] for turn in (40, 0)
    )
    assert turning[0] < 2e-6 < straight[0]


def test_a_screw_passes_only_with_its_own_pitch_and_hand(tmp_path):
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


def test_check_target_offers_the_distance_that_removes_an_overlap(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    check_target(plug, socket)
    shifted = plug.transform(np.eye(3), np.array([1.5e-4, 0.0, 0.0]))  # 0.1 mm of clearance
    with pytest.raises(OverlapError, match=r"overlap at the target by about 0\.05 mm.*--shrink 0\.06") as error:
        check_target(shifted, socket)
    assert error.value.shrink == pytest.approx(6e-5)
    check_target(shrink(shifted, error.value.shrink), socket)


def test_check_target_offers_nothing_when_parts_are_not_assembled(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    with pytest.raises(OverlapError, match="--plug-pose") as error:
        check_target(plug.transform(np.eye(3), np.array([5e-3, 0.0, 0.0])), socket)
    assert error.value.shrink is None


@pytest.mark.parametrize("name", ["square_peg", "keyed_peg"])
def test_shrink_moves_every_face_inwards(name, tmp_path):
    plug, _ = load(name, tmp_path)
    smaller = shrink(plug, 5e-5)
    (vertices, triangles), (moved, _) = plug.bodies[0], smaller.bodies[0]
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    large = np.linalg.norm(normals, axis=1) > 1e-8
    normals = normals[large] / np.linalg.norm(normals[large], axis=1, keepdims=True)
    inwards = -np.einsum("tij,tj->ti", (moved - vertices)[triangles][large], normals)
    np.testing.assert_allclose(inwards, 5e-5, rtol=0.05)


@pytest.mark.parametrize(
    ("name", "turn", "same", "on_the_rim"),
    [
        ("square_peg", 0.0, set(SYMMETRIES), set()),
        ("keyed_peg", 0.0, {"mirrored across x"}, set(SYMMETRIES) - {"mirrored across x"}),
        ("snap_fit", 0.0, {"half turn", "mirrored across x", "mirrored across y"}, None),
        ("dovetail", 0.0, {"mirrored across y"}, set()),
        ("bayonet", 40.0, set(), None),  # a turn in one direction is not its own mirror image
    ],
)
def test_find_symmetries_returns_those_of_the_drawing(name, turn, same, on_the_rim, tmp_path):
    parts = read_parts(*PARTS[name]().write(tmp_path), "mm", (0.0,) * 6, "+z", None)
    exact, approximate = find_symmetries(*parts, plan_motion(*parts, turn * DEGREE))
    assert set(exact) == same
    assert on_the_rim is None or set(approximate) == on_the_rim
    assert not set(exact) & set(approximate)


@pytest.mark.parametrize(("height", "same"), [(0.1, set(SYMMETRIES)), (0.6, {"mirrored across x"})])
def test_key_higher_than_the_clearance_is_no_symmetry(height, same, tmp_path):
    def solid(grown, low):
        shaft = Manifold.cylinder(15.0, 10.0 + grown, circular_segments=96)
        key = Manifold.cube((1.0, 1.2 + 2.0 * grown, 15.0)).translate((9.0 + height + grown, -0.6 - grown, 0.0))
        return (shaft + key).translate((0.0, 0.0, low))

    socket = Manifold.cube((40.0, 40.0, 20.0)).translate((-20.0, -20.0, -20.0)) - solid(0.15, -14.9)
    PartDrawing([solid(0.0, -14.9)], [socket], 0.15).write(tmp_path)
    parts = read_parts(tmp_path / "plug.stl", tmp_path / "socket.stl", "mm", (0.0,) * 6, "+z", (0.0, 0.0, 0.0))
    exact, approximate = find_symmetries(*parts, plan_motion(*parts, 0.0))
    assert set(exact) == same
    assert set(exact) | set(approximate) == set(SYMMETRIES)
