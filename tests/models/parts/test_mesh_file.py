"""What is wrong with a mesh is one sentence with the remedy."""

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


def inside_out_beside(mesh):
    return trimesh.util.concatenate([mesh, inside_out(box()).apply_translation((30.0, 0.0, 0.0))])


def one_flipped(mesh):
    faces = mesh.faces.copy()
    faces[3] = faces[3][::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


@pytest.mark.parametrize("ending", ["stl", "obj"])
def test_a_sound_part_comes_in_metres(ending, tmp_path):
    box().export(tmp_path / f"part.{ending}")
    part = load_part(tmp_path / f"part.{ending}", "mm")
    np.testing.assert_allclose(np.ptp(part.bounds, axis=0), [0.01, 0.01, 0.02])
    assert len(part.bodies) == 1


@pytest.mark.parametrize(
    ("spoil", "unit", "says"),
    [
        (hole, "mm", r"not watertight \(3 open edges.*close it"),
        (inside_out, "mm", "inside out.*flip its normals"),
        (inside_out_beside, "mm", "inside out.*flip its normals"),
        (hollow, "mm", "has a closed cavity, around .*fill it"),
        (one_flipped, "mm", "face different ways.*recalculate"),
        (lambda mesh: mesh, "m", "would be 20 m long with --unit m: is its unit mm or cm"),
    ],
)
def test_a_fault_has_a_remedy(spoil, unit, says, tmp_path):
    spoil(box()).export(tmp_path / "part.stl")
    with pytest.raises(InputError, match=says):
        load_part(tmp_path / "part.stl", unit)


def test_a_file_that_is_no_mesh_is_refused(tmp_path):
    (tmp_path / "part.stl").write_bytes(b"solid nothing\n")
    (tmp_path / "part.txt").write_text("")
    for name in ("part.stl", "part.txt", "none.stl"):
        with pytest.raises(InputError):
            load_part(tmp_path / name, "mm")
