"""Decomposition of solids into convex pieces, whose union is the solid."""

import numpy as np
import pytest

from guiderail_parts.geometry.assembly_check import make_solids
from guiderail_parts.geometry.convex_decomposition import cut_into_convex_pieces, cut_into_sectors
from guiderail_parts.geometry.mesh_file import load_part
from guiderail_parts.geometry.solids import SurfaceLocator, to_arrays

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")

from manifold3d import Manifold, OpType

from oracles.parts import PARTS, screw


def load_plug(name, folder):
    plug, _ = (load_part(path, "mm") for path in PARTS[name]().write(folder))
    return plug


@pytest.mark.parametrize("name", ["keyed_peg", "bayonet", "snap_fit", "dovetail"])
def test_cut_returns_convex_pieces_of_the_plug(name, tmp_path):
    for solid in make_solids(load_plug(name, tmp_path)):
        pieces = cut_into_convex_pieces(solid)
        assert sum(piece.volume() for piece in pieces) == pytest.approx(solid.volume(), rel=1e-4)
        for piece in pieces:
            assert piece.hull().volume() == pytest.approx(piece.volume(), rel=1e-9)
            assert (piece - solid).volume() < 1e-4 * solid.volume()
            vertices, triangles = to_arrays(piece)
            a, b, c = (vertices[triangles[:, i]] for i in range(3))
            areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
            assert areas.min() > 0.5e-10  # [m²]; Drake fails on smaller faces


def test_cut_returns_none_when_pieces_exceed_the_limit(tmp_path):
    assert cut_into_convex_pieces(make_solids(load_plug("bayonet", tmp_path))[0], max_pieces=3) is None


def test_sectors_of_a_screw_are_convex_and_near_the_surface(tmp_path):
    plug, _ = (load_part(path, "mm") for path in screw().write(tmp_path))
    [solid] = make_solids(plug)
    pieces = cut_into_sectors(solid, 48)
    assert max(piece.hull().volume() - piece.volume() for piece in pieces) < 1e-9 * solid.volume()
    union = Manifold.batch_boolean(pieces, OpType.Add)
    assert (solid - union).volume() < 1e-4 * solid.volume()
    added = to_arrays(union - solid)[0]
    distances = SurfaceLocator(*to_arrays(solid)).find_nearest(added)[1]
    assert distances.max() < 0.06e-3  # [m]; the largest distance is at the shaft
    assert cut_into_sectors(solid, 48, max_pieces=40) is None


def test_cut_returns_none_when_pieces_would_fill_a_bore():
    """The edges between the 720 facets of the bore are too flat to count as concave."""
    bore = Manifold.cylinder(22.0, 5.0, 5.0, 720).translate((0.0, 0.0, -1.0))
    assert cut_into_convex_pieces(Manifold.cube((30.0, 30.0, 20.0)) - bore.translate((15.0, 15.0, 0.0))) is None


def test_fine_pieces_of_a_bore_deviate_by_at_most_the_depth():
    bore = Manifold.cylinder(22.0, 5.0, 5.0, 720).translate((15.0, 15.0, -1.0))
    solid = Manifold.cube((30.0, 30.0, 20.0)) - bore
    pieces = cut_into_convex_pieces(solid, max_pieces=200, depth=0.02)
    union = Manifold.batch_boolean(pieces, OpType.Add)
    assert union.volume() == pytest.approx(solid.volume(), rel=1e-3)
    filled = to_arrays(union - solid)[0]
    assert 1e3 * SurfaceLocator(*to_arrays(solid)).find_nearest(filled)[1].max() < 0.02
    # All vertices of a thin plate are near its hull, but not its hole.
    plate = Manifold.cube((30.0, 30.0, 0.01)) - Manifold.cube((20.0, 20.0, 1.0)).translate((10.0, 10.0, 0.0))
    assert len(cut_into_convex_pieces(plate, depth=0.02)) > 1
