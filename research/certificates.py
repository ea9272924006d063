"""The study `certificates`: what shipped skills can command at all, beside the worst that an adversary found.

Each skill is certified, checked by the checker that shares nothing with the primitive, and attacked. A bound is as
tight as the worst found says; both are the largest over all steps, apart for those at which a constraint can be active.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pandas as pd

from guiderail.tools.certify import certify_skill
from guiderail.tools.evaluation.evaluate import cached
from guiderail.tools.tables import write_table

OUTPUTS = ("x", "y", "z", "Rz", "Ry", "Rx")


def certificates(out: Path, *, skills: Mapping[str, Mapping[str, Any]], attack: int) -> dict[str, Any]:
    """Certifies and attacks skills; one that was attacked so in the folder already is not attacked again.

    Args:
        out: the folder; each skill's certificate is in a folder of its own in it.
        skills: by name, the `task` and the arguments of its environment, `env`.
        attack: steps of the adversary, on each.

    Returns:
        Where the table is, and how many skills are in it; `failed` says which of them left a bound, or were rejected.

    Raises:
        InputError: if a skill can't be certified.
    """
    rows = []
    for name, skill in skills.items():
        folder = out / "certificates" / name
        digest = hashlib.sha256(json.dumps([skill, attack], sort_keys=True).encode()).hexdigest()[:8]
        rows.append(cached(folder / f"told-{digest}.csv", partial(_told, skill, folder, attack)))
        rows[-1].insert(0, "skill", name)
    table = pd.concat(rows, ignore_index=True)
    found: dict[str, Any] = {
        "table": str(write_table(out / "certificates", table.to_dict("records"))),
        "skills": len(table),
    }
    failed = [words for row in table.to_dict("records") if (words := _failure(row))]
    return found | ({"failed": failed} if failed else {})


def _failure(row: Mapping[Any, Any]) -> str:
    """What does not hold of a skill's certificate; empty where all does."""
    if row["checker"] != "yes":
        return f"{row['skill']}: the checker says {row['checker']}"
    return f"{row['skill']}: an adversary left {row['bounds_left']} bounds" if row["bounds_left"] else ""


def _told(skill: Mapping[str, Any], folder: Path, attack: int) -> pd.DataFrame:
    """One row."""
    found = certify_skill(skill["task"], skill["env"], out=folder, attack=attack)
    rows = pd.DataFrame(found["attack"])
    tight = rows[rows["ratio"].notna()]
    active = tight["constraint"] == "can be active"
    told: dict[str, Any] = {
        "checker": found["checker"],
        "checker_seconds": found["checker_seconds"],
        "steps": found["steps"],
        "steps_constraints_can_touch": found["steps_that_constraints_can_touch"],
        "attack_steps": found["attack_steps"],
        "attack_corrected": found["attack_corrected"],
        "bounds_left": int(rows["left"].sum()),
        "budget_spent": found.get("budget_spent"),
        "worst_ratio_free": tight.loc[~active, "ratio"].max(),
        "worst_ratio_active": tight.loc[active, "ratio"].max(),
        "median_ratio_active": tight.loc[active, "ratio"].median(),
    }
    if active.any():
        worst = tight[active].nlargest(1, "ratio").iloc[0]
        told["worst_active"] = f"{worst['quantity']} of {OUTPUTS[int(worst['output'])]}"
    return pd.DataFrame([told])
