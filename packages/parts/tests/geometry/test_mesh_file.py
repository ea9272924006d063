"""Mesh files: units, repairs and their reports, and errors that name a remedy."""

import json
import os
import re
import struct
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail_parts.geometry import repair
from guiderail_parts.geometry.mesh_file import find_units, load_part
from guiderail_parts.geometry.solids import to_manifold

trimesh = pytest.importorskip("trimesh")


def box():
    return trimesh.creation.box((10.0, 10.0, 20.0))


def remove_triangle(mesh):
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


def invert(mesh):
    mesh.invert()
    return mesh


def add_cavity(mesh):
    return trimesh.util.concatenate([mesh, invert(trimesh.creation.box((2.0, 2.0, 4.0)))])


def add_inverted_body(mesh):
    return trimesh.util.concatenate([mesh, invert(box()).apply_translation((30.0, 0.0, 0.0))])


def flip_triangle(mesh):
    faces = mesh.faces.copy()
    faces[3] = faces[3][::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def split_edge(mesh, has_sliver=False):
    """Split an edge in one triangle only, which is a T-junction; a triangle without area can close its gap."""
    a, b, c = mesh.faces[0]
    middle = len(mesh.vertices)
    vertices = np.vstack([mesh.vertices, mesh.vertices[[a, b]].mean(axis=0)])
    faces = np.vstack([mesh.faces[1:], [[a, middle, c], [middle, b, c], *[[a, b, middle]] * has_sliver]])
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "glb"])
def test_load_part_returns_meters(ending, tmp_path):
    scale, unit = (1e-3, "m") if ending == "glb" else (1.0, "mm")
    box().apply_scale(scale).export(tmp_path / f"part.{ending}")
    part = load_part(tmp_path / f"part.{ending}", unit)
    np.testing.assert_allclose(np.ptp(part.bounds, axis=0), [0.01, 0.01, 0.02], rtol=1e-6)
    assert len(part.bodies) == 1
    assert str(part.repair) == ""


def test_find_units_uses_the_unit_of_the_file_format():
    assert find_units([Path("plug.glb"), Path("socket.stl")], "mm") == ["m", "mm"]
    assert find_units([Path("plug.glb"), Path("socket.step")], None) == ["m", "m"]
    with pytest.raises(InputError, match=r"plug\.glb and socket\.step are read in meters, .*: remove --unit mm"):
        find_units([Path("plug.glb"), Path("socket.step")], "mm")
    with pytest.raises(InputError, match="there is no unit 'ell'"):
        find_units([Path("plug.stl")], "ell")


def test_load_part_reads_step():
    part = load_part(Path(__file__).with_name("box.step"), "m")
    np.testing.assert_allclose(np.ptp(part.bounds, axis=0), [0.01, 0.01, 0.02], rtol=1e-6)


@pytest.mark.parametrize(
    ("change", "report", "bodies"),
    [
        (invert, "turned 1 body right side out", 1),
        (add_inverted_body, "turned 1 body right side out", 2),
        (add_cavity, "filled 1 closed cavity", 1),
        (flip_triangle, "closed 3 edges; surface moved by at most 0.0000 mm", 1),
    ],
)
def test_load_part_repairs_a_mesh_and_reports_the_repair(change, report, bodies, tmp_path):
    change(box()).export(tmp_path / "part.stl")
    part = load_part(tmp_path / "part.stl", "mm")
    assert str(part.repair) == report
    assert len(part.bodies) == bodies
    for vertices, triangles in part.bodies:
        solid = trimesh.Trimesh(vertices, triangles, process=False)
        assert solid.is_watertight
        assert solid.volume == pytest.approx(2e-6)


def test_load_part_accepts_slivers_that_close_a_t_junction(tmp_path):
    split_edge(box(), has_sliver=True).export(tmp_path / "part.obj")
    part = load_part(tmp_path / "part.obj", "mm")
    assert part.repair.closed_edges == 0
    assert trimesh.Trimesh(*part.bodies[0], process=False).volume == pytest.approx(2e-6)


@pytest.mark.parametrize("index", [-3, 3, 2**31 - 1])
def test_load_part_refuses_triangles_of_missing_vertices(index, tmp_path):
    header = (
        "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    )
    (tmp_path / "part.ply").write_text(header + f"0 0 0\n10 0 0\n0 10 0\n3 0 1 {index}\n")
    with pytest.raises(InputError, match="vertices that do not exist"):
        load_part(tmp_path / "part.ply", "mm")


def add_doubled_cap(mesh):
    """Drill a blind bore, and close it with a cap of doubled and partly reversed triangles."""
    bore = trimesh.creation.cylinder(2.0, 10.0).apply_translation((0.0, 0.0, 9.0))
    drilled = trimesh.boolean.difference([mesh, bore], engine="manifold")
    rim = np.flatnonzero((np.abs(drilled.vertices[:, 2] - 10.0) < 1e-9) & (np.abs(drilled.vertices[:, 0]) < 3.0))
    rim = rim[np.argsort(np.arctan2(*drilled.vertices[rim, 1::-1].T))]
    fan = np.column_stack([np.full(len(rim) - 2, rim[0]), rim[1:-1], rim[2:]])
    faces = np.vstack([drilled.faces, fan, fan[: len(fan) // 2, ::-1], fan])
    return trimesh.Trimesh(drilled.vertices, faces, process=False)


def shift_wall_of_a_bore(mesh):
    """Drill a through bore whose wall is shifted by 0.05 mm relative to the edges of the faces."""
    bore = trimesh.creation.cylinder(2.0, 40.0)
    drilled = trimesh.boolean.difference([mesh, bore], engine="manifold")
    radii = np.linalg.norm(drilled.vertices[drilled.faces][:, :, :2], axis=2).max(axis=1)
    wall = np.flatnonzero(radii < 2.5)
    shifted = trimesh.Trimesh(drilled.vertices, drilled.faces[wall], process=False).apply_translation((0.05, 0.0, 0.0))
    rest = trimesh.Trimesh(drilled.vertices, np.delete(drilled.faces, wall, axis=0), process=False)
    return trimesh.util.concatenate([rest, shifted])


def add_loose_triangle(mesh):
    vertices = np.vstack([mesh.vertices, mesh.vertices[mesh.faces[0]].mean(axis=0) + (3.0, 3.0, 3.0)])
    faces = np.vstack([mesh.faces, [*mesh.faces[0][:2], len(mesh.vertices)]])
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize(
    ("change", "volume", "report"),
    [
        (split_edge, 2000.0, "closed 3 edges; surface moved by at most 0.0000 mm"),
        (
            add_doubled_cap,
            2000.0 - 24.0 * np.pi,
            r"closed 33 edges; .* at most 0.0000 mm; left out .* 1.\d+ mm from it",
        ),
        (shift_wall_of_a_bore, 2000.0 - 80.0 * np.pi, r"closed 128 edges; .* at most 0.0[0-4]\d+ mm"),
        (add_loose_triangle, 2000.0, r"closed 3 edges; surface moved by at most 0.0000 mm; left out .* from it"),
    ],
)
def test_load_part_closes_flat_faces_exactly(change, volume, report, tmp_path, monkeypatch):
    monkeypatch.setattr(repair, "_wrap", lambda *arguments: pytest.fail("fTetWild is not needed"))
    change(box()).export(tmp_path / "part.obj")
    part = load_part(tmp_path / "part.obj", "mm")
    assert re.fullmatch(report, str(part.repair))
    [body] = part.bodies
    solid = trimesh.Trimesh(*body, process=False)
    assert solid.is_watertight
    assert 1e9 * solid.volume == pytest.approx(volume, rel=0.01)


def test_load_part_closes_only_small_holes_by_moving_the_surface(tmp_path, monkeypatch):
    def wrap(gaps, vertices, triangles):
        return to_manifold(np.asarray(closed.vertices) * 1e-3, np.asarray(closed.faces))

    monkeypatch.setattr(repair, "_wrap", wrap)
    closed = trimesh.creation.box((0.15, 0.15, 2.0))
    remove_triangle(closed.copy()).export(tmp_path / "part.stl")
    part = load_part(tmp_path / "part.stl", "mm")
    assert 2e-5 < part.repair.moved < repair.MAX_MOVED
    assert "surface moved by at most 0." in str(part.repair)
    closed = box()
    remove_triangle(box()).export(tmp_path / "part.stl")
    with pytest.raises(
        InputError, match=r"has a hole around .* \(3 open edges\), which a repair would close by moving"
    ):
        load_part(tmp_path / "part.stl", "mm")


def test_load_part_uses_the_best_of_several_repairs(tmp_path, monkeypatch):
    results = [box().apply_scale(factor * 1e-3) for factor in (1.05, 1.03, 1.0001, 1.0)]
    monkeypatch.setattr(repair, "find_spec", lambda name: True)
    monkeypatch.setattr(repair, "boundary_of", lambda points, cells: (points, cells))
    calls = []

    def run_isolated(*arguments, **limits):
        calls.append(arguments)
        result = results[len(calls) - 1]
        return np.asarray(result.vertices), np.asarray(result.faces)

    monkeypatch.setattr(repair, "run_isolated", run_isolated)
    mesh = box()
    gaps = "part.stl is not watertight"
    solid = repair._wrap(gaps, np.asarray(mesh.vertices) * 1e-3, np.asarray(mesh.faces))
    assert len(calls) == 3  # the third result moves the surface by a micrometer only
    assert solid.volume() == pytest.approx(1e9 * 2e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("change", "unit", "message"),
    [
        (lambda mesh: mesh, "m", "would be 20 m long with --unit m: is its unit mm or cm"),
        (lambda mesh: mesh.apply_scale(1e30), "mm", "would be 2e.28 m long"),
        (lambda mesh: mesh.apply_scale(1e-30), "mm", "would be 2e-32 m long|has no triangles"),
        (lambda mesh: trimesh.Trimesh(np.zeros((1, 3)), [[0, 0, 0]], process=False), "mm", "would be 0 m long"),
        (lambda mesh: trimesh.Trimesh([[0, 0, 0], [9, 0, 0]], [[0, 0, 1]], process=False), "mm", "without an area"),
        (remove_triangle, "mm", r"\(3 open edges.*close it"),
        (lambda mesh: mesh, "foot", "there is no unit 'foot': choose one of mm, cm, m, inch"),
    ],
)
def test_load_part_names_the_remedy_when_a_mesh_is_unusable(change, unit, message, tmp_path):
    change(box()).export(tmp_path / "part.stl")
    with pytest.raises(InputError, match=message):
        load_part(tmp_path / "part.stl", unit)


def test_load_part_refuses_files_without_a_mesh(tmp_path):
    (tmp_path / "part.stl").write_bytes(b"solid nothing\n")
    (tmp_path / "part.txt").write_text("")
    for name in ("part.stl", "part.txt", "none.stl"):
        with pytest.raises(InputError):
            load_part(tmp_path / name, "mm")


def test_load_part_refuses_a_name_longer_than_file_systems_allow():
    with pytest.raises(InputError, match="check the path"):
        load_part(Path("n" * 300 + ".stl"), "mm")


@pytest.mark.parametrize(("limit", "is_accepted"), [(12, True), (11, False)])
def test_load_part_limits_the_number_of_triangles(limit, is_accepted, tmp_path, monkeypatch):
    monkeypatch.setattr("guiderail_parts.geometry.mesh_file.MAX_TRIANGLES", limit)
    box().export(tmp_path / "part.stl")
    with nullcontext() if is_accepted else pytest.raises(InputError, match="12 triangles, more than 11"):
        load_part(tmp_path / "part.stl", "mm")


@pytest.mark.parametrize(("margin", "is_accepted"), [(0, True), (-1, False)])
def test_load_part_limits_the_size_of_a_file(margin, is_accepted, tmp_path, monkeypatch):
    box().export(file := tmp_path / "part.stl")
    monkeypatch.setattr("guiderail_parts.geometry.mesh_file.MAX_FILE_SIZE", file.stat().st_size + margin)
    with nullcontext() if is_accepted else pytest.raises(InputError, match="is larger than"):
        load_part(file, "mm")


def test_load_part_opens_no_file_named_in_a_mesh(tmp_path):
    """Reading a pipe as a material file would block, and files of other folders must not be read."""
    os.mkfifo(tmp_path / "pipe.mtl")
    box().export(tmp_path / "part.obj")
    for name in ("pipe.mtl", "../secret.mtl", "/dev/zero"):
        text = f"mtllib {name}\n" + (tmp_path / "part.obj").read_text()
        (tmp_path / "named.obj").write_text(text)
        assert len(load_part(tmp_path / "named.obj", "mm").bodies) == 1


def test_load_part_refuses_a_mesh_that_states_too_many_vertices(tmp_path, monkeypatch):
    monkeypatch.setattr("guiderail_parts.geometry.mesh_file._MAX_MEMORY", 2**28)
    header = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": 4}],
        "bufferViews": [],
        "accessors": [{"componentType": 5126, "count": 30_000_000, "type": "VEC3"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
    }
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    content = b"glTF" + struct.pack("<III", 2, 32 + len(text), len(text)) + b"JSON" + text
    (tmp_path / "part.glb").write_bytes(content + struct.pack("<I", 4) + b"BIN\0" + bytes(4))
    with pytest.raises(InputError, match="too much memory"):
        load_part(tmp_path / "part.glb", "m")
