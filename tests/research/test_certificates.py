import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from guiderail.tools.cli.main import main
from guiderail.tools.experiments.declaration import load_study
from research.certificates import certificates

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
    monkeypatch.setattr("research.certificates.certify_skill", None)
    assert certificates(tmp_path, skills=SKILLS, attack=2000)["table"] == found["table"]
    other = {"passage": {"task": "NarrowPassage", "env": {"guidance": "skgrl"}}}
    with pytest.raises(TypeError):  # another skill of the same name is no finished one
        certificates(tmp_path, skills=other, attack=2000)


def test_the_program_is_named(tmp_path):
    for program, words in (("certificate", "did you mean certificates"), ("[1]", "there is no program")):
        (tmp_path / "study.yaml").write_text(f"name: a\nprogram: {program}\nskills: {{a: {{task: NarrowPassage}}}}\n")
        with pytest.raises(InputError, match=words):
            load_study(tmp_path / "study.yaml")


def found(checker="yes", left=0):
    """What certifying a skill comes to."""
    row = {"quantity": "pose", "output": 0, "constraint": "never active", "ratio": 1.0, "left": left}
    numbers = dict.fromkeys(("checker_seconds", "steps", "steps_that_constraints_can_touch"), 1)
    return {"checker": checker, "attack": [row], "attack_steps": 1, "attack_corrected": 0, **numbers}


@pytest.mark.parametrize(
    ("came", "words"),
    [
        (found(), None),
        (found(checker="no: step 3: too tight"), "a_skill: the checker says no: step 3: too tight"),
        (found(left=2), "a_skill: an adversary left 2 bounds"),
    ],
)
def test_what_does_not_hold_ends_the_command_as_it_ends_certify(tmp_path, monkeypatch, capsys, came, words):
    (tmp_path / "study.yaml").write_text(
        "name: a\nprogram: certificates\nskills: {other: {task: NarrowPassage}, a_skill: {task: NarrowPassage}}\n"
    )
    monkeypatch.setattr(
        "research.certificates.certify_skill",
        lambda *_, out, **__: came if out.name == "a_skill" else found(),
    )
    with pytest.raises(SystemExit) as ended:
        main(["study", str(tmp_path / "study.yaml"), "--out", str(tmp_path / "out")])
    assert (tmp_path / "out" / "certificates.csv").is_file()
    assert ended.value.code == (0 if words is None else 1)
    assert capsys.readouterr().err == ("" if words is None else f"guiderail: {words}\n")
