"""Certificates of shipped skills, with the worst command that an adversary found.

Each skill is certified, its certificate is verified by a checker that shares no code with the primitive, and the skill
is attacked. The ratio of a bound to the worst command found shows how tight the bound is. The table has the largest
ratio of all steps at which a constraint can be active, and the largest ratio of the other steps.

Run it with `python -m research.certificates --out studies`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from guiderail.models.common.errors import InputError, RunsFailedError
from guiderail.models.common.yaml import load_yaml
from guiderail.tools.evaluation.evaluation import load_or_compute
from guiderail.tools.tables import write_table
from guiderail_studies.certify import certify_skill
from research.command import Parser, print_result, run_program

SHIPPED = Path(__file__).with_name("certificates.yaml")
OUTPUTS = ("x", "y", "z", "Rz", "Ry", "Rx")


class CertifiedSkill(BaseModel):
    """Skill to certify.

    Attributes:
        task: Name of the task.
        env: Options of its environment.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    task: str
    env: dict[str, Any] = {}


class Declaration(BaseModel):
    """Content of the YAML file.

    Attributes:
        skills: Skills to certify, by name; each name is also the name of a folder.
        attack: Steps of the adversary on each skill.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    skills: dict[Annotated[str, Field(pattern=r"^[\w.-]+$")], CertifiedSkill] = Field(min_length=1)
    attack: int = Field(default=1_000_000, ge=1, strict=True)


def load_declaration(file: Path) -> Declaration:
    """Read the YAML file that declares which skills are certified.

    Raises:
        InputError: If the file is missing or its content is invalid.
    """
    if not file.is_file():
        raise InputError(f"there is no file {file}: name a YAML file with skills and attack")
    try:
        return Declaration.model_validate(load_yaml(file, "list of skills"))
    except ValidationError as error:
        first = error.errors()[0]
        place = ", ".join(map(str, first["loc"])) or "content"
        raise InputError(f"{file}: {place}: {first['msg'][:1].lower()}{first['msg'][1:]}") from error


def certify_skills(out: Path, declaration: Declaration) -> dict[str, Any]:
    """Certify and attack skills; results that are already in the folder are reused.

    Args:
        out: Folder of the table `certificates.csv`, and of a folder for each skill's certificate.
        declaration: Skills and the length of the attack.

    Returns:
        The table's path and number of skills. `failed` has a sentence for each skill whose certificate is rejected or
        violated; the entry is absent if all certificates are valid.

    Raises:
        InputError: If a skill cannot be certified.
    """
    rows = []
    for name, skill in declaration.skills.items():
        folder = out / "certificates" / name
        content = json.dumps([skill.model_dump(), declaration.attack], sort_keys=True).encode()
        file = folder / f"row-{hashlib.sha256(content).hexdigest()[:8]}.csv"
        rows.append(load_or_compute(file, partial(_certify, skill, folder, declaration.attack)))
        rows[-1].insert(0, "skill", name)
    table = pd.concat(rows, ignore_index=True)
    result: dict[str, Any] = {
        "table": str(write_table(out / "certificates", table.to_dict("records"))),
        "skills": len(table),
    }
    failed = [sentence for row in table.to_dict("records") if (sentence := _failure(row))]
    return result | ({"failed": failed} if failed else {})


def _failure(row: Mapping[Any, Any]) -> str:
    """Return a sentence on a rejected or violated certificate; an empty string for a valid certificate."""
    if row["checker"] != "yes":
        return f"{row['skill']}: the certificate is rejected by the checker: {row['checker']}"
    return f"{row['skill']}: an adversary exceeded {row['bound_violations']} bounds" if row["bound_violations"] else ""


def _certify(skill: CertifiedSkill, folder: Path, attack: int) -> pd.DataFrame:
    """Certify and attack one skill; return its row."""
    result = certify_skill(skill.task, skill.env, out=folder, attack=attack)
    bounds = pd.DataFrame(result["attack"])
    rated = bounds[bounds["ratio"].notna()]
    active = rated["constraint"] == "can be active"
    row: dict[str, Any] = {
        "checker": result["checker"],
        "checker_seconds": result["checker_seconds"],
        "steps": result["steps"],
        "constrained_steps": result["constrained_steps"],
        "attack_steps": result["attack_steps"],
        "attack_corrected": result["attack_corrected"],
        "bound_violations": int(bounds["violations"].sum()),
        "budget_spent": result.get("budget_spent"),
        "worst_ratio_free": rated.loc[~active, "ratio"].max(),
        "worst_ratio_active": rated.loc[active, "ratio"].max(),
        "median_ratio_active": rated.loc[active, "ratio"].median(),
    }
    if active.any():
        worst = rated[active].nlargest(1, "ratio").iloc[0]
        row["worst_active"] = f"{worst['quantity']} of {OUTPUTS[int(worst['output'])]}"
    return pd.DataFrame([row])


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser("certificates", "Certify skills and attack their certificates.", "--out studies")
    parser.add_argument("file", type=Path, nargs="?", default=SHIPPED, help="YAML file of skills (default: shipped)")
    parser.add_out(None)
    parser.add_json()
    args = parser.parse_args(arguments)
    result = certify_skills(args.out, load_declaration(args.file))
    print_result(result, as_json=args.json)
    if "failed" in result:
        raise RunsFailedError(result["failed"], None)


if __name__ == "__main__":
    run_program(main)
