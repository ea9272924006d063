"""Who learns the connector, on which seed, how soon and how safely.

Learned policies, the demonstrations alone and a rule written by hand meet the same held-out offsets. Each seed has a
row of its own: what failed on one is not averaged away. A study that was interrupted goes on where it was.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.learning.configure import configure
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.learning.train import train
from guiderail.tools.rollouts.judging import Act, held_out, kept, mean, total, worst
from guiderail.tools.studies.bnc_rule import reactive_rule
from guiderail.tools.studies.study import write_table
from guiderail.tools.studies.study_command import numbers, run_study, study_parser

TASK = "BncConnector"
ENVIRONMENT: dict[str, Any] = {"reward": "shaped"}
# A jack that is elsewhere in every episode is met only now and then where the disc ends: what one learns from each must
# be more. An action that is kept for a while says which way to go; seed 31 missed 7 of 100 jacks without, none with.
SETTINGS: dict[str, dict[str, Any]] = {"disc": {"bursts": 0.15}}
LEARNED = ("kgrl", "skgrl", "skgrl_adaptive", "residual", "safe_residual")
UNLEARNED = ("demonstration", "rule")


@dataclass(frozen=True)
class Cell:
    """One method, one seed."""

    method: str
    uncertainty: str
    seed: int
    marks: tuple[int, ...]  # training episodes after which it is judged
    evaluations: int
    station: str = "rails"  # that it is judged on; it learns on rails

    def config(self, episodes: int, station: str = "rails") -> RunConfig:
        """The run of so many episodes."""
        guidance = {"demonstration": "kmp", "rule": "kgrl", "skgrl_adaptive": "skgrl"}.get(self.method, self.method)
        environment = {**ENVIRONMENT, "guidance": guidance, "uncertainty": self.uncertainty, "station": station}
        if self.method == "skgrl_adaptive":
            environment["adaptive_history"] = True
        settings = SETTINGS.get(self.uncertainty)
        return configure(TASK, environment, settings=settings, episodes=episodes, seed=self.seed)


def connector_study(
    out: Path,
    *,
    methods: Sequence[str] = (*UNLEARNED, "kgrl", "skgrl"),
    uncertainty: str = "calibration",
    seeds: Sequence[int] = range(30, 35),
    marks: Sequence[int] = (40,),
    evaluations: int = 100,
    station: str = "rails",
    report: Callable[[dict[str, Any]], None] | None = None,
) -> dict[str, Any]:
    """Trains, judges, and writes `connector-<uncertainty>-<station>.csv` and `.md`.

    Args:
        out: the folder; runs in it are used again.
        methods: of `LEARNED` and `UNLEARNED`.
        uncertainty: "calibration" or "disc".
        seeds: of the runs, and with them of the hidden offsets.
        marks: after how many training episodes a policy is judged.
        evaluations: held-out episodes each time.
        station: "rails", or "arm" for how a policy that learned on rails does on the arm.
        report: called with each row.

    Raises:
        InputError: for an unknown method, or a number out of range.
    """
    unknown = [method for method in methods if method not in (*LEARNED, *UNLEARNED)]
    if unknown:
        raise InputError(f"there is no method {unknown[0]!r}: choose of {', '.join((*UNLEARNED, *LEARNED))}")
    if not marks or min(marks) < 1 or evaluations < 1 or not seeds:
        raise InputError("a study of the connector needs seeds, training episodes and held-out episodes: at least one")
    rows = []
    for method in methods:
        for seed in seeds:
            cell = Cell(method, uncertainty, seed, tuple(sorted(marks)), evaluations, station)
            for row in judge(cell, out):
                rows.append(row)
                if report is not None:
                    report(row)
    table = write_table(out / f"connector-{uncertainty}-{station}", rows)
    last = [row for row in rows if row["episodes"] in (0, max(marks))]
    return {"table": str(table), "rows": len(rows)} | {
        f"{method}, held-out success of each seed": ", ".join(
            f"{row['held_out_success']:.0%}" for row in last if row["method"] == method
        )
        for method in methods
    }


def judge(cell: Cell, out: Path) -> list[dict[str, Any]]:
    """A row for every mark of a cell; one for a method that doesn't learn."""
    folder = RunFolder(out / f"{cell.method}-{cell.uncertainty}-{cell.seed}")
    if cell.method in UNLEARNED:
        act = reactive_rule if cell.method == "rule" else _still
        return [_row(cell, 0, [], _held_out(cell, folder, 0, act))]
    rows = []
    for mark in cell.marks:
        trained = _trained(folder)
        if trained:
            folder.refuse_another(cell.config(mark))
        if len(trained) < mark:
            trained = train(folder, cell.config(mark), resume=bool(trained))
        elif len(trained) > mark and not _file(folder, cell, mark).exists():
            continue  # the policy of back then is gone: it went on learning
        judged = _held_out(cell, folder, mark)
        rows.append(_row(cell, mark, trained[:mark], judged))
    return rows


def _trained(folder: RunFolder) -> list[dict[str, Any]]:
    return folder.episodes() if (folder.path / "episodes.csv").exists() else []


def _held_out(cell: Cell, folder: RunFolder, mark: int, act: Act | None = None) -> list[dict[str, Any]]:
    """Rows of held-out episodes after so many of training; of the policy in the folder where nobody else acts."""
    config = cell.config(max(mark, 1), cell.station)
    return kept(
        _file(folder, cell, mark),
        lambda: held_out(config, act or Policy.load(folder.path), episodes=cell.evaluations),
    )


def _file(folder: RunFolder, cell: Cell, mark: int) -> Path:
    return folder.path / f"held_out-{cell.station}-{mark}-{cell.evaluations}.csv"


def _row(cell: Cell, mark: int, trained: Sequence[dict[str, Any]], judged: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "method": cell.method,
        "uncertainty": cell.uncertainty,
        "station": cell.station,
        "seed": cell.seed,
        "episodes": mark,
        "held_out_success": mean(judged, "success"),
        "held_out_return": mean(judged, "return"),
        "held_out_mean_force": mean(judged, "mean_force"),
        "held_out_peak_force": worst(judged, "peak_force"),
        "held_out_steps": mean(judged, "steps"),
        "training_success": mean(trained, "success"),
        "training_collisions": sum(row["termination"] == "collision" for row in trained) if trained else None,
        "training_mean_force": mean(trained, "mean_force"),
        "training_peak_force": worst(trained, "peak_force"),
        "worst_violation": worst([*trained, *judged], "worst_violation"),
        "jerk_commanded_linear": mean(trained[:10], "jerk_commanded_linear"),
        "jerk_commanded_angular": mean(trained[:10], "jerk_commanded_angular"),
        "training_seconds": total(trained, "wall_time"),
    }


def _still(observation: np.ndarray) -> np.ndarray:
    return np.zeros(2)


def main(arguments: list[str] | None = None) -> None:
    """Prints a line for every row, and what they come to."""
    parser = study_parser(__doc__, methods="demonstration,rule,kgrl,skgrl", seeds="30,31,32,33,34")
    parser.add_argument("--uncertainty", default="calibration", help="calibration or disc")
    parser.add_argument("--marks", type=numbers, default="40", help="training episodes after which a policy is judged")
    parser.add_argument("--station", default="rails", help="rails, or arm: what policies are judged on")
    run_study(connector_study, parser, arguments)


if __name__ == "__main__":
    main()
