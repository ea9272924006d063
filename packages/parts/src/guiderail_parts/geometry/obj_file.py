"""OBJ files of triangle meshes."""

from pathlib import Path

import numpy as np

from guiderail.models.common.errors import InputError
from guiderail.models.objects.sdf import TriangleMesh


def read_obj(path: Path) -> TriangleMesh:
    """Read vertices and triangles of an OBJ file with triangular faces, such as one written by `TriangleMesh.to_obj`.

    Raises:
        InputError: If a vertex is not three numbers, there is no face, a face is not three whole numbers, or a
            vertex number of a face is less than 1 or more than the number of vertices. Negative numbers, which
            count from the last vertex, are not supported.
    """
    lines = [line.split() for line in path.read_text(encoding="utf-8").splitlines()]
    vertices = [line[1:4] for line in lines if line[:1] == ["v"]]
    corners = [[corner.split("/")[0] for corner in line[1:]] for line in lines if line[:1] == ["f"]]
    try:
        points, triangles = np.array(vertices, dtype=float), np.array(corners, dtype=int)
    except (ValueError, OverflowError):
        points = triangles = np.empty(0)
    if points.shape[1:] != (3,) or triangles.shape[1:] != (3,):
        raise InputError(f"{path} must hold vertices of three numbers, and triangles only: export it as triangles")
    if ((triangles < 1) | (triangles > len(vertices))).any():
        raise InputError(f"a face of {path} has a vertex outside 1 … {len(vertices)}: number the vertices from 1")
    return TriangleMesh(points, triangles - 1)
