"""`guiderail results`: pages of what was reproduced, from the tables that studies left."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from guiderail.models.errors import InputError
from guiderail.tools.figures.thesis import THESIS
from guiderail.tools.files import write_atomically
from guiderail.tools.rollouts.metrics import TOLERANCE
from guiderail.tools.studies.declaration import Study, load_study, shipped_studies
from guiderail.tools.studies.study import Job
from guiderail.tools.tables import cell, read_table, table_text
from guiderail.tools.thesis import differences

# The figures of the thesis that a study stands beside.
FIGURES = {
    "connector": ("4.8", "5.9"),
    "connector_thesis": ("4.8", "5.9"),
    "grid_clamp": ("3.10",),
    "narrow_passage": ("4.5", "4.6"),
    "pouring_sac": ("3.5", "3.7", "3.8"),
    "pouring_tqc": ("3.6", "3.8"),
}
COLUMNS = (
    "method", "after", "judged on", "each seed, held out", "converged after, each seed", "worst command",
    "collisions in training", "hours",
)  # fmt: skip


def write_results(studies: Sequence[Path], out: Path) -> Path:
    """Takes the tables of studies into a folder, and writes its README.md anew from all that are there.

    Args:
        studies: folders of studies that come along; none to write the page anew only.
        out: the folder with a table for each study.

    Raises:
        InputError: if a folder holds no table of a study that comes along, or there is nothing to write of.
    """
    for folder in studies:
        found = [folder / f"{name}.csv" for name in shipped_studies() if (folder / f"{name}.csv").is_file()]
        if not found:
            raise InputError(f"{folder} holds no table of a study: give a folder that guiderail study finished")
        for file in found:
            write_atomically(out / file.name, table_text(read_table(file)).encode())
    tables = {file.stem: file for file in sorted(out.glob("*.csv")) if file.stem in shipped_studies()}
    if not tables:
        raise InputError(f"there is no table of a study in {out}: name folders of studies")
    parts = [_study(name, read_table(file)) for name, file in tables.items()]
    head = (
        "# What was reproduced\n\nWritten by `guiderail results`, from the table beside it for each study. In "
        "simulation;\nevery seed by itself; held-out episodes are ones that training never drew.\n"
    )
    write_atomically(out / "README.md", "\n".join([head, *parts]).encode())
    return out / "README.md"


def _study(name: str, rows: pd.DataFrame) -> str:
    """The section of a study."""
    study = load_study(name)
    if not isinstance(study, Study):
        raise InputError(f"{name} is no study of methods and seeds: remove its table")
    lines = [f"## {name}", "", f"`guiderail study {name} --out studies`, and the table `{name}.csv`.", ""]
    lines += [f"- Figure {number}: {THESIS[number]}." for number in FIGURES.get(name, ())]
    lines += ["", f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    for (method, mark, judged), group in rows.groupby(["method", "mark", "judged_on"], sort=False):
        told = [method, mark or "–", judged or "–", *_numbers(group)]
        lines.append(f"| {' | '.join(map(cell, told))} |")
    for words, methods in _differences(study).items():
        lines += ["", f"Differs from the thesis in ({', '.join(methods)}): {words}."]
    return "\n".join([*lines, ""])


def _numbers(group: pd.DataFrame) -> list[str]:
    """Of the seeds of a method, side by side."""
    rates, trained = group.get("success_rate", []), "training_episodes" in group
    held_out = ", ".join("–" if pd.isna(rate) else f"{rate:.0%}" for rate in rates)
    if not trained or group["training_episodes"].isna().all():
        return [held_out, "–", "–", "–", "–"]
    converged = ", ".join("never" if pd.isna(n) else f"{n:g}" for n in group["training_converged_after"])
    worst = float(group["training_worst_violation"].max())
    kept = "within" if worst <= TOLERANCE else f"{worst:.2g} outside"
    hours = float(np.nansum(group["training_wall_time"].to_numpy(float))) / 3600
    return [held_out, converged, kept, f"{int(group['training_collisions'].sum())}", f"{hours:.2f}"]


def _differences(study: Study) -> dict[str, list[str]]:
    """In what its methods that learn differ from the thesis; those that do in the same are told together."""
    told: dict[str, list[str]] = {}
    for method in study.methods:
        job = Job(study, method, study.seeds[0], Path())
        if job.learns:
            told.setdefault("; ".join(differences(job.config(job.marks[-1]))), []).append(method)
    return told
