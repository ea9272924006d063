import pandas as pd
import pytest

from guiderail.models.errors import InputError
from guiderail.tools.studies.certificates import certificates
from guiderail.tools.studies.declaration import load_study

SKILLS = {"passage": {"task": "NarrowPassage", "env": {"guidance": "kgrl"}}}


def test_a_row_for_each_skill_and_nothing_is_attacked_twice(tmp_path, monkeypatch):
    found = certificates(tmp_path, skills=SKILLS, attack=2000)
    rows = pd.read_csv(tmp_path / "certificates.csv")
    assert rows["skill"].tolist() == ["passage"]
    row = rows.iloc[0]
    assert row["checker"] == "yes"
    assert row["bounds_left"] == 0
    assert row["worst_ratio_free"] >= 1.0 - 1e-6
    assert row["attack_steps"] >= 2000
    monkeypatch.setattr("guiderail.tools.studies.certificates.certify_skill", None)
    assert certificates(tmp_path, skills=SKILLS, attack=2000)["table"] == found["table"]
    other = {"passage": {"task": "NarrowPassage", "env": {"guidance": "skgrl"}}}
    with pytest.raises(TypeError):  # another skill of the same name is no finished one
        certificates(tmp_path, skills=other, attack=2000)


def test_the_program_is_named(tmp_path):
    for program, words in (("certificate", "did you mean certificates"), ("[1]", "there is no program")):
        (tmp_path / "study.yaml").write_text(f"name: a\nprogram: {program}\nskills: {{a: {{task: NarrowPassage}}}}\n")
        with pytest.raises(InputError, match=words):
            load_study(tmp_path / "study.yaml")
