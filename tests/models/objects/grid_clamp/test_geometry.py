"""Meshes and model files of the grid clamp."""

import dataclasses

import numpy as np
import pytest

from guiderail.models.common.transforms import MM
from guiderail.models.objects.grid_clamp import (
    FOLDER,
    GridClampDimensions,
    bead_mesh,
    files,
    hole_mesh,
    lip_mesh,
    peg_mesh,
    slab_mesh,
)
from research.generate import generate

DIMENSIONS = GridClampDimensions()


def plane_distances(mesh, select):
    """Return the distances [m] of the planes of triangles from the origin, which is on the axis of rotation.

    Args:
        mesh: Mesh with the triangles.
        select: Function that returns the mask of the triangles for the heights of their centers [m].
    """
    corners = mesh.vertices[mesh.triangles]
    selected = select(corners[:, :, 2].mean(axis=1))
    return np.abs(np.einsum("ij,ij->i", mesh.normals()[selected], corners[selected, 0]))


@pytest.mark.parametrize("name", files(DIMENSIONS))
def test_shipped_files_equal_the_generated_ones(name):
    assert (FOLDER / name).read_text() == files(DIMENSIONS)[name]


def test_generate_writes_the_shipped_files(tmp_path):
    generate("clamp-objects", tmp_path)
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (FOLDER / path.name).read_bytes()


def test_files_change_with_the_dimensions():
    wider = files(dataclasses.replace(DIMENSIONS, hole_radius=4.3 * MM))
    assert wider["grid_clamp_hole.obj"] != files(DIMENSIONS)["grid_clamp_hole.obj"]
    assert wider["grid_clamp_peg.obj"] == files(DIMENSIONS)["grid_clamp_peg.obj"]


def test_flat_sides_have_the_clearance_of_the_circles():
    d = DIMENSIONS
    wall = plane_distances(hole_mesh(d), lambda z: z < -d.hole_chamfer)
    shaft = plane_distances(peg_mesh(d), lambda z: (z > d.peg_chamfer) & (z < d.peg_length - 1e-6))
    np.testing.assert_allclose(wall, d.hole_radius, atol=1e-7)
    np.testing.assert_allclose(shaft, d.peg_radius, atol=1e-7)


@pytest.mark.parametrize("mesh", [peg_mesh(DIMENSIONS), bead_mesh(DIMENSIONS)])
def test_compliant_meshes_are_closed_convex_solids(mesh):
    edges = np.sort(np.concatenate([mesh.triangles[:, [0, 1]], mesh.triangles[:, [1, 2]], mesh.triangles[:, [2, 0]]]))
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    heights = np.einsum("tk,vk->tv", mesh.normals(), mesh.vertices)
    planes = np.einsum("tk,tk->t", mesh.normals(), mesh.vertices[mesh.triangles[:, 0]])
    assert (heights <= planes[:, None] + 1e-8).all()


def test_bead_alone_is_wider_than_the_lip():
    """The peg passes its hole and the lip; the bead passes the lip only if it is compressed."""
    d = DIMENSIONS
    assert d.peg_radius < min(d.hole_radius, d.lip_radius)
    assert d.bead_radius > d.lip_radius
    assert d.bead_depth > d.lip_depth + d.lip_land  # below the lip when the peg is inserted
    assert np.hypot(*lip_mesh(d).vertices[:, :2].T).min() >= d.lip_radius


def test_upper_faces_point_up_and_leave_out_the_holes():
    d, slab = DIMENSIONS, slab_mesh(DIMENSIONS)
    for mesh in (hole_mesh(d), slab):
        upper = np.isclose(mesh.vertices[mesh.triangles][:, :, 2], 0.0).all(axis=1)
        np.testing.assert_allclose(mesh.normals()[upper], [[0, 0, 1]] * upper.sum(), atol=1e-9)
    a, b, c = (slab.vertices[slab.triangles[upper, i]] for i in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    mouth = 6 * np.sin(np.pi / 6) * (d.hole_radius + d.hole_chamfer) ** 2
    assert area == pytest.approx(d.table_width**2 - 5 * mouth, rel=1e-6)
