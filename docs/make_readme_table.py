"""Writes the README's table of results from the tables of finished studies: `python docs/make_readme_table.py`.

`guiderail results STUDIES --out docs/results` leaves those tables. A study that is not there is left out, and so is a
task without any; whatever seeds are there are told.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.tables import read_table

HERE = Path(__file__).parent
README, RESULTS = HERE.parent / "README.md", HERE.parent / "research" / "results"
BEGIN, END = "<!-- Written by docs/make_readme_table.py -->", "<!-- End of what it wrote -->"
COLUMNS = (
    "task", "method", "training episodes (seeds)", "success held out [%], each seed of 100", "converged after",
    "commands beyond the bound", "peak force held out (in training) [N]",
)  # fmt: skip
NULLS = ("demonstrations alone", "white noise", "best constant action", "rule written by hand")


@dataclass(frozen=True)
class Row:
    """What the table tells of a method of a study.

    Attributes:
        name: as a stranger calls it.
        study, method: in whose table it is, and its name there.
        judged: on which episodes, where the study has several kinds.
    """

    name: str
    study: str
    method: str
    judged: str | None = None


def _nulls(study: str, methods: Sequence[str], judged: str | None = None, names: Sequence[str] = NULLS) -> list[Row]:
    return [Row(name, study, method, judged) for name, method in zip(names, methods, strict=True)]


NO_DEMONSTRATIONS = ("no input", *NULLS[1:])  # a template has none: it stays where it is
# Of each task: what it asks for, in few words, and its rows.
TASKS: dict[str, list[Row]] = {
    "**connector**, a hidden offset per run": [
        Row("KGRL", "connector", "kgrl"),
        Row("sKGRL", "connector", "skgrl"),
        Row("residual RL", "connector_guidance", "residual"),
        *_nulls("connector_nulls", ("demonstrations", "uniform_random", "best_constant", "scripted"), "per_run"),
    ],
    "**connector**, the thesis to the letter": [
        Row("KGRL", "connector_thesis", "kgrl"),
        Row("sKGRL", "connector_thesis", "skgrl"),
        *_nulls("connector_thesis", ("demonstrations", "uniform_random"), names=NULLS[:2]),
    ],
    "**connector**, another offset in every episode": [
        Row("KGRL", "connector_disc", "kgrl"),
        Row("sKGRL", "connector_disc", "skgrl"),
        *_nulls("connector_nulls", ("demonstrations", "uniform_random", "best_constant", "scripted"), "per_episode"),
    ],
    "**connector, hard**": [
        Row("KGRL", "connector_hard", "kgrl"),
        Row("sKGRL, adaptive history", "connector_hard", "skgrl_adaptive"),
        Row("sKGRL", "connector_hard", "skgrl"),
        Row("residual RL", "connector_hard", "residual"),
        Row("safe residual RL", "connector_hard", "safe_residual"),
        Row("residual RL that reaches farther", "connector_hard", "residual_far"),
        *_nulls("connector_hard_nulls", ("demonstrations", "uniform_random", "best_constant", "scripted")),
    ],
    "**connector, hard**, commands within 2.8 mm": [
        Row("KGRL", "connector_hard_safety", "kgrl"),
        Row("sKGRL, adaptive history", "connector_hard_safety", "skgrl_adaptive"),
        Row("residual RL", "connector_hard_safety", "residual"),
        Row("safe residual RL", "connector_hard_safety", "safe_residual"),
        *_nulls(
            "connector_hard_safety", ("demonstrations", "uniform_random", "scripted"), names=(*NULLS[:2], NULLS[3])
        ),
    ],
    "**connector, hard**, learned at a finer contact in Drake, judged in MuJoCo": [
        Row("KGRL", "connector_hard_fine", "kgrl", "MuJoCo"),
        Row("KGRL, randomized contact", "connector_hard_fine", "kgrl_randomized", "MuJoCo"),
        Row("sKGRL, adaptive history", "connector_hard_fine", "skgrl_adaptive", "MuJoCo"),
        Row("residual RL", "connector_hard_fine", "residual", "MuJoCo"),
        *_nulls(
            "connector_hard_fine", ("demonstrations", "uniform_random", "scripted"), "MuJoCo", (*NULLS[:2], NULLS[3])
        ),
    ],
    "**grid clamp**": [
        Row("RL-SCT", "grid_clamp", "sct"),
        Row("residual RL", "grid_clamp_guidance", "residual"),
        Row("RL, 6D velocities", "grid_clamp_guidance", "none"),
        *_nulls(
            "grid_clamp_nulls", ("nothing", "uniform_random", "best_constant", "scripted"), names=NO_DEMONSTRATIONS
        ),
    ],
    "**grid clamp, hard**": [
        Row("RL-SCT, shown 3 episodes", "grid_clamp_hard", "sct"),
        Row("residual RL", "grid_clamp_hard", "residual"),
        Row("RL, 6D velocities", "grid_clamp_hard", "none"),
        *_nulls(
            "grid_clamp_hard_nulls", ("zero", "uniform_random", "best_constant", "scripted"), names=NO_DEMONSTRATIONS
        ),
    ],
    "**pouring**": [
        Row("RL-SCT, shaped", "pouring_sac", "rl_sct_shaped"),
        Row("RL-SCT, sparse", "pouring_sac", "rl_sct_sparse"),
        Row("RL, shaped by hand", "pouring_sac", "rl_shaped"),
        *_nulls(
            "pouring_nulls", ("nothing", "uniform_random", "best_constant", "scripted_pour"), names=NO_DEMONSTRATIONS
        ),
    ],
    "**pouring, hard**": [
        Row("RL-SCT", "pouring_hard", "rl_sct"),
        Row("RL-SCT, longer", "pouring_hard", "rl_sct_longer"),
        Row("RL, shaped by hand", "pouring_hard", "rl"),
        *_nulls("pouring_hard_nulls", ("zero", "uniform_random", "best_constant", "scripted"), names=NO_DEMONSTRATIONS),
    ],
    "**narrow passage**": [
        Row("KGRL", "narrow_passage", "kgrl"),
        Row("residual RL", "narrow_passage", "residual"),
        Row("safe residual RL", "narrow_passage", "safe_residual"),
        *_nulls("narrow_passage_nulls", ("demonstrations", "uniform_random", "best_constant"), names=NULLS[:3]),
    ],
    "**narrow passage, hard**": [
        Row("KGRL, shown 10 episodes", "narrow_passage_hard", "kgrl"),
        Row("sKGRL, shown 10 episodes", "narrow_passage_hard", "skgrl"),
        Row("residual RL, shown 10 episodes", "narrow_passage_hard", "residual"),
        Row("safe residual RL, shown 10 episodes", "narrow_passage_hard", "safe_residual"),
        *_nulls(
            "narrow_passage_hard_nulls",
            ("skgrl_demonstrations", "skgrl_white", "skgrl_best_constant", "skgrl_rule"),
            names=[f"{name}, sKGRL" for name in NULLS],
        ),
    ],
}


def table(results: Path = RESULTS) -> str:
    """The table, from the CSV files of a folder."""
    lines = [f"| {' | '.join(COLUMNS)} |", "|" + "---|" * len(COLUMNS)]
    for task, rows in TASKS.items():
        told = [(row.name, *numbers(seeds)) for row in rows if len(seeds := _seeds(results, row))]
        lines += [f"| {' | '.join((task if not i else '', *cells))} |" for i, cells in enumerate(told)]
    return "\n".join(lines)


def _seeds(results: Path, row: Row) -> pd.DataFrame:
    """A method's rows, each seed's after its last training episode."""
    path = results / f"{row.study}.csv"
    if not path.is_file():
        return pd.DataFrame()
    found = read_table(path)
    found = found[(found["method"] == row.method) & ((row.judged is None) | (found["eval_set"] == row.judged))]
    return found.sort_values(["seed", "after_episodes"], kind="stable").drop_duplicates("seed", keep="last")


def numbers(seeds: pd.DataFrame) -> tuple[str, ...]:
    """What is told of a method's seeds, a cell each."""
    held_out = "success_rate" in seeds and seeds["success_rate"].notna().all()
    if "training_episodes" not in seeds or seeds["training_episodes"].isna().all():
        parts = [_safety(seeds, "")]
        return "–", "; ".join(map(_interval, seeds.to_dict("records"))), "–", _beyond(parts), _forces(parts)
    episodes = "/".join(f"{n:g}" for n in dict.fromkeys(seeds["training_episodes"]))
    column = "success_rate" if held_out else "training_success_rate"
    of = "" if not held_out or (seeds["episodes"] == 100).all() else f" of {_each(seeds['episodes'])}"
    success = _each(100 * seeds[column]) + (of if held_out else " in training")
    converged = _each(seeds["training_episodes_to_convergence"])
    parts = [_safety(seeds, prefix) for prefix in (("", "training_") if held_out else ("training_",))]
    forces = _forces(parts) if held_out else f"({_forces(parts)})"
    return f"{episodes} ({_span(seeds['seed'])})", success, converged, _beyond(parts), forces


SAFETY = ("max_commanded_violation", "violating_episodes", "peak_force")


def _safety(seeds: pd.DataFrame, prefix: str) -> pd.DataFrame:
    return seeds[[f"{prefix}{name}" for name in SAFETY]].set_axis(SAFETY, axis=1)


def _each(values: pd.Series) -> str:
    return ", ".join("never" if pd.isna(value) else f"{value:.3g}" for value in values)


def _span(seeds: pd.Series) -> str:
    """Seeds in a row as a span, others one by one."""
    found = sorted(int(seed) for seed in seeds)
    if len(found) > 2 and found == list(range(found[0], found[-1] + 1)):
        return f"{found[0]}–{found[-1]}"
    return ", ".join(map(str, found))


def _interval(row: dict) -> str:
    """A success rate with its Wilson interval, and of how many episodes."""
    rate, low, high = (100 * row[name] for name in ("success_rate", "success_low", "success_high"))
    return f"{rate:.3g} ({low:.1f}–{high:.1f}) of {row['episodes']:.0f}"


def _beyond(parts: Sequence[pd.DataFrame]) -> str:
    """How far commands were outside, and in how many episodes; held out and in training together."""
    worst = max(float(part["max_commanded_violation"].max()) for part in parts)
    if worst <= TOLERANCE:
        return "never"
    episodes = sum(int(part["violating_episodes"].sum()) for part in parts)
    return f"in {episodes} episodes, {1000 * worst:.2f} mm at most"


def _forces(parts: Sequence[pd.DataFrame]) -> str:
    held_out, *training = (f"{float(part['peak_force'].max()):.1f}" for part in parts)
    return held_out + "".join(f" ({one})" for one in training)


def written(readme: str, made: str) -> str:
    """A README with the table between its marks."""
    before, begin, rest = readme.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the README has no place for the table: put {BEGIN!r} and {END!r} there")
    return f"{before}{BEGIN}\n\n{made}\n\n{END}{after}"


if __name__ == "__main__":
    README.write_text(written(README.read_text(encoding="utf-8"), table()), encoding="utf-8")
