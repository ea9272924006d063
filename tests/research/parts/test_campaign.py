"""Benchmark of assembly pairs: search for pairs, stored steps, and the table of results."""

import json

import pytest

pytest.importorskip("trimesh")
pytest.importorskip("manifold3d")
pytest.importorskip("igl")

from guiderail.models.common.errors import InputError
from guiderail.tools.tables import write_table
from guiderail_parts.pairs import find_pairs
from research.parts.campaign import StepError, describe_calibration, finish, summarize, to_table


def test_find_pairs_finds_plugs_with_their_sockets(tmp_path):
    names = (
        "a/asset_plug.obj", "a/asset_socket.obj", "b/plug.stl", "b/socket.stl", "c/plug.stl",
        "d/industreal_gear_small.obj", "d/industreal_gear_base.obj",
    )  # fmt: skip
    for name in names:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    assert [pair.name for pair in find_pairs(tmp_path)] == ["a", "b", "industreal_gear_small"]
    with pytest.raises(InputError, match="has no pairs"):
        find_pairs(tmp_path / "c")
    for name in ("b/second_plug.stl", "b/second_socket.stl"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="two pairs are named 'b'"):
        find_pairs(tmp_path)
    (tmp_path / "c/industreal_gear_small.obj").touch()
    with pytest.raises(InputError, match=r"industreal_gear_small\.obj is in two folders \(.*/c, .*/d\)"):
        find_pairs(tmp_path)


def test_finished_steps_are_not_repeated(tmp_path):
    def fail():
        raise StepError("invalid mesh")

    assert finish(tmp_path / "a.json", lambda: {"inserted": True}) == {"inserted": True}
    assert finish(tmp_path / "a.json", fail) == {"inserted": True}
    assert finish(tmp_path / "b.json", fail) == {"error": "invalid mesh"}
    assert json.loads((tmp_path / "b.json").read_text()) == {"error": "invalid mesh"}


def test_table_has_measurements_and_summary_has_errors(tmp_path):
    measured = {
        "inserted": True,
        "clearance_mm": 0.1,
        "penetration_pushed_on_the_rim_mm": 0.06,
        "real_time_factor": 9.0,
    }
    measured |= {"preparation_s": 1.0, "inserted_s": 2.0, "hard-0": {"success_rate": 0.98}}
    rows = {"a": measured, "b": {"error": "the parts overlap | here"}}
    write_table(tmp_path / "table", to_table(rows))
    lines = (tmp_path / "table.md").read_text().splitlines()
    assert len({line.count(" | ") for line in lines}) == 1
    assert "0.98" in lines[2]
    summary = summarize(rows)
    assert (summary["pairs"], summary["prepared"], summary["inserted"]) == (2, 1, 1)
    assert summary["deeper than half the clearance"] == 1
    assert summary["reasons"] == {"b": "the parts overlap | here"}


def test_calibration_is_described_with_its_result():
    result = {"offset_mm": [2.55, 3.0], "turn_degrees": 3.0, "force_limit": 15.0, "calibrated": True}
    result |= {"uniform_random": "0 of 10", "scripted": "10 of 10"}
    text = describe_calibration(result)
    assert text == "2.55 to 3 mm, 3°, 15 N: random 0 of 10, scripted 10 of 10"
    assert describe_calibration(result | {"calibrated": False}) == f"{text} (not as hard as required)"
    assert describe_calibration(None) == "not calibrated"
