"""A faulty mesh is repaired and reported, or refused in one sentence with the remedy."""

import json
import os
import re
import struct
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from guiderail.models.common.errors import InputError
from guiderail.models.parts import repair
from guiderail.models.parts.mesh_file import find_units, load_part
from guiderail.models.parts.solids import to_manifold

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


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "glb"])
def test_load_part_returns_meters(ending, tmp_path):
    scale, unit = (1e-3, "m") if ending == "glb" else (1.0, "mm")
    box().apply_scale(scale).export(tmp_path / f"part.{ending}")
    part = load_part(tmp_path / f"part.{ending}", unit)
    np.testing.assert_allclose(np.ptp(part.bounds, axis=0), [0.01, 0.01, 0.02], rtol=1e-6)
    assert len(part.bodies) == 1
    assert str(part.repair) == ""


def test_unit_applies_to_files_whose_format_states_none():
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
    ("spoil", "words", "bodies"),
    [
        (inside_out, "turned 1 body right side out", 1),
        (inside_out_next_to_another, "turned 1 body right side out", 2),
        (hollow, "filled 1 closed cavity", 1),
        (one_flipped, "closed 3 edges; surface moved by at most 0.0000 mm", 1),
    ],
)
def test_load_part_repairs_and_reports(spoil, words, bodies, tmp_path):
    spoil(box()).export(tmp_path / "part.stl")
    part = load_part(tmp_path / "part.stl", "mm")
    assert str(part.repair) == words
    assert len(part.bodies) == bodies
    for vertices, triangles in part.bodies:
        solid = trimesh.Trimesh(vertices, triangles, process=False)
        assert solid.is_watertight
        assert solid.volume == pytest.approx(2e-6)


def test_load_part_keeps_slivers_that_close_a_seam(tmp_path):
    """A T-junction is closed by a triangle without area, which must not be removed."""
    mesh = box()
    a, b, c = mesh.faces[0]
    middle = len(mesh.vertices)
    vertices = np.vstack([mesh.vertices, mesh.vertices[[a, b]].mean(axis=0)])
    faces = np.vstack([mesh.faces[1:], [[a, middle, c], [middle, b, c], [a, b, middle]]])
    trimesh.Trimesh(vertices, faces, process=False).export(tmp_path / "part.obj")
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


def split_edge(mesh):
    """Split an edge of one face only: a T-junction."""
    a, b, c = mesh.faces[0]
    middle = len(mesh.vertices)
    vertices = np.vstack([mesh.vertices, mesh.vertices[[a, b]].mean(axis=0)])
    faces = np.vstack([mesh.faces[1:], [[a, middle, c], [middle, b, c]]])
    return trimesh.Trimesh(vertices, faces, process=False)


def cap_of_a_bore(mesh):
    """Drill a blind bore with a doubled and partly reversed cap."""
    bore = trimesh.creation.cylinder(2.0, 10.0).apply_translation((0.0, 0.0, 9.0))
    drilled = trimesh.boolean.difference([mesh, bore], engine="manifold")
    rim = np.flatnonzero((np.abs(drilled.vertices[:, 2] - 10.0) < 1e-9) & (np.abs(drilled.vertices[:, 0]) < 3.0))
    rim = rim[np.argsort(np.arctan2(*drilled.vertices[rim, 1::-1].T))]
    fan = np.column_stack([np.full(len(rim) - 2, rim[0]), rim[1:-1], rim[2:]])
    faces = np.vstack([drilled.faces, fan, fan[: len(fan) // 2, ::-1], fan])
    return trimesh.Trimesh(drilled.vertices, faces, process=False)


def bore_next_to_its_wall(mesh):
    """Drill a through bore whose wall is drawn 0.05 mm beside the edges of the faces."""
    bore = trimesh.creation.cylinder(2.0, 40.0)
    drilled = trimesh.boolean.difference([mesh, bore], engine="manifold")
    radii = np.linalg.norm(drilled.vertices[drilled.faces][:, :, :2], axis=2).max(axis=1)
    wall = np.flatnonzero(radii < 2.5)
    shifted = trimesh.Trimesh(drilled.vertices, drilled.faces[wall], process=False).apply_translation((0.05, 0.0, 0.0))
    rest = trimesh.Trimesh(drilled.vertices, np.delete(drilled.faces, wall, axis=0), process=False)
    return trimesh.util.concatenate([rest, shifted])


def loose_triangle(mesh):
    vertices = np.vstack([mesh.vertices, mesh.vertices[mesh.faces[0]].mean(axis=0) + (3.0, 3.0, 3.0)])
    faces = np.vstack([mesh.faces, [*mesh.faces[0][:2], len(mesh.vertices)]])
    return trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.parametrize(
    ("spoil", "volume", "words"),
    [
        (split_edge, 2000.0, "closed 3 edges; surface moved by at most 0.0000 mm"),
        (cap_of_a_bore, 2000.0 - 24.0 * np.pi, r"closed 33 edges; .* at most 0.0000 mm; left out .* 1.\d+ mm from it"),
        (bore_next_to_its_wall, 2000.0 - 80.0 * np.pi, r"closed 128 edges; .* at most 0.0[0-4]\d+ mm"),
        (loose_triangle, 2000.0, r"closed 3 edges; surface moved by at most 0.0000 mm; left out .* from it"),
    ],
)
def test_load_part_closes_flat_faces_exactly(spoil, volume, words, tmp_path, monkeypatch):
    monkeypatch.setattr(repair, "_wrap", lambda *arguments: pytest.fail("fTetWild is not needed"))
    spoil(box()).export(tmp_path / "part.obj")
    part = load_part(tmp_path / "part.obj", "mm")
    assert re.fullmatch(words, str(part.repair))
    [body] = part.bodies
    solid = trimesh.Trimesh(*body, process=False)
    assert solid.is_watertight
    assert 1e9 * solid.volume == pytest.approx(volume, rel=0.01)


def test_load_part_refuses_a_hole(tmp_path):
    hole(box()).export(tmp_path / "part.stl")
    with pytest.raises(InputError, match=r"\(3 open edges.*close it"):
        load_part(tmp_path / "part.stl", "mm")


def test_load_part_closes_a_small_hole_and_states_the_distance(tmp_path, monkeypatch):
    def closed(gaps, vertices, triangles):
        return to_manifold(np.asarray(whole.vertices) * 1e-3, np.asarray(whole.faces))

    monkeypatch.setattr(repair, "_wrap", closed)
    for size, is_closed in (((0.15, 0.15, 2.0), True), ((10.0, 10.0, 20.0), False)):
        whole = trimesh.creation.box(size)
        hole(whole.copy()).export(tmp_path / "part.stl")
        if is_closed:
            part = load_part(tmp_path / "part.stl", "mm")
            assert 2e-5 < part.repair.moved < repair.MAX_MOVED
            assert "surface moved by at most 0." in str(part.repair)
            continue
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
    assert len(calls) == 3  # the third moves the surface by a micrometer
    assert solid.volume() == pytest.approx(1e9 * 2e-6, rel=1e-3)


@pytest.mark.parametrize(
    ("spoil", "unit", "message"),
    [
        (lambda mesh: mesh, "m", "would be 20 m long with --unit m: is its unit mm or cm"),
        (lambda mesh: mesh.apply_scale(1e30), "mm", "would be 2e.28 m long"),
        (lambda mesh: mesh.apply_scale(1e-30), "mm", "would be 2e-32 m long|has no triangles"),
        (lambda mesh: trimesh.Trimesh(np.zeros((1, 3)), [[0, 0, 0]], process=False), "mm", "would be 0 m long"),
        (lambda mesh: trimesh.Trimesh([[0, 0, 0], [9, 0, 0]], [[0, 0, 1]], process=False), "mm", "without an area"),
    ],
)
def test_load_part_names_the_remedy_when_a_mesh_is_unusable(spoil, unit, message, tmp_path):
    spoil(box()).export(tmp_path / "part.stl")
    with pytest.raises(InputError, match=message):
        load_part(tmp_path / "part.stl", unit)


def test_load_part_refuses_files_without_a_mesh(tmp_path):
    (tmp_path / "part.stl").write_bytes(b"solid nothing\n")
    (tmp_path / "part.txt").write_text("")
    for name in ("part.stl", "part.txt", "none.stl"):
        with pytest.raises(InputError):
            load_part(tmp_path / name, "mm")


def test_load_part_refuses_an_unknown_unit(tmp_path):
    box().export(tmp_path / "part.stl")
    with pytest.raises(InputError, match="there is no unit 'foot': choose one of mm, cm, m, inch"):
        load_part(tmp_path / "part.stl", "foot")


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


def test_load_part_opens_no_file_that_a_mesh_names(tmp_path):
    """A pipe as a material would block, and a file of another folder must not be read."""
    os.mkfifo(tmp_path / "pipe.mtl")
    box().export(tmp_path / "part.obj")
    for name in ("pipe.mtl", "../secret.mtl", "/dev/zero"):
        text = f"mtllib {name}\n" + (tmp_path / "part.obj").read_text()
        (tmp_path / "named.obj").write_text(text)
        assert len(load_part(tmp_path / "named.obj", "mm").bodies) == 1


def test_load_part_refuses_a_mesh_that_claims_more_than_it_holds(tmp_path, monkeypatch):
    monkeypatch.setattr("guiderail.models.parts.mesh_file._MAX_MEMORY", 2**28)
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
