"""Study of held-out parts: rule of the split, and table of stored episodes."""

from pathlib import Path

import pandas as pd
import pytest

pytest.importorskip("guiderail_parts")

from guiderail.models.common.errors import InputError
from research.unseen_parts import compare_single_parts, main, measure_drags, prepared, split_parts, tabulate


def test_split_depends_on_the_names_alone():
    names = [f"{number:05d}" for number in range(100)]
    training, held_out = split_parts(names)
    assert (len(training), len(held_out)) == (66, 34)
    assert sorted(training + held_out) == names
    assert split_parts(reversed(names)) == (training, held_out)
    assert held_out[:3] == ["00015", "00044", "00051"]


def test_parts_that_were_not_prepared_are_skipped(tmp_path):
    for name in ("a", "c"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "task.yaml").touch()
    assert [part.name for part in prepared(tmp_path, ["c", "b", "a"], 5)] == ["c", "a"]
    assert [part.name for part in prepared(tmp_path, ["c", "b", "a"], 1)] == ["c"]


def test_easy_parts_are_reported_apart(tmp_path):
    rates = {"uniform_random": (0.0, 0.5), "scripted": (0.5, 0.5), "general-0": (1.0, 0.5)}
    for policy, values in rates.items():
        (tmp_path / "rows" / policy).mkdir(parents=True)
        for part, rate in zip("ab", values, strict=True):
            rows = pd.DataFrame({"success": [1, 0] if rate == 0.5 else [int(rate)] * 2, "peak_force": [3.0, 4.0]})
            rows = rows.assign(termination=["success", "collision"], max_commanded_violation=-0.1)
            rows.to_csv(tmp_path / "rows" / policy / f"part{part}.csv", index=False)
    table, summary = tabulate(tmp_path / "rows")
    assert list(table["shows_learning"]) == [True, False]
    assert summary["general-0"]["mean"] == 0.75
    assert summary["general-0"]["mean_where_learning_shows"] == 1.0
    assert (summary["general-0"]["collisions"], summary["general-0"]["peak_force"]) == (2, 4.0)


def test_drag_is_measured_at_both_speeds(tmp_path, monkeypatch):
    monkeypatch.setattr("research.unseen_parts.task_named", lambda folder: ("BncConnector", ()))
    monkeypatch.setattr("research.unseen_parts.ENVIRONMENT", {"guidance": "kgrl", "difficulty": "hard"})
    monkeypatch.setattr("research.unseen_parts.drag", lambda workcell, contact, speed: 0.2 + speed)
    measure_drags([tmp_path / "peg"], tmp_path / "contact.csv")
    (row,) = pd.read_csv(tmp_path / "contact.csv").to_dict("records")
    assert row == {"part": "peg", "drag_20": pytest.approx(0.22), "drag_40": pytest.approx(0.24)}


def test_best_single_part_policy_is_chosen_without_its_own_part(tmp_path, monkeypatch):
    """The policy of part a solves only its own part, that of b only a."""
    successes = {"single-part-a": {"a": 1, "b": 0}, "single-part-b": {"a": 1, "b": 0}}
    evaluated = []

    def evaluate(part, policies, episodes, out):
        for name in policies:
            evaluated.append((part.name, name, episodes))
            folder = out / "rows/hard" / name
            folder.mkdir(parents=True, exist_ok=True)
            pd.DataFrame({"success": [successes[name].get(part.name, 0)]}).to_csv(
                folder / f"{part.name}.csv", index=False
            )

    monkeypatch.setattr("research.unseen_parts.evaluate_part", evaluate)
    compare_single_parts([Path("a"), Path("b")], [Path("c"), Path("d")], 20, tmp_path)
    assert evaluated[4:] == [("c", "single-part-b", 20), ("d", "single-part-b", 20)]
    evaluated.clear()
    compare_single_parts([], [Path("c")], 20, tmp_path)
    assert evaluated == []


def test_split_of_other_meshes_is_refused(tmp_path):
    (tmp_path / "meshes" / "a").mkdir(parents=True)
    for name in ("plug.obj", "socket.obj"):
        (tmp_path / "meshes" / "a" / name).touch()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "split.json").write_text("{}")
    with pytest.raises(InputError, match="split of other meshes"):
        main(["--meshes", str(tmp_path / "meshes"), "--out", str(tmp_path / "out")])
