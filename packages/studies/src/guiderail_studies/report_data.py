"""Data of a report: runs and studies, read from their folders."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.guidance.registry import is_demonstrated
from guiderail.diagrams.tasks.registry import known_tasks
from guiderail.models.common.arrays import as_numbers
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import beyond_defaults
from guiderail.tools.evaluation.baselines import make_baseline
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.evaluation.evaluate import evaluate_once, evaluate_trained
from guiderail.tools.evaluation.evaluation import BASELINES_FOLDER, POLICY, POLICY_FOLDER, episodes_file, policy_digest
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.step_log import read_step_log
from guiderail.tools.learning.learner_config import PRESETS
from guiderail.tools.learning.run_folder import RunConfig, RunFolder
from guiderail.tools.tables import read_table
from guiderail.tools.visualization.figures import color, label
from guiderail_studies.declaration import source_file

LEARNED = "learned"
BASELINES = ("zero", "uniform_random", "constant")  # baseline policies evaluated together with a run's policy
STUDY_COLUMNS = ("method", "policy", "seed", "after_episodes", "eval_set", "episodes", "success_rate")
MAX_COUNT = 1e12  # a study's table with this number of episodes or more is refused
REQUIRED_COLUMNS = (
    "success", "return", "steps", "max_commanded_violation", "max_measured_violation", "peak_force", "collisions",
    "fallback_steps",
)  # fmt: skip
PALETTE = ("#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#8c564b", "#e377c2", "#7f7f7f", "#bcbd22", "#17becf")
STEP_LOG_COLUMNS = (
    "commanded_violation", "measured_violation", "force", "collision", "saturation", "command_timed_out",
    "fallback",
)  # fmt: skip


def _extremes(rows: pd.DataFrame, prefix: str, force: str) -> dict[str, Any]:
    """Return the numbers and maxima of commanded and measured violations, and the peak force.

    Args:
        rows: Table of episodes or of control steps.
        prefix: Prefix of the columns of violations.
        force: Name of the column of forces.
    """
    result: dict[str, Any] = {}
    for kind in ("commanded", "measured"):
        values = rows[f"{prefix}{kind}_violation"]
        result[f"{kind}_violations"] = int((~(values <= TOLERANCE)).sum())  # NaN counts as a violation
        result[f"max_{kind}_violation"] = float(values.max(skipna=False))
    return result | {"peak_force": float(rows[force].max(skipna=False))}


@dataclass
class Run:
    """Run with its episodes."""

    path: Path  # folder of the run
    config: RunConfig  # configuration
    episodes: pd.DataFrame  # table of the training episodes
    method: str = ""  # name of the run's method in the report

    @property
    def safety(self) -> dict[str, Any]:
        """Safety statistics, from the step log if it is complete, otherwise from the table of episodes."""
        rows = self.episodes
        of_episodes: dict[str, Any] = {
            "source": "table",
            "episodes": len(rows),
            "steps": int(rows["steps"].sum()),
            **_extremes(rows, "max_", "peak_force"),
            "collisions": int(rows["collisions"].sum()),
            "collision_steps": int(rows["collision_steps"].sum()) if "collision_steps" in rows else None,
            "saturated_steps": int(rows["saturated_steps"].sum()) if "saturated_steps" in rows else None,
            "timed_out_steps": None,
            "fallback_steps": int(rows["fallback_steps"].sum()),
        }
        folder = RunFolder(self.path).steps
        if not folder.is_dir():
            return of_episodes
        steps = read_step_log(folder)
        steps = steps[steps["episode"] < len(rows)]  # a killed run may have logged more episodes than its table has
        if steps["episode"].nunique() != len(rows) or not set(STEP_LOG_COLUMNS) <= set(steps.columns):
            return of_episodes
        return of_episodes | {
            "source": "step_log",
            "steps": len(steps),
            **_extremes(steps, "", "force"),
            "collision_steps": int(steps["collision"].sum()),
            "saturated_steps": int((steps["saturation"] > 0).sum()),
            "timed_out_steps": int(steps["command_timed_out"].sum()),
            "fallback_steps": int(steps["fallback"].sum()),
        }


@dataclass
class ReportData:
    """Contents of a report."""

    name: str  # title
    runs: list[Run] = field(default_factory=list)  # runs with at least one episode
    # Counts of successes, a row for each method, policy, seed, checkpoint and evaluation set.
    held_out: pd.DataFrame = field(default_factory=pd.DataFrame)
    is_study: bool = False  # True if one of the folders contains a study's table
    folder_names: list[str] = field(default_factory=list)  # unique name of each run's folder

    @property
    def tasks(self) -> list[str]:
        """Tasks of the runs."""
        return list(dict.fromkeys(run.config.task for run in self.runs))

    def methods(self, task: str) -> dict[str, list[Run]]:
        """Return the runs of a task by method."""
        groups: dict[str, list[Run]] = {}
        for run in self.runs:
            if run.config.task == task:
                groups.setdefault(run.method, []).append(run)
        return groups

    def colors(self, task: str) -> dict[str, str]:
        """Return a color for each method: its guidance's color, or a palette's if two methods share a guidance."""
        kinds = {name: str(runs[0].config.environment.get("guidance", "")) for name, runs in self.methods(task).items()}
        if len(set(kinds.values())) == len(kinds):
            return {name: color(kind) for name, kind in kinds.items()}
        return {name: PALETTE[index % len(PALETTE)] for index, name in enumerate(kinds)}


def gather(paths: Sequence[Path], episodes: int = 0) -> ReportData:
    """Read runs and studies from their folders.

    A run is evaluated on `episodes` held-out episodes, together with baseline policies, if its own folder is given or
    if the given folder has runs but no study's table. If `episodes` is 0, only stored evaluations are read, and no code
    that the runs name is imported.

    Raises:
        InputError: If no folder is given, a folder contains neither a run nor a study's table, no run has a finished
            episode, or a file is damaged.
    """
    if not paths:
        raise InputError("a report needs at least one run or study: give their folders")
    folders: list[Path] = []
    single_runs: list[Path] = []  # runs that are not part of a study
    held_out, has_tables = [], False
    for path in paths:
        if (path / "config.yaml").is_file():
            folders.append(path)
            single_runs.append(path.resolve())
            continue
        run_paths = sorted(file.parent for file in path.rglob("config.yaml")) if path.is_dir() else []
        study_tables = _study_tables(path) if path.is_dir() else []
        if not run_paths and not study_tables:
            raise InputError(f"{path} holds no run: give folders that guiderail train or guiderail study made")
        folders += run_paths
        single_runs += [] if study_tables else [folder.resolve() for folder in run_paths]
        held_out += study_tables
        has_tables = has_tables or bool(study_tables)
    run_folders = {folder.resolve(): RunFolder(folder) for folder in folders}
    runs_code = episodes > 0
    runs = [Run(folder.path, folder.config(runs_code=runs_code), _episodes(folder)) for folder in run_folders.values()]
    runs = [run for run in runs if len(run.episodes)]
    if not runs and not held_out:
        raise InputError(f"{paths[0]} has no finished episode yet: let it train, then report on it")
    _name_methods(runs)
    held_out += [_evaluated(run, episodes) for run in runs if run.path.resolve() in single_runs]
    name = paths[0].resolve().name if len(paths) == 1 else ", ".join(dict.fromkeys(run.config.task for run in runs))
    tables = [table for table in held_out if len(table)]
    counts = pd.concat(tables, ignore_index=True) if tables else pd.DataFrame()
    return ReportData(name, runs, counts, is_study=has_tables, folder_names=_folder_names(runs))


def _folder_names(runs: Sequence[Run]) -> list[str]:
    """Return the names of the runs' folders, numbered if several are the same."""
    names = [run.path.resolve().name for run in runs]
    return [name if names.count(name) == 1 else f"{name}-{1 + names[:i].count(name)}" for i, name in enumerate(names)]


def _episodes(folder: RunFolder) -> pd.DataFrame:
    """Return the training episodes of a run, empty without a table.

    Raises:
        InputError: If a column is missing, or the table of a finished run lost rows.
    """
    table = folder.path / "episodes.csv"
    rows = folder.episodes() if table.is_file() else pd.DataFrame()
    if (folder.path / "policy.json").exists() and len(rows) < (saved := folder.num_saved_episodes()):
        raise InputError(
            f"{table} has {len(rows)} of the {saved} episodes of its checkpoint: resume the run, which writes it again"
        )
    if len(rows) and (missing := [name for name in REQUIRED_COLUMNS if name not in rows]):
        raise InputError(f"{folder.path} is of another version: its episodes have no {missing[0]}; train again")
    return rows


def _study_tables(folder: Path) -> list[pd.DataFrame]:
    """Return the tables of a study, with a row for each method, seed, checkpoint and evaluation set.

    Rows of a partial study's table that are also in the table of the whole study are left out. Other files are ignored.

    Raises:
        InputError: If a table of a study is damaged.
    """
    tables: dict[str, pd.DataFrame] = {}
    for file in sorted(folder.glob("*.csv"), key=lambda path: (len(path.stem), path.stem)):
        if file.is_file() and not {*STUDY_COLUMNS} <= {*_read_columns(file)}:
            continue
        table = read_table(file)
        studies = _studies_of(file.stem, table)
        part_of = next((name for name in studies if name in tables), next(iter(studies), ""))
        evaluated = table[(table["eval_set"] != "") & table["success_rate"].notna()]
        of_study = {"study": file.stem, "part_of": part_of, "source": _source(folder, part_of or file.stem)}
        rows = _success_counts(evaluated.assign(**of_study), file)
        for name, whole in tables.items():
            if name in studies:
                same = list(whole.columns.drop(list(of_study)))
                rows = rows[~rows[same].apply(tuple, axis=1).isin(set(whole[same].apply(tuple, axis=1)))]
        tables[file.stem] = rows
    return [rows for rows in tables.values() if len(rows)]


def _source(folder: Path, study: str) -> str:
    """Return the arguments of `guiderail study` for a study: its file, and the option that its imports need."""
    with suppress(OSError, ValueError, KeyError, TypeError):
        source = json.loads(source_file(folder, study).read_bytes())
        return shlex.quote(str(source["file"])) + " --trust-imports" * bool(source["imports"])
    return f"{study}.yaml"


def _studies_of(name: str, table: pd.DataFrame) -> list[str]:
    """Return the possible names of the whole study if the table `name` is a part of a study.

    A part is named after the whole study, followed by all methods of the table, its seeds, or both, joined by dashes
    (`Study.subset_name`). Methods that declare seeds of their own are ignored for the seeds in the name. The list is
    empty if no such suffix matches.
    """
    seeds = {
        str(method): [*dict.fromkeys(map(str, rows["seed"]))] for method, rows in table.groupby("method", sort=False)
    }
    suffixes = [[*seeds, *chosen] for chosen in seeds.values()] + [[*seeds]] + [*seeds.values()]
    texts = dict.fromkeys("".join(f"-{word}" for word in words) for words in suffixes)
    return [name.removesuffix(text) for text in texts if name.endswith(text) and name != text]


def _success_counts(rows: pd.DataFrame, file: Path) -> pd.DataFrame:
    """Return the rows of a study's table with the number of successes instead of the success rate."""
    rows = rows[["study", "part_of", "source", *STUDY_COLUMNS]].copy()
    episodes, rates = (as_numbers(rows[name], f"{name} in {file}") for name in ("episodes", "success_rate"))
    is_wrong = ~(
        (episodes >= 1) & (episodes < MAX_COUNT) & (episodes == np.rint(episodes)) & (rates >= 0) & (rates <= 1)
    )
    if is_wrong.any():
        first = int(is_wrong.argmax())
        raise InputError(
            f"{file} is damaged: episodes are whole numbers from 1 on and below {MAX_COUNT:g}, and success_rate is "
            f"from 0 to 1, not {episodes[first]:g} and {rates[first]:g}; restore it, or run the study again"
        )
    rows["successes"] = (rows["success_rate"] * rows["episodes"]).round().astype(int)
    rows["episodes"] = rows["episodes"].astype(int)
    return rows.drop(columns="success_rate")


def _evaluated(run: Run, episodes: int) -> pd.DataFrame:
    """Return the counts of a run's stored held-out episodes; if `episodes` is not 0, first evaluate missing ones."""
    if episodes:
        environment = run.config.environment
        evaluate_trained(RunFolder(run.path), run.config, episodes)
        evaluation: dict[str, Any] = {"episodes": episodes, "seed": HELD_OUT_SEED, "processes": None}
        is_demonstration = is_demonstrated(environment.get("guidance"))
        for name in BASELINES:
            stored_name = "demonstration" if name == "zero" and is_demonstration else name
            make_policy = make_baseline(run.config.task, name, run.config.seed)
            evaluate_once(run.path / BASELINES_FOLDER, stored_name, run.config, make_policy, environment, **evaluation)
    counts: dict[str, dict[str, Any]] = {}
    names = {"study": "", "part_of": "", "source": "", "method": run.method}
    run_columns = {**names, "seed": run.config.seed, "after_episodes": len(run.episodes)}
    for name, rows in _stored_episodes(RunFolder(run.path), run.config, HELD_OUT_SEED):
        policy = LEARNED if name == POLICY else name
        if policy not in counts or counts[policy]["episodes"] < len(rows):
            count = {"episodes": len(rows), "successes": int(rows["success"].sum())}
            counts[policy] = {**run_columns, "policy": policy, "eval_set": "held out", **count}
    return pd.DataFrame(list(counts.values()))


def _name_methods(runs: list[Run]) -> None:
    """Name each run's method after the settings in which it differs from the other runs of its task."""
    for task in {run.config.task for run in runs}:
        task_runs = [run for run in runs if run.config.task == task]
        settings = [flat(run.config) for run in task_runs]
        _name_sources(task_runs, settings)
        keys = list(dict.fromkeys(key for options in settings for key in options))
        differing = [key for key in keys if len({repr(options.get(key)) for options in settings}) > 1]
        # The name of a guidance or an algorithm implies its options.
        by_name = [key for key in ("guidance", "algorithm") if key in differing]
        names = {tuple(options.get(key) for key in by_name) for options in settings}
        methods = {tuple(repr(options.get(key)) for key in differing) for options in settings}
        chosen = by_name if len(names) == len(methods) else differing
        for run, options in zip(task_runs, settings, strict=True):
            kind = str(options.get("guidance", ""))
            words = [label(kind) if key == "guidance" else _format_setting(key, options.get(key)) for key in chosen]
            run.method = ", ".join(words) or (label(kind) if kind else run.config.task)


def _name_sources(runs: Sequence[Run], settings: Sequence[dict[str, Any]]) -> None:
    """Replace `init_from` by a path relative to the folder of the runs, with {seed} in place of the run's own seed."""
    paths = {
        number: os.path.relpath(options["init_from"], run.path.resolve().parent)
        for number, (run, options) in enumerate(zip(runs, settings, strict=True))
        if options.get("init_from")
    }
    for number, path in paths.items():
        seed = runs[number].config.seed
        if {runs[other].config.seed for other, same in paths.items() if same == path} == {seed}:
            path = re.sub(rf"(?<!\d){seed}(?!\d)", "{seed}", path)
        settings[number]["init_from"] = path


def _format_setting(key: str, value: Any) -> str:
    return str(value).upper() if key == "algorithm" else f"{key.replace('_', ' ')} {value}"


def flat(config: RunConfig) -> dict[str, Any]:
    """Return the settings of a run by name, without its number of episodes and its seed."""
    return {**config.environment, **asdict(config.learner)}


def command(config: RunConfig, out: str) -> str:
    """Return the command that trains the same run again into the folder `out`."""
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
    of_preset = asdict(PRESETS[config.preset]) if config.preset in PRESETS else {}
    for key, value in asdict(config.learner).items():
        if key != "algorithm" and of_preset.get(key) != value:
            text = ",".join(map(str, value)) if isinstance(value, list | tuple) else str(value)
            words += ["--set", f"{key}={text}"]
    for key, value in environment.items():
        text = "[" + ", ".join(map(str, value)) + "]" if isinstance(value, list | tuple) else str(value)
        words += ["--env", f"{key}={'null' if value is None else text}"]
    for module in config.imports:
        words += ["--import", module]
    if not config.step_log:
        words.append("--no-step-log")
    if config.human_in_the_loop:
        words.append("--human-in-the-loop")
    return shlex.join([*words, "--out", out])


_MAX_HEADER = 100_000  # largest number of characters of a header


def _read_columns(path: Path) -> list[str]:
    """Return the names in the first line of a CSV file; none if that line is empty, or not CSV in UTF-8."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return next(csv.reader([file.readline(_MAX_HEADER)], strict=True), [])
    except (UnicodeError, csv.Error):
        return []
    except OSError as error:
        raise InputError(f"the table '{path}' can't be read ({error.strerror}): check the path") from error


def _stored_episodes(folder: RunFolder, config: RunConfig, seed: int) -> Iterator[tuple[str, pd.DataFrame]]:
    """Yield the name of each policy and its stored episodes in the run's own environment, with `seed` as first seed."""
    digest = policy_digest(folder.path)
    for file in sorted(
        path for part in (POLICY_FOLDER, BASELINES_FOLDER) for path in (folder.path / part).glob("*.csv")
    ):
        name, rows = file.stem.rpartition("-")[0], read_table(file)
        kwargs = {"episodes": len(rows), "seed": seed}
        # `about` of a baseline policy is None if it was given by name, and its name if it was given as a function.
        abouts = (digest,) if file.parent.name == POLICY_FOLDER else (None, name)
        try:
            files = [episodes_file(file.parent, name, config, config.environment, about=a, **kwargs) for a in abouts]
        except InputError:  # the name is not that of a policy: a file of another program
            continue
        if file in files:
            yield name, rows
