"""Contact geometry: measured deviations, regions without contact that are cropped, and pieces that Drake refuses."""

import numpy as np
import pytest

from guiderail_parts.geometry.assembly_check import make_solids, measure_side_clearance, plan_motion
from guiderail_parts.geometry.drake_check import Piece, accepted_pieces
from guiderail_parts.geometry.mesh_file import load_part
from guiderail_parts.geometry.preparation import (
    ContactSurface,
    choose_tolerance,
    crop_to_contact,
    cut_bodies,
    decimate,
    make_compliant,
    prepare_surfaces,
    simplify,
)
from guiderail_parts.geometry.solids import SurfaceLocator, measure_deviation, to_arrays, to_manifold
from guiderail_parts.isolation import IsolatedError

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")
pytest.importorskip("igl")

import manifold3d
import trimesh

from oracles.parts import PARTS


def test_surface_locator_agrees_with_brute_force():
    mesh = trimesh.creation.torus(2.0, 0.5)
    points = np.random.default_rng(0).normal(size=(50, 3))
    nearest, distances, faces = SurfaceLocator(mesh.vertices, mesh.faces).find_nearest(points)
    for point, near, distance, face in zip(points, nearest, distances, faces, strict=True):
        candidates = trimesh.triangles.closest_point(mesh.triangles, np.tile(point, (len(mesh.faces), 1)))
        assert distance == pytest.approx(np.linalg.norm(candidates - point, axis=1).min(), rel=1e-9)
        np.testing.assert_allclose(near, candidates[face], atol=1e-9)


@pytest.mark.parametrize("tolerance", [0.05, 0.01, 0.001])
def test_simplify_deviates_by_no_more_than_the_tolerance(tolerance):
    solid = manifold3d.Manifold.cylinder(20.0, 4.0, 4.0, 720)
    simpler, deviation = simplify(solid, tolerance)
    assert deviation <= tolerance
    assert 1e3 * measure_deviation(to_arrays(solid), to_arrays(simpler), 10000) <= 1.2 * tolerance
    if tolerance > 0.005:
        assert simpler.num_tri() < 0.3 * solid.num_tri()


def test_crop_removes_only_regions_that_cannot_touch():
    plate = manifold3d.Manifold.cube((200.0, 200.0, 20.0), True).translate((0, 0, -10.0))
    socket = plate - manifold3d.Manifold.cylinder(20.0, 5.0, 5.0, 32).translate((0, 0, -15.0))
    plug = manifold3d.Manifold.cylinder(300.0, 4.9, 4.9, 32).translate((0, 0, -15.0))
    cropped_socket = crop_to_contact(socket, plug, 4.0, 0.0, is_plug=False)
    cropped_plug = crop_to_contact(plug, socket, 4.0, 0.0, is_plug=True)
    near = manifold3d.Manifold.cylinder(30.0, 8.5, 8.5, 64).translate((0, 0, -18.5))
    assert ((socket ^ near) - cropped_socket).volume() < 1e-6 * socket.volume()
    assert cropped_socket.volume() < 0.05 * socket.volume()
    assert cropped_plug.bounding_box()[5] < 40.0  # [mm]; the plug is 300 mm long and cropped in whole slabs


@pytest.mark.parametrize("name", ["keyed_peg", "snap_fit"])
def test_prepared_surfaces_report_their_deviation(name, tmp_path):
    parts = [load_part(path, "mm") for path in PARTS[name]().write(tmp_path)]
    motion, tolerance = plan_motion(*parts, 0.0), choose_tolerance(measure_side_clearance(*parts))
    decimated = [decimate(part, tolerance) for part in parts]
    snapping = frozenset({1, 2}) if name == "snap_fit" else frozenset()
    surfaces = prepare_surfaces(
        decimated[0][0], decimated[1][0], motion, tolerance, max(d for _, d in decimated), snapping
    )
    assert max(surface.deviation for surface in surfaces) <= tolerance * (1.0 + 1e-9)
    assert surfaces[0].snapping == len(snapping)
    for part, surface in zip(parts, surfaces, strict=True):
        assert surface.volume == pytest.approx(1e-9 * sum(solid.volume() for solid in make_solids(part)), rel=1e-3)
    for _, pieces, _ in make_compliant("convex", {"plug": surfaces[0]}, tolerance, lambda line: None):
        assert {piece.body for piece in pieces} == set(range(len(surfaces[0].bodies)))


def test_accepted_pieces_leaves_out_or_refuses_invalid_pieces():
    cube, triangles = to_arrays(manifold3d.Manifold.cube((10.0, 10.0, 10.0)))
    good, flat = Piece(0, ".obj", cube, triangles), Piece(0, ".obj", cube * [1.0, 1.0, 1e-9], triangles)
    assert accepted_pieces([good]) == [good]
    accepted = accepted_pieces([good, flat])
    assert accepted is not None
    assert accepted[0] is good
    assert accepted_pieces([Piece(0, ".vtk", cube, np.array([[0, 1, 2, 2]]))]) is None


def test_accepted_pieces_returns_none_when_the_check_fails(monkeypatch):
    def fail(*_, **__):
        raise IsolatedError("it was killed")

    monkeypatch.setattr("guiderail_parts.geometry.drake_check.run_isolated", fail)
    assert accepted_pieces([]) == []
    cube, _ = to_arrays(manifold3d.Manifold.cube((10.0, 10.0, 10.0)))
    assert accepted_pieces([Piece(0, ".vtk", cube, np.array([[0, 1, 2, 4]]))] * 3) is None


def test_cut_bodies_reports_the_deviation_of_added_material():
    ring = manifold3d.CrossSection.circle(1.0, 16).translate((4.0, 0.0)).revolve(24)
    surface, tolerance = ContactSurface((to_arrays(ring),), 0, to_arrays(ring), 0.0, 1.0), 1e-4
    result = cut_bodies(surface, tolerance, "fine")
    assert result is not None
    pieces, deviation = result
    filled = manifold3d.Manifold.batch_boolean(
        [to_manifold(piece.points, piece.cells) for piece in pieces], manifold3d.OpType.Add
    )
    assert filled.volume() > ring.volume()
    assert 0.0 < deviation <= 2.0 * tolerance
    box = manifold3d.Manifold.cube((1.0, 2.0, 3.0))
    assert cut_bodies(ContactSurface((to_arrays(box),), 0, to_arrays(box), 0.0, 1.0), tolerance)[1] == 0.0
