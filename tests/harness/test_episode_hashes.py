"""Hashes of seeded episodes and their comparison."""

import json

from episode_hashes import all_cases, case_name, differences, episode_hash, main

from guiderail.diagrams.tasks.registry import TASKS

OPTIONS = {"guidance": "kgrl", "action_repeat": 5}


def test_episode_hash_is_reproducible_and_depends_on_options():
    first = episode_hash("NarrowPassage", OPTIONS, steps=5)
    assert episode_hash("NarrowPassage", OPTIONS, steps=5) == first
    assert episode_hash("NarrowPassage", OPTIONS | {"action_scale": 0.5}, steps=5) != first
    assert episode_hash("NarrowPassage", OPTIONS | {"action_repeat": 0}).startswith("refused: ")


def test_cases_cover_every_shipped_task_once():
    names = [case_name(*case) for case in all_cases()]
    assert len(set(names)) == len(names)
    shipped = {name for name in TASKS.names() if TASKS.get(name).__module__.startswith("guiderail.")}
    assert {task for task, _ in all_cases()} == shipped


def test_compare_lists_cases_that_differ(tmp_path, capsys):
    first, second = {"a": "1", "b": "2"}, {"a": "1", "b": "3", "c": "4"}
    assert differences(first, first) == []
    for name, hashes in (("first", first), ("second", second)):
        (tmp_path / f"{name}.json").write_text(json.dumps(hashes))
    assert main(["compare", str(tmp_path / "first.json"), str(tmp_path / "second.json")]) == 1
    assert capsys.readouterr().out.splitlines() == ["b: 2 → 3", "c: missing → 4", "2 of 3 cases differ"]
    assert main(["compare", str(tmp_path / "first.json"), str(tmp_path / "first.json")]) == 0
