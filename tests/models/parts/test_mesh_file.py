"""A faulty mesh is refused in one sentence with the remedy."""

from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.parts.mesh_file import load_part

trimesh = pytest.importorskip("trimesh")


def box():
    return trimesh.creation.box((10.0, 10.0, 20.0))


def hole(mesh):
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


def inside_out(mesh):
    mesh.invert()
    return mesh


def hollow(mesh):
    cavity = trimesh.creation.box((2.0, 2.0, 4.0))
    cavity.invert()
    return trimesh.util.concatenate([mesh, cavity])


def inside_out_next_to_another(mesh):
    return trimesh.util.concatenate([mesh, inside_out(box()).apply_translation((30.0, 0.0, 0.0))])


def one_flipped(mesh):
    faces = mesh.faces.copy()
    faces[3] = faces[3][::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


@pytest.mark.parametrize("ending", ["stl", "obj"])
def test_load_part_returns_metres(ending, tmp_path):
    box().export(tmp_path / f"part.{ending}")
    part = load_part(tmp_path / f"part.{ending}", "mm")
    np.testing.assert_allclose(np.ptp(part.bounds, axis=0), [0.01, 0.01, 0.02])
    assert len(part.bodies) == 1


@pytest.mark.parametrize(
    ("spoil", "unit", "message"),
    [
        (hole, "mm", r"not watertight \(3 open edges.*close it"),
        (inside_out, "mm", "inside out.*flip its normals"),
        (inside_out_next_to_another, "mm", "inside out.*flip its normals"),
        (hollow, "mm", "has a closed cavity, around .*fill it"),
        (one_flipped, "mm", "face different ways.*recalculate"),
        (lambda mesh: mesh, "m", "would be 20 m long with --unit m: is its unit mm or cm"),
        (lambda mesh: mesh.apply_scale(1e30), "mm", "would be 2e.28 m long"),
        (lambda mesh: mesh.apply_scale(1e-30), "mm", "would be 2e-32 m long|holds no triangles"),
        (lambda mesh: trimesh.Trimesh(np.zeros((1, 3)), [[0, 0, 0]], process=False), "mm", "would be 0 m long"),
        (lambda mesh: trimesh.Trimesh([[0, 0, 0], [9, 0, 0]], [[0, 0, 1]], process=False), "mm", "without an area"),
    ],
)
def test_load_part_names_the_remedy_when_a_mesh_is_faulty(spoil, unit, message, tmp_path):
    spoil(box()).export(tmp_path / "part.stl")
    with pytest.raises(InputError, match=message):
        load_part(tmp_path / "part.stl", unit)


def test_load_part_refuses_files_without_a_mesh(tmp_path):
    (tmp_path / "part.stl").write_bytes(b"solid nothing\n")
    (tmp_path / "part.txt").write_text("")
    for name in ("part.stl", "part.txt", "none.stl"):
        with pytest.raises(InputError):
            load_part(tmp_path / name, "mm")


def test_load_part_refuses_a_name_that_no_file_system_takes():
    with pytest.raises(InputError, match="check the path"):
        load_part(Path("n" * 300 + ".stl"), "mm")


@pytest.mark.parametrize(("limit", "is_accepted"), [(12, True), (11, False)])
def test_number_of_triangles_is_limited(limit, is_accepted, tmp_path, monkeypatch):
    monkeypatch.setattr("guiderail.models.parts.mesh_file.MAX_TRIANGLES", limit)
    box().export(tmp_path / "part.stl")
    with nullcontext() if is_accepted else pytest.raises(InputError, match="12 triangles, more than 11"):
        load_part(tmp_path / "part.stl", "mm")


@pytest.mark.parametrize(("more", "is_accepted"), [(0, True), (-1, False)])
def test_size_of_a_mesh_file_is_limited(more, is_accepted, tmp_path, monkeypatch):
    box().export(file := tmp_path / "part.stl")
    monkeypatch.setattr("guiderail.models.parts.mesh_file.MAX_FILE_SIZE", file.stat().st_size + more)
    with nullcontext() if is_accepted else pytest.raises(InputError, match="is larger than"):
        load_part(file, "mm")
