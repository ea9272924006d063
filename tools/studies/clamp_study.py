"""Who learns to insert the grid clamp, how soon, and with how much force.

Policies that learned with and without the cost of force, others' guidance, the straight descent and a rule written by
hand meet the same held-out offsets. Each seed has a row of its own: what failed on one is not averaged away. A study
that was interrupted goes on where it was.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.learning.configure import configure
from guiderail.tools.learning.run_folder import RunConfig, RunFolder, converged_after
from guiderail.tools.learning.train import train
from guiderail.tools.rollouts.judging import held_out, kept, mean, total, worst
from guiderail.tools.studies.clamp_rule import searching_rule, straight_descent
from guiderail.tools.studies.study import write_table
from guiderail.tools.studies.study_command import run_study, study_parser

TASK, ALGORITHM, PRESET = "GridClamp", "sac", "clamp"
LEARNED: dict[str, dict[str, Any]] = {
    "sct": {"guidance": "sct", "reward": "shaped"},
    "sct_no_force": {"guidance": "sct", "reward": "no_force"},
    "residual": {"guidance": "residual", "reward": "shaped"},
    "none": {"guidance": "none", "reward": "shaped"},
}
UNLEARNED: dict[str, Callable[[np.ndarray], np.ndarray]] = {"straight": straight_descent, "rule": searching_rule}
VIOLATION = 1e-9  # [m] more than this outside of the cuboid counts


@dataclass(frozen=True)
class Cell:
    """One method, one seed."""

    method: str
    uncertainty: str
    seed: int
    episodes: int
    evaluations: int

    def config(self) -> RunConfig:
        """Its run."""
        environment = {**LEARNED.get(self.method, LEARNED["sct"]), "uncertainty": self.uncertainty}
        return configure(TASK, environment, algorithm=ALGORITHM, preset=PRESET, episodes=self.episodes, seed=self.seed)


def clamp_study(
    out: Path,
    *,
    methods: Sequence[str] = ("straight", "rule", "sct", "sct_no_force"),
    uncertainty: str = "calibration",
    seeds: Sequence[int] = (80, 81, 82),
    episodes: int = 50,
    evaluations: int = 100,
    report: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Trains, judges, and writes `clamp-<uncertainty>.csv` and `.md`.

    Args:
        out: the folder; runs in it are used again.
        methods: of `UNLEARNED` and `LEARNED`.
        uncertainty: "calibration" or "disc".
        seeds: of the runs, and with them of the hidden offsets.
        episodes: of training.
        evaluations: held-out episodes afterwards.
        report: called with each row.

    Raises:
        InputError: for an unknown method, a number out of range, or a folder that holds other runs.
    """
    unknown = [method for method in methods if method not in (*LEARNED, *UNLEARNED)]
    if unknown:
        raise InputError(f"there is no method {unknown[0]!r}: choose of {', '.join((*UNLEARNED, *LEARNED))}")
    if episodes < 1 or evaluations < 1 or not seeds or not methods:
        raise InputError("a study of the grid clamp needs methods, seeds, training episodes and held-out ones")
    rows = []
    for seed in seeds:
        for method in methods:
            rows.append(judge(Cell(method, uncertainty, seed, episodes, evaluations), out))
            if report is not None:
                report(rows[-1])
    table = write_table(out / f"clamp-{uncertainty}", rows)
    by_method = {method: [row for row in rows if row["method"] == method] for method in methods}
    result: dict[str, Any] = {"table": str(table), "rows": len(rows)}
    for method, of_seeds in by_method.items():
        result[f"{method}, held-out success of each seed"] = ", ".join(
            f"{row['held_out_success']:.0%}" for row in of_seeds
        )
    if {"sct", "sct_no_force"} <= set(methods):
        force, rough = (
            [row["training_squared_force"] for row in by_method[method]] for method in ("sct", "sct_no_force")
        )
        words = "squared force in training, with its cost as a part of without"
        result[f"{words}, each seed"] = ", ".join(f"{a / b:.2f}" for a, b in zip(force, rough, strict=True))
        result[f"{words}, all seeds together"] = f"{sum(force) / sum(rough):.2f}"
    return result


def judge(cell: Cell, out: Path) -> dict[str, Any]:
    """The row of a cell, trained and judged where it is not yet."""
    folder = RunFolder(out / f"{cell.method}-{cell.uncertainty}-{cell.seed}")
    trained: list[dict[str, Any]] = []
    if cell.method in LEARNED:
        begun = (folder.path / "config.yaml").exists()
        if begun:
            folder.refuse_another(cell.config(), also=["episodes"])
        finished = begun and (folder.path / "policy.json").exists()
        trained = folder.episodes() if finished else train(folder, cell.config(), resume=begun)
    return _row(cell, trained, _held_out(cell, folder))


def _held_out(cell: Cell, folder: RunFolder) -> list[dict[str, Any]]:
    """Rows of held-out episodes, from the file where they are known already."""
    return kept(
        folder.path / f"held_out-{cell.evaluations}.csv",
        lambda: held_out(
            cell.config(), UNLEARNED.get(cell.method) or Policy.load(folder.path), episodes=cell.evaluations
        ),
    )


def _row(cell: Cell, trained: Sequence[dict[str, Any]], judged: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """What a cell came to. A mean squared force is an episode's, over its control steps; then over episodes."""

    converged = converged_after(bool(row["success"]) for row in trained)
    return {
        "method": cell.method,
        "uncertainty": cell.uncertainty,
        "seed": cell.seed,
        "episodes": len(trained),
        "held_out_success": mean(judged, "success"),
        "held_out_squared_force": mean(judged, "mean_squared_force"),
        "held_out_peak_force": worst(judged, "peak_force"),
        "held_out_steps": mean(judged, "steps"),
        "held_out_return": mean(judged, "return"),
        "converged_after": converged,
        "training_success": mean(trained, "success"),
        "training_squared_force": mean(trained, "mean_squared_force"),
        "squared_force_since_converged": None if converged is None else mean(trained[converged:], "mean_squared_force"),
        "training_peak_force": worst(trained, "peak_force"),
        "episodes_commanded_outside": sum(row["worst_violation"] > VIOLATION for row in (*trained, *judged)),
        "worst_violation": worst([*trained, *judged], "worst_violation"),
        "collisions": sum(row["collisions"] for row in (*trained, *judged)),
        "training_steps": total(trained, "steps"),
        "training_seconds": total(trained, "wall_time"),
    }


def main(arguments: list[str] | None = None) -> None:
    """Prints a line for every row, and what they come to."""
    parser = study_parser(__doc__, methods="straight,rule,sct,sct_no_force", seeds="80,81,82")
    parser.add_argument("--uncertainty", default="calibration", help="calibration or disc")
    parser.add_argument("--episodes", type=int, default=50, help="of training")
    run_study(clamp_study, parser, arguments)


if __name__ == "__main__":
    main()
