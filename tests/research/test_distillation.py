"""Comparison of a distilled student with its teacher: options of the variants, stored blocks, refused arguments."""

from pathlib import Path
from types import SimpleNamespace

import pandas as pd
import pytest

import research.distillation as distillation
from guiderail.models.common.errors import InputError

ENVIRONMENT = {"guidance": "kgrl", "action_repeat": 10}


def test_variants_replace_only_the_guidance_of_the_teacher():
    arguments = "NarrowPassage", ENVIRONMENT, Path("student"), 10
    assert distillation.options_of("teacher", *arguments)["guidance"] == "kgrl"
    for variant in list(distillation.VARIANTS)[1:]:
        options = distillation.options_of(variant, *arguments)
        assert options["base_policy"] == "student"
        assert options["base_policy.replan_steps"] == 10
        assert options["guidance"] in ("base_policy", "kgrl_base_policy")
        assert options["action_repeat"] == 10


def test_comparison_has_a_row_per_variant_and_stores_blocks(tmp_path, monkeypatch):
    evaluated = []

    def evaluate(teacher, student, variant, episodes, seed):
        evaluated.append((variant, seed))
        columns = ("peak_force", "jerk_commanded_linear", "max_commanded_violation")
        return pd.DataFrame([{"success": 1, **dict.fromkeys(columns, 1.0)}] * episodes)

    monkeypatch.setattr(distillation, "evaluate_variant", evaluate)
    monkeypatch.setattr(distillation, "time_per_action", lambda *folders: {"teacher": 1.0, "student": 0.1})
    monkeypatch.setattr(distillation, "find_base_policy", lambda source: SimpleNamespace())
    monkeypatch.setattr(distillation, "Policy", SimpleNamespace(load=lambda path: None))
    for name in ("teacher", "student"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "policy.safetensors").write_bytes(b"weights")
    rows = distillation.compare(tmp_path / "teacher", tmp_path / "student", tmp_path / "out", episodes=11)
    assert [row["variant"] for row in rows] == list(distillation.VARIANTS)
    assert [row["episodes"] for row in rows] == [11] * 4
    assert rows[1]["time_per_action_ms"] == pytest.approx(0.1)
    assert len(evaluated) == 8
    distillation.compare(tmp_path / "teacher", tmp_path / "student", tmp_path / "out", episodes=11)
    assert len(evaluated) == 8
    (tmp_path / "teacher" / "policy.safetensors").write_bytes(b"other weights")
    distillation.compare(tmp_path / "teacher", tmp_path / "student", tmp_path / "out", episodes=11)
    assert len(evaluated) == 16
    with pytest.raises(InputError, match="at least one"):
        distillation.compare(tmp_path / "teacher", tmp_path / "student", tmp_path / "out", episodes=0)
