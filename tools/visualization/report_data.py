"""What runs and studies left, read for a report."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.environments import beyond_defaults, known_tasks
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.cache import BASELINES_FOLDER, POLICY, POLICY_FOLDER, policy_digest, stored_episodes
from guiderail.tools.evaluation.evaluate import HELD_OUT_SEED, evaluate_once
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.learning.config import PRESETS
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.tables import read_table
from guiderail.tools.visualization.style import colour, is_demonstrated, label

LEARNED = "learned"
BASELINES = ("zero", "uniform_random", "constant")  # evaluated together with a run's policy
STUDY_COLUMNS = {"method", "policy", "seed", "after_episodes", "eval_set", "episodes", "success_rate"}
NEEDED = (
    "success", "return", "steps", "max_commanded_violation", "max_measured_violation", "peak_force", "collisions",
    "fallback_steps",
)  # fmt: skip
PALETTE = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf")
STEP_LOG_COLUMNS = (
    "commanded_violation", "measured_violation", "contact_force", "collision", "saturation", "command_timed_out", "fallback",
)  # fmt: skip


@dataclass
class Run:
    """A run and its episodes."""

    path: Path
    config: RunConfig
    episodes: pd.DataFrame
    method: str = ""

    @property
    def safety(self) -> dict[str, Any]:
        """Counts and worst values of its control steps: from the step log, and without one from the episodes' table."""
        rows = self.episodes
        found: dict[str, Any] = {
            "source": "table",
            "episodes": len(rows),
            "steps": int(rows["steps"].sum()),
            "commands_outside": int((~(rows["max_commanded_violation"] <= TOLERANCE)).sum()),
            "worst_command": float(rows["max_commanded_violation"].max(skipna=False)),
            "poses_outside": int((~(rows["max_measured_violation"] <= TOLERANCE)).sum()),
            "worst_pose": float(rows["max_measured_violation"].max(skipna=False)),
            "peak_force": float(rows["peak_force"].max(skipna=False)),
            "collisions": int(rows["collisions"].sum()),
            "collision_steps": int(rows["collision_steps"].sum()) if "collision_steps" in rows else None,
            "saturated": int(rows["saturated_steps"].sum()) if "saturated_steps" in rows else None,
            "held": None,
            "fallback_steps": int(rows["fallback_steps"].sum()),
        }
        folder = RunFolder(self.path).steps
        if not folder.is_dir():
            return found
        steps = read_step_log(folder)
        steps = steps[steps["episode"] < len(rows)]  # what a killed run wrote beyond its table is not in it
        if steps["episode"].nunique() != len(rows) or not set(STEP_LOG_COLUMNS) <= set(steps.columns):
            return found
        return found | {
            "source": "step_log",
            "steps": len(steps),
            "commands_outside": int((~(steps["commanded_violation"] <= TOLERANCE)).sum()),
            "worst_command": float(steps["commanded_violation"].max(skipna=False)),
            "poses_outside": int((~(steps["measured_violation"] <= TOLERANCE)).sum()),
            "worst_pose": float(steps["measured_violation"].max(skipna=False)),
            "peak_force": float(steps["contact_force"].max(skipna=False)),
            "collision_steps": int(steps["collision"].sum()),
            "saturated": int((steps["saturation"] > 0).sum()),
            "held": int(steps["command_timed_out"].sum()),
            "fallback_steps": int(steps["fallback"].sum()),
        }


@dataclass
class Gathered:
    """All that a report is of.

    Attributes:
        name: what it is called.
        runs: those with at least an episode, by task and method.
        held_out: a row for every policy, seed, mark and what it was judged on, with the counts.
        study: whether it is a study's folder, and not runs by themselves.
        called: a name for each run's folder, no two alike.
    """

    name: str
    runs: list[Run] = field(default_factory=list)
    held_out: pd.DataFrame = field(default_factory=pd.DataFrame)
    study: bool = False
    called: list[str] = field(default_factory=list)

    @property
    def tasks(self) -> list[str]:
        """The tasks of its runs."""
        return list(dict.fromkeys(run.config.task for run in self.runs))

    def methods(self, task: str) -> dict[str, list[Run]]:
        """The runs of a task by method."""
        found: dict[str, list[Run]] = {}
        for run in self.runs:
            if run.config.task == task:
                found.setdefault(run.method, []).append(run)
        return found

    def colours(self, task: str) -> dict[str, str]:
        """A colour for each method: its guidance's own where no two methods have the same."""
        kinds = {name: str(runs[0].config.environment.get("guidance", "")) for name, runs in self.methods(task).items()}
        if len(set(kinds.values())) == len(kinds):
            return {name: colour(kind) for name, kind in kinds.items()}
        return {name: PALETTE[index % len(PALETTE)] for index, name in enumerate(kinds)}


def gather(paths: Sequence[Path], episodes: int = 0) -> Gathered:
    """Reads runs and folders of studies.

    Args:
        paths: folders of runs, or such that hold runs.
        episodes: held-out episodes to judge each run of `paths` on, beside null policies; what was judged before is
            used again, and none are run for 0.

    Raises:
        InputError: if a folder holds no run, or a file of it is damaged.
    """
    folders: list[Path] = []
    alone: list[Path] = []  # runs that are no part of a study
    held_out, tables = [], False
    for path in paths:
        if (path / "config.yaml").is_file():
            folders.append(path)
            alone.append(path.resolve())
            continue
        inside = sorted(file.parent for file in path.rglob("config.yaml")) if path.is_dir() else []
        studied = _study_tables(path) if path.is_dir() else []
        if not inside and not studied:
            raise InputError(f"{path} holds no run: give folders that guiderail train or guiderail study made")
        folders += inside
        alone += [] if studied else [folder.resolve() for folder in inside]
        held_out += studied
        tables = tables or bool(studied)
    read = {folder.resolve(): RunFolder(folder) for folder in folders}
    runs = [Run(one.path, one.config(), _episodes(one)) for one in read.values()]
    runs = [run for run in runs if len(run.episodes)]
    if not runs and not held_out:
        raise InputError(f"{paths[0]} has no finished episode yet: let it train, then report on it")
    _name_methods(runs)
    held_out += [_evaluated(run, episodes) for run in runs if run.path.resolve() in alone]
    name = paths[0].resolve().name if len(paths) == 1 else ", ".join(dict.fromkeys(run.config.task for run in runs))
    tables_of_rows = [table for table in held_out if len(table)]
    judged = pd.concat(tables_of_rows, ignore_index=True) if tables_of_rows else pd.DataFrame()
    return Gathered(name, runs, judged, study=tables, called=_names(runs))


def _names(runs: Sequence[Run]) -> list[str]:
    """The runs' folders' names, numbered where several have the same."""
    names = [run.path.resolve().name for run in runs]
    return [name if names.count(name) == 1 else f"{name}-{1 + names[:i].count(name)}" for i, name in enumerate(names)]


def _episodes(folder: RunFolder) -> pd.DataFrame:
    rows = folder.episodes() if (folder.path / "episodes.csv").is_file() else pd.DataFrame()
    if len(rows) and (missing := [name for name in NEEDED if name not in rows]):
        raise InputError(f"{folder.path} is of another version: its episodes have no {missing[0]}; train anew")
    return rows


def _study_tables(folder: Path) -> list[pd.DataFrame]:
    """What a study left: tables with a row for each method, seed, mark and what is judged on.

    Rows of a study's part that are in its whole table too are left out.
    """
    found: dict[str, pd.DataFrame] = {}
    for file in sorted(folder.glob("*.csv"), key=lambda one: (len(one.stem), one.stem)):
        table = read_table(file)
        if not set(table.columns) >= STUDY_COLUMNS:
            continue
        rows = _counted(table[(table["eval_set"] != "") & table["success_rate"].notna()].assign(study=file.stem))
        for name, whole in found.items():
            if file.stem.startswith(f"{name}-"):
                same = list(whole.columns.drop("study"))
                rows = rows[~rows[same].apply(tuple, axis=1).isin(set(whole[same].apply(tuple, axis=1)))]
        found[file.stem] = rows
    return [rows for rows in found.values() if len(rows)]


def _counted(rows: pd.DataFrame) -> pd.DataFrame:
    rows = rows[["study", "method", "policy", "seed", "after_episodes", "eval_set", "episodes", "success_rate"]].copy()
    rows["successes"] = (rows["success_rate"] * rows["episodes"]).round().astype(int)
    rows["episodes"] = rows["episodes"].astype(int)
    return rows.drop(columns="success_rate")


def _evaluated(run: Run, episodes: int) -> pd.DataFrame:
    """Return the counts of a run's stored held-out episodes, after evaluating `episodes` if there are not so many."""
    if episodes:
        _evaluate(run, episodes)
    counts: dict[str, dict[str, Any]] = {}
    run_columns = {"study": "", "method": run.method, "seed": run.config.seed, "after_episodes": len(run.episodes)}
    for name, rows in stored_episodes(RunFolder(run.path), run.config, HELD_OUT_SEED):
        policy = LEARNED if name == POLICY else name
        if policy not in counts or counts[policy]["episodes"] < len(rows):
            count = {"episodes": len(rows), "successes": int(rows["success"].sum())}
            counts[policy] = {**run_columns, "policy": policy, "eval_set": "held out", **count}
    return pd.DataFrame(list(counts.values()))


def _evaluate(run: Run, episodes: int) -> None:
    """Evaluate a run's policy and baseline policies on held-out episodes, unless they are stored in its folder."""
    folder, where = RunFolder(run.path), run.config.environment
    policy = Policy.load(run.path)
    how: dict[str, Any] = {"episodes": episodes, "seed": HELD_OUT_SEED}
    evaluate_once(
        run.path / POLICY_FOLDER, POLICY, run.config, lambda env: policy, where, about=policy_digest(folder), **how
    )
    is_demonstration = is_demonstrated(where.get("guidance"))
    for name in BASELINES:
        stored_name = "demonstration" if name == "zero" and is_demonstration else name
        make_policy = make_baseline(run.config.task, name, run.config.seed)
        evaluate_once(run.path / BASELINES_FOLDER, stored_name, run.config, make_policy, where, **how)


def _name_methods(runs: list[Run]) -> None:
    """Names each run's method by what it differs in from the other runs of its task, but for the seed."""
    for task in {run.config.task for run in runs}:
        own = [run for run in runs if run.config.task == task]
        settings = [flat(run.config) for run in own]
        keys = list(dict.fromkeys(key for one in settings for key in one))
        differing = [key for key in keys if len({repr(one.get(key)) for one in settings}) > 1]
        # Options that come with a guidance or an algorithm say nothing that its name doesn't.
        by_name = [key for key in ("guidance", "algorithm") if key in differing]
        named = {tuple(one.get(key) for key in by_name) for one in settings}
        all_of_them = {tuple(repr(one.get(key)) for key in differing) for one in settings}
        told = by_name if len(named) == len(all_of_them) else differing
        for run, one in zip(own, settings, strict=True):
            kind = str(one.get("guidance", ""))
            words = [label(kind) if key == "guidance" else _told(key, one.get(key)) for key in told]
            run.method = ", ".join(words) or (label(kind) if kind else run.config.task)


def _told(key: str, value: Any) -> str:
    return str(value).upper() if key == "algorithm" else f"{key.replace('_', ' ')} {value}"


def flat(config: RunConfig) -> dict[str, Any]:
    """The settings of a run by name, but for what says only how long and which one it is."""
    return {**config.environment, **asdict(config.learner)}


def command(config: RunConfig, out: str) -> str:
    """What a person types to train the same run again."""
    words = ["guiderail", "train", config.task]
    environment = dict(config.environment)
    if config.task in known_tasks():
        guidance = {key: environment[key] for key in ("guidance",) if key in environment}
        environment = guidance | beyond_defaults(config.task, environment)
    if "guidance" in environment:
        words += ["--guidance", str(environment.pop("guidance"))]
    words += ["--algorithm", config.learner.algorithm]
    words += [] if config.preset is None else ["--preset", config.preset]
    words += ["--episodes", str(config.episodes), "--seed", str(config.seed)]
    usual = asdict(PRESETS[config.preset]) if config.preset in PRESETS else {}
    for key, value in asdict(config.learner).items():
        if key != "algorithm" and usual.get(key) != value:
            text = ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
            words += ["--set", f"{key}={text}"]
    for key, value in environment.items():
        text = "[" + ", ".join(map(str, value)) + "]" if isinstance(value, list | tuple) else str(value)
        words += ["--env", f"{key}={'null' if value is None else text}"]
    for module in config.imports:
        words += ["--import", module]
    if not config.step_log:
        words.append("--no-step-log")
    return shlex.join([*words, "--out", out])


def finite(value: float | None) -> bool:
    """Whether there is a number to print."""
    return value is not None and bool(np.isfinite(value))
