"""Certification of several skills, with a table of results."""

import pandas as pd
import pytest

from guiderail.models.common.errors import InputError
from research.certificates import SHIPPED, Declaration, certify_skills, load_declaration, main
from research.command import run_program


def declaration(guidance="kgrl"):
    """Return a declaration of a single skill."""
    environment = {"guidance": guidance, "control_period": 0.1}  # fewer control steps, which shortens the test
    return Declaration(skills={"passage": {"task": "NarrowPassage", "env": environment}}, attack=400)


def test_certificates_are_reused_when_skill_is_unchanged(tmp_path, monkeypatch):
    result = certify_skills(tmp_path, declaration())
    rows = pd.read_csv(tmp_path / "certificates.csv")
    assert rows["skill"].tolist() == ["passage"]
    row = rows.iloc[0]
    assert row["checker"] == "yes"
    assert row["bound_violations"] == 0
    assert row["worst_ratio_free"] >= 1.0 - 1e-6
    assert row["attack_steps"] >= 400
    monkeypatch.setattr("research.certificates.certify_skill", None)
    assert certify_skills(tmp_path, declaration())["table"] == result["table"]
    with pytest.raises(TypeError):  # another skill with the same name is certified again
        certify_skills(tmp_path, declaration("skgrl"))


def test_shipped_declaration_is_valid():
    assert len(load_declaration(SHIPPED).skills) == 8


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("skills: {}", "skills"),
        ("[1]", "content"),
        ("skills: {a: {task: NarrowPassage}}\nsteps: 1", "steps"),
        ("skills: {a: {task: NarrowPassage}}\nattack: 0", "attack"),
    ],
)
def test_declaration_is_refused_when_invalid(text, message, tmp_path):
    (tmp_path / "skills.yaml").write_text(text)
    with pytest.raises(InputError, match=message) as refused:
        load_declaration(tmp_path / "skills.yaml")
    assert "\n" not in str(refused.value)
    with pytest.raises(InputError, match="there is no file"):
        load_declaration(tmp_path / "none.yaml")


def certified(checker="yes", violations=0):
    """Return the result of certifying a skill."""
    row = {"quantity": "pose", "output": 0, "constraint": "never active", "ratio": 1.0, "violations": violations}
    numbers = dict.fromkeys(("checker_seconds", "steps", "constrained_steps"), 1)
    return {"checker": checker, "attack": [row], "attack_steps": 1, "attack_corrected": 0, **numbers}


@pytest.mark.parametrize(
    ("result", "sentence"),
    [
        (certified(), None),
        (certified(checker="no: step 3: too tight"), "a_skill: the certificate is rejected by the checker: no: step 3"),
        (certified(violations=2), "a_skill: an adversary exceeded 2 bounds"),
    ],
)
def test_program_exits_with_1_when_a_certificate_fails(tmp_path, monkeypatch, capsys, result, sentence):
    (tmp_path / "skills.yaml").write_text("skills: {other: {task: NarrowPassage}, a_skill: {task: NarrowPassage}}\n")
    monkeypatch.setattr(
        "research.certificates.certify_skill", lambda *_, out, **__: result if out.name == "a_skill" else certified()
    )
    with pytest.raises(SystemExit) as ended:
        run_program(main, [str(tmp_path / "skills.yaml"), "--out", str(tmp_path / "out")])
    assert (tmp_path / "out" / "certificates.csv").is_file()
    assert ended.value.code == (0 if sentence is None else 1)
    assert (sentence or "") in capsys.readouterr().err
