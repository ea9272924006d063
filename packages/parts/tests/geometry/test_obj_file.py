"""OBJ files: refused faces and vertices."""

import pytest

from guiderail.models.common.errors import InputError
from guiderail_parts.geometry.obj_file import read_obj

TRIANGLES = r"part\.obj must hold vertices of three numbers, and triangles only"
OUTSIDE = r"part\.obj has a vertex outside 1 … 4"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        *((f"f 1//1 2//2 3//3\n{face}", OUTSIDE) for face in ("f -1 -2 -3", "f 0 1 2", "f 1/1 2/2 5/5")),
        *((text, TRIANGLES) for text in ("f 1 2 3 4", "f 1 2 3\nf 1 2 3 4", "f a b c", "", "v 0 0\nf 1 2 3")),
        (f"f 1 2 {2**70}", TRIANGLES),
    ],
)
def test_mesh_is_refused_when_a_face_is_invalid(lines, message, tmp_path):
    path = tmp_path / "part.obj"
    path.write_text(f"v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n{lines}\n")
    with pytest.raises(InputError, match=message):
        read_obj(path)
