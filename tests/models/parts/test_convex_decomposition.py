"""Convex pieces are the solid again, and how parts fit is measured to a micrometre."""

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.parts.assembly_check import check_target, in_the_way, motion, side_clearance, solids
from guiderail.models.parts.convex_decomposition import as_arrays, convex_pieces
from guiderail.models.parts.mesh_file import Part, load_part

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")

from manifold3d import Manifold

from oracles.parts import PARTS


def loaded(name, folder):
    return tuple(load_part(path, "mm") for path in PARTS[name]().write(folder))


@pytest.mark.parametrize("name", ["keyed_peg", "bayonet", "snap_fit", "dovetail"])
def test_pieces_are_convex_and_together_the_plug(name, tmp_path):
    plug, _ = loaded(name, tmp_path)
    for solid in solids(plug):
        pieces = convex_pieces(solid)
        assert sum(piece.volume() for piece in pieces) == pytest.approx(solid.volume(), rel=1e-4)
        for piece in pieces:
            assert piece.hull().volume() == pytest.approx(piece.volume(), rel=1e-9)
            assert (piece - solid).volume() < 1e-4 * solid.volume()
            vertices, triangles = as_arrays(piece)
            a, b, c = (vertices[triangles[:, i]] for i in range(3))
            assert np.linalg.norm(np.cross(b - a, c - a), axis=1).min() > 1e-10  # or Drake fails on the face


def test_a_limit_of_pieces_is_kept(tmp_path):
    plug, _ = loaded("bayonet", tmp_path)
    assert convex_pieces(solids(plug)[0], most=3) is None


def test_a_bore_of_many_facets_is_not_filled():
    """Its edges are too flat to count as concave."""
    bore = Manifold.cylinder(22.0, 5.0, 5.0, 720).translate((0.0, 0.0, -1.0))
    assert convex_pieces(Manifold.cube((30.0, 30.0, 20.0)) - bore.translate((15.0, 15.0, 0.0))) is None


@pytest.mark.parametrize("name", PARTS)
def test_the_clearance_is_that_of_the_drawing(name, tmp_path):
    assert side_clearance(*loaded(name, tmp_path)) == pytest.approx(1e-3 * PARTS[name]().clearance, abs=2e-6)


def test_what_overlaps_at_the_target_is_refused(tmp_path):
    plug, socket = loaded("square_peg", tmp_path)
    check_target(plug, socket)
    beside = plug.moved(np.eye(3), np.array([5e-4, 0.0, 0.0]))
    with pytest.raises(InputError, match=r"overlap at the target by about 0\.\d+ mm.*--place"):
        check_target(beside, socket)


def test_a_plug_above_its_socket_goes_into_nothing(tmp_path):
    plug, socket = loaded("square_peg", tmp_path)
    assert motion(plug, socket, 0.0).rim == pytest.approx(15e-3)
    with pytest.raises(InputError, match=r"ends 5\.0 mm above the socket"):
        motion(plug.moved(np.eye(3), np.array([0, 0, 0.02])), socket, 0.0)


def test_what_snaps_is_found_and_what_turns_passes(tmp_path):
    plug, socket = loaded("snap_fit", tmp_path)
    ways = in_the_way(plug, socket, motion(plug, socket, 0.0))
    assert [depth > 2e-6 for depth, _ in ways] == [False, True, True]
    plug, socket = loaded("bayonet", tmp_path)
    turning, straight = (in_the_way(plug, socket, motion(plug, socket, np.deg2rad(turn)))[0] for turn in (40, 0))
    assert turning[0] < 2e-6 < straight[0]


def test_faces_that_cross_are_refused():
    tetrahedron = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) * 0.01
    flat = np.array([[0, 1, 2], [0, 2, 1], [0, 1, 3]])
    with pytest.raises(InputError, match="cross each other"):
        solids(Part(__import__("pathlib").Path("x.stl"), ((tetrahedron, flat),)))
