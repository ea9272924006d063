"""Command `create-tasks`: task folders of many pairs, their table and their resumption."""

import json
import shutil
from types import SimpleNamespace

import pytest

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")

from guiderail.models.common.errors import InputError
from guiderail.models.primitives import mixture
from guiderail.tools.cli.main import main
from guiderail_parts import batch, contact, contact_map
from guiderail_parts.batch import create_tasks, create_with_shrink
from guiderail_parts.geometry import demonstrator
from guiderail_parts.geometry.assembly_check import OverlapError
from guiderail_parts.pairs import Pair, read_pairs
from oracles.parts import PARTS


def test_table_has_results_and_failures_and_is_continued(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(demonstrator, "_ANGLES", demonstrator._ANGLES[:3])  # three demonstrations
    monkeypatch.setattr(demonstrator, "NUM_DEMONSTRATIONS", 3)
    monkeypatch.setattr(contact_map, "TOUCHES", 4)
    monkeypatch.setattr(mixture, "_MAX_COMPONENTS", 1)
    monkeypatch.setattr(contact, "MAX_TRIALS", 1)
    monkeypatch.setattr(contact, "MIN_SPEED", 0.0)  # no further trials on a slow machine
    meshes, out = tmp_path / "meshes", tmp_path / "parts"
    for name in ("good", "bad"):
        (meshes / name).mkdir(parents=True)
        plug = PARTS["square_peg"]().write(meshes / name)[0]
    plug.write_bytes(b"no mesh")
    arguments = ["create-tasks", meshes, "--unit", "mm", "--out", out, "--hard-episodes", 0, "--processes", 2, "--json"]

    def call():
        with pytest.raises(SystemExit) as end:
            main([str(argument) for argument in arguments])
        assert end.value.code == 0
        return json.loads(capsys.readouterr().out)

    first = call()
    assert (first["pairs"], first["created"], list(first["failures"])) == (2, 1, ["bad"])
    assert (out / "good" / "task.yaml").is_file()
    assert not (out / "bad").exists()
    lines = (out / "parts.csv").read_text().splitlines()
    assert lines[1].startswith("bad,")
    assert "plug.stl" in lines[1]
    assert lines[2].startswith("good,,0")
    assert "demonstrations" in (out / "logs" / "good.txt").read_text()
    written = (out / "good" / "task.yaml").stat().st_mtime_ns
    shutil.copy(meshes / "good" / plug.name, plug)
    assert call() == first  # a stored failure is not repeated

    def create(plug, socket, out, **options):
        out.mkdir()
        return {"inserted": True}

    monkeypatch.setattr(batch, "create_task", create)  # only for the pair that failed
    arguments.append("--retry")
    assert call()["created"] == 2
    assert (out / "good" / "task.yaml").stat().st_mtime_ns == written


def test_overlapping_plug_is_shrunk_until_it_fits(tmp_path, monkeypatch):
    tried = []

    def create_task(plug, socket, out, *, shrink, unit, log):
        tried.append(shrink)
        if len(tried) < 3:
            raise OverlapError("the parts overlap", 7e-5 if len(tried) == 1 else 6e-5)
        return {"inserted": True}

    monkeypatch.setattr(batch, "create_task", create_task)
    pair = Pair("a", tmp_path / "plug.stl", tmp_path / "socket.stl", "mm")
    assert create_with_shrink(pair, tmp_path / "a", lambda text: None) == {"inserted": True, "shrink_mm": 0.13}
    assert tried == pytest.approx([0.0, 7e-5, 1.3e-4])

    def refuse(*paths, **options):
        raise OverlapError("the parts overlap by far", None)

    monkeypatch.setattr(batch, "create_task", refuse)
    with pytest.raises(InputError, match="overlap by far"):
        create_with_shrink(pair, tmp_path / "a", lambda text: None)


def test_pairs_of_a_table_have_their_options(tmp_path):
    table = tmp_path / "pairs.csv"
    table.write_text("name,plug,socket,unit,shrink,axis\n00133,a/plug.obj,a/socket.obj,m,0.0001,\nb,p.stl,s.stl,,,+x\n")
    first, second = read_pairs(table, "mm")
    assert (first.name, first.plug, first.unit) == ("00133", tmp_path / "a" / "plug.obj", "m")
    assert dict(first.options) == {"shrink": 0.0001}
    assert (second.unit, dict(second.options)) == ("mm", {"axis": "+x"})
    for text, message in (
        ("name,plug\na,b\n", "no column socket"),
        ("name,plug,socket,shrnik\na,b,c,1\n", "the column 'shrnik': did you mean shrink"),
        ("name,plug,socket\na,b\n", "not as long as the header"),
        ("name,plug,socket\na,,c\n", "without name, plug or socket"),
        ("name,plug,socket\na,b,c\na,b,c\n", "two pairs named 'a'"),
        ("name,plug,socket\na/b,b,c\n", "a name has letters"),
    ):
        table.write_text(text)
        with pytest.raises(InputError, match=message):
            read_pairs(table)
    with pytest.raises(InputError, match="there is no table of pairs"):
        read_pairs(tmp_path / "missing.csv")


def test_damaged_results_and_processes_are_refused(tmp_path):
    (tmp_path / "parts.json").write_text("[1]")
    with pytest.raises(InputError, match="is damaged"):
        create_tasks([], tmp_path)
    with pytest.raises(InputError, match="--processes must be a whole number of at least 1"):
        create_tasks([], tmp_path, processes=0)


def test_refusal_names_the_extra_for_intricate_parts(tmp_path, monkeypatch):
    def make_compliant(kind, surfaces, tolerance, report):
        report("plug: too intricate for convex pieces")
        report("plug: no tetrahedra (this needs pytetwild, which is not installed)")
        return []

    monkeypatch.setattr(contact, "make_compliant", make_compliant)
    surfaces = {name: SimpleNamespace(snapping=0) for name in ("plug", "socket")}
    for is_installed in (False, True):
        monkeypatch.setattr(contact, "find_spec", lambda name, found=is_installed: found or None)
        with pytest.raises(InputError) as error:
            contact.choose_contact(tmp_path, surfaces, None, 1e-5, 1e-4, lambda text: None)
        assert ('pip install "guiderail[repair]"' in str(error.value)) != is_installed
