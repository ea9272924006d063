"""Meshes and model files of the BNC connector."""

import dataclasses
import re

import numpy as np
import pytest
from pydrake.geometry import (
    AddCompliantHydroelasticProperties,
    Cylinder,
    GeometryInstance,
    ProximityProperties,
    SceneGraph,
)
from pydrake.math import RigidTransform

from guiderail.models.common.transforms import MM
from guiderail.models.objects.bnc_connector import (
    BARREL,
    FOLDER,
    LIP_RISE,
    BncDimensions,
    barrel_sides,
    bore_mesh,
    face_mesh,
    files,
    jack_sdf,
    ring_mesh,
    slot_columns,
    slot_mesh,
)
from guiderail.models.objects.sdf import TriangleMesh
from research.generate import generate

DIMENSIONS = BncDimensions()


def triangle_centers(mesh):
    return mesh.vertices[mesh.triangles].mean(axis=1)


@pytest.mark.parametrize("name", files(DIMENSIONS))
def test_shipped_files_equal_the_generated_ones(name):
    assert (FOLDER / name).read_text() == files(DIMENSIONS)[name]


def test_generate_writes_the_shipped_files(tmp_path):
    generate("connector-objects", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == set(files(DIMENSIONS))
    assert (tmp_path / "bnc_slots.obj").read_bytes() == (FOLDER / "bnc_slots.obj").read_bytes()


def test_files_change_with_the_dimensions():
    wider = dataclasses.replace(DIMENSIONS, slot_clearance=0.2 * MM)
    assert files(wider)["bnc_slots.obj"] != files(DIMENSIONS)["bnc_slots.obj"]
    assert files(wider)["bnc_bore.obj"] == files(DIMENSIONS)["bnc_bore.obj"]


def test_bore_points_at_its_axis_and_the_face_away_from_the_plug():
    mesh, face = bore_mesh(DIMENSIONS), face_mesh(DIMENSIONS)
    outward = triangle_centers(mesh) * [1, 1, 0]
    steep = triangle_centers(mesh)[:, 2] > LIP_RISE
    assert (np.einsum("ij,ij->i", mesh.normals()[steep], outward[steep]) < 0).all()
    np.testing.assert_allclose(face.normals(), [[0, 0, -1]] * len(face.normals()), atol=1e-9)


def test_face_and_lip_meet_at_the_same_corners():
    edges = [mesh.vertices[mesh.vertices[:, 2] == 0.0] for mesh in (bore_mesh(DIMENSIONS), face_mesh(DIMENSIONS))]
    inner = edges[1][np.hypot(*edges[1][:, :2].T) < DIMENSIONS.ring_radius - 0.1 * MM]
    assert {tuple(corner) for corner in edges[0]} == {tuple(corner) for corner in inner}


def test_polygons_have_the_area_of_their_circles():
    bore = bore_mesh(DIMENSIONS)
    corners = bore.vertices[bore.vertices[:, 2] > DIMENSIONS.mouth_chamfer + 1e-9, :2]
    area = 0.5 * len(corners) * np.hypot(*corners.T).max() ** 2 * np.sin(2 * np.pi / len(corners))
    assert area == pytest.approx(np.pi * DIMENSIONS.bore_radius**2, rel=1e-6)

    radius = float(re.findall(r"<radius>([\d.]+)<", jack_sdf(DIMENSIONS))[0])
    sides = len(barrel_polygon(radius))
    assert sides == barrel_sides(DIMENSIONS)
    area = 0.5 * sides * radius**2 * np.sin(2 * np.pi / sides)
    assert area == pytest.approx(np.pi * DIMENSIONS.barrel_radius**2, rel=1e-4)
    assert radius < DIMENSIONS.bore_radius


def barrel_polygon(radius: float) -> np.ndarray:
    """Return the corners (N, 3) of the polygon with which Drake approximates a barrel of the given radius [m]."""
    scene_graph = SceneGraph()
    source, properties = scene_graph.RegisterSource(), ProximityProperties()
    AddCompliantHydroelasticProperties(BARREL.resolution, BARREL.modulus, properties)
    geometry = GeometryInstance(RigidTransform(), Cylinder(radius, DIMENSIONS.barrel_height), "barrel")
    geometry.set_proximity_properties(properties)
    barrel = scene_graph.RegisterAnchoredGeometry(source, geometry)
    mesh = scene_graph.model_inspector().maybe_get_hydroelastic_mesh(barrel)
    corners = np.array([mesh.vertex(i) for i in range(mesh.num_vertices())])
    return corners[(corners[:, 2] > 0) & np.isclose(np.hypot(*corners[:, :2].T), radius)]


def test_slot_is_wider_than_the_lug_along_its_path():
    columns = slot_columns(DIMENSIONS)
    width = columns.upper - columns.lower
    ramp = (columns.angles > 0.2) & (columns.angles < DIMENSIONS.detent_angle)
    assert width[ramp].min() > 2 * (DIMENSIONS.lug_radius + 0.9 * DIMENSIONS.slot_clearance)


def test_slot_walls_face_the_slot():
    mesh = slot_mesh(DIMENSIONS)
    middle = triangle_centers(mesh)
    angle = np.arctan2(middle[:, 1], middle[:, 0])
    on_ramp = (np.abs(np.rad2deg(angle) - 45) < 20) & (middle[:, 2] > 1.5 * MM)
    is_upper = middle[on_ramp, 2] > 4.5 * MM
    assert (np.sign(mesh.normals()[on_ramp, 2]) == np.where(is_upper, -1, 1)).all()
    on_mouth = middle[:, 2] < 1e-9
    np.testing.assert_allclose(mesh.normals()[on_mouth], [[0, 0, -1]] * on_mouth.sum(), atol=1e-9)


def test_meshes_are_symmetric_under_half_a_turn():
    for mesh in (slot_mesh(DIMENSIONS), ring_mesh(DIMENSIONS)):
        points = {tuple(point) for point in np.round(mesh.vertices, 8) + 0.0}
        rotated = {tuple(point) for point in np.round(mesh.vertices * [-1, -1, 1], 8) + 0.0}
        assert points == rotated


def test_from_quads_merges_corners_and_removes_slivers():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], dtype=float)
    sliver = np.array([[1, 0, 0], [2, 0, 0], [1, 1, 0], [1, 1, 0]], dtype=float)
    mesh = TriangleMesh.from_quads(np.stack([square, sliver]))
    assert len(mesh.vertices) == 5
    assert len(mesh.triangles) == 3
    np.testing.assert_allclose(mesh.normals(), [[0, 0, 1]] * 3)
