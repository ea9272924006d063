"""Parts that overlap when assembled are diagnosed, and the offered distance makes the plug fit."""

import numpy as np
import pytest

from guiderail.models.parts.assembly_check import OverlapError, check_target, shrink
from guiderail.models.parts.mesh_file import load_part

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")
pytest.importorskip("igl")

from oracles.parts import PARTS


def load(name, folder):
    return tuple(load_part(path, "mm") for path in PARTS[name]().write(folder))


def test_check_target_offers_the_distance_that_removes_an_overlap(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    check_target(plug, socket)
    shifted = plug.transform(np.eye(3), np.array([1.5e-4, 0.0, 0.0]))  # 0.1 mm of clearance
    with pytest.raises(OverlapError, match=r"overlap at the target by about 0\.05 mm.*--shrink 0\.06") as error:
        check_target(shifted, socket)
    assert error.value.shrink == pytest.approx(6e-5)
    check_target(shrink(shifted, error.value.shrink), socket)


def test_check_target_offers_nothing_when_parts_are_not_assembled(tmp_path):
    plug, socket = load("square_peg", tmp_path)
    with pytest.raises(OverlapError, match="--plug-pose") as error:
        check_target(plug.transform(np.eye(3), np.array([5e-3, 0.0, 0.0])), socket)
    assert error.value.shrink is None


@pytest.mark.parametrize("name", ["square_peg", "keyed_peg"])
def test_shrink_moves_every_face_inwards(name, tmp_path):
    plug, _ = load(name, tmp_path)
    smaller = shrink(plug, 5e-5)
    (vertices, triangles), (moved, _) = plug.bodies[0], smaller.bodies[0]
    corners = vertices[triangles]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    large = np.linalg.norm(normals, axis=1) > 1e-8
    normals = normals[large] / np.linalg.norm(normals[large], axis=1, keepdims=True)
    inwards = -np.einsum("tij,tj->ti", (moved - vertices)[triangles][large], normals)
    np.testing.assert_allclose(inwards, 5e-5, rtol=0.05)
