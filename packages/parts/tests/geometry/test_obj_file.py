"""OBJ files: refused faces and vertices."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail_parts.geometry.obj_file import read_obj


@pytest.mark.parametrize("face", ["f -1 -2 -3", "f 0 1 2", "f 1/1 2/2 4/4"])
def test_mesh_is_refused_when_a_face_has_an_unknown_vertex(face, tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1//1 2//1 3//1\n{face}\n")
    with pytest.raises(InputError, match=r"part\.obj has a vertex outside 1 … 3"):
        read_obj(path)


@pytest.mark.parametrize(
    "lines", ["f 1 2 3 4", "f 1 2 3\nf 1 2 3 4", "f a b c", f"f 1 2 {2**70}", "", "v 0 0\nf 1 2 3"]
)
def test_mesh_is_refused_unless_all_faces_are_triangles(lines, tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n{lines}\n")
    with pytest.raises(InputError, match=r"part\.obj must hold vertices of three numbers, and triangles only"):
        read_obj(path)
