"""Report of runs and studies as one self-contained page, with its figures."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from html import escape
from itertools import cycle
from pathlib import Path
from typing import Any

import jinja2
import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from guiderail.models.common.arrays import as_whole
from guiderail.tools.evaluation.metrics import (
    TOLERANCE,
    VIOLATION,
    episodes_to_convergence,
    wilson,
)
from guiderail.tools.files import check_page, write_atomically
from guiderail.tools.tables import cell
from guiderail.tools.visualization.figures import WINDOW, legend_above, new_figure, rolling
from guiderail_studies.report_data import LEARNED, ReportData, Run, command, flat, gather
from guiderail_studies.run_statistics import bootstrap_band, interquartile_mean, median_survival, survival

PAGE = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    Path(__file__).with_name("report.html").read_text(encoding="utf-8")
)
UNCONSTRAINED = -1e20  # a violation below this value means that there is no constraint


@dataclass(frozen=True)
class Cell:
    """Cell of a table."""

    text: str  # content
    mark: str = ""  # CSS class: "good", "bad", "long" or none


@dataclass(frozen=True)
class Row:
    """Row of a table; `is_baseline` is True if the row's policy was not learned."""

    cells: Sequence[Cell]
    is_baseline: bool = False


@dataclass(frozen=True)
class Table:
    """Table of the page."""

    columns: Sequence[str]
    rows: Sequence[Row]


def write_report(paths: Sequence[Path], out: Path, *, episodes: int = 0) -> Path:
    """Write the report of runs and studies as an HTML file.

    Runs are evaluated on `episodes` held-out episodes; see `gather`.

    Raises:
        InputError: As `gather`, or if `episodes` is negative or `out` is not an HTML file that can be written.
    """
    as_whole(episodes, "the number of episodes of an evaluation", 0)
    check_page(out)
    data = gather(paths, episodes)
    write_atomically(out, render(data).encode())
    return out


def render(data: ReportData) -> str:
    """Return the text of the page."""
    runs, tasks = data.runs, data.tasks
    seeds = len({run.config.seed for run in runs})
    episodes = _count(sum(len(run.episodes) for run in runs), "training episode")
    commands, commands_of_runs = _commands(data)
    has_held_out = len(data.held_out) > 0
    if runs:
        lead = f"{', '.join(tasks)}: {_count(len(runs), 'run')}, {_count(seeds, 'seed')}, {episodes}."
    elif has_held_out and (data.held_out["policy"] == LEARNED).any():
        lead = "Tables of studies, without their runs."
    else:
        lead = "Baseline policies."
    return PAGE.render(
        title=data.name,
        lead=lead,
        held_out={"table": _held_out(data), "figure": _held_out_figure(data)} if has_held_out else None,
        tasks=[_task(data, task) for task in tasks],
        tolerance=f"{TOLERANCE:g}",
        commands=commands,
        runs=commands_of_runs,
        versions=_versions(runs),
    )


def _task(data: ReportData, task: str) -> dict[str, Any]:
    methods = data.methods(task)
    curves = {"success": "success rate", "return": "return"}
    if any((run.episodes["peak_force"] > 0).any() for runs in methods.values() for run in runs):
        curves["mean_squared_force"] = "mean squared force [N²]"
    figures = [
        _curve(data, task, name, label)
        for name, label in curves.items()
        if all(name in run.episodes for run in data.runs)
    ]
    figures.insert(2, _survival_curve(data, task))
    safety = {name: [run.safety for run in runs] for name, runs in methods.items()}
    differing, common = _configuration(methods)
    return {
        "name": task,
        "figures": figures,
        "few": "" if all(len(runs) > 1 for runs in methods.values()) else "; one seed has no band",
        "seeds": _seeds(methods),
        "safety": _safety(safety),
        "source": _source(safety),
        "differing": differing,
        "common": common,
    }


def _held_out(data: ReportData) -> Table:
    rows, counts = [], data.held_out
    has_studies = counts["study"].nunique() > 1
    for (study, method, policy, after_episodes, eval_set), group in counts.groupby(
        ["study", "method", "policy", "after_episodes", "eval_set"], sort=False
    ):
        successes, episodes = int(group["successes"].sum()), int(group["episodes"].sum())
        of_seeds = ", ".join(
            "{}/{} ({:.1%} to {:.1%})".format(*counted, *wilson(*counted))
            for counted in zip(group["successes"], group["episodes"], strict=True)
        )
        is_learned = policy == LEARNED
        name = str(method) if is_learned or str(method) == str(policy) else f"{method}: {policy}"
        cells = [f"{study}: {name}" if has_studies else name]
        cells += [str(after_episodes) if is_learned and after_episodes else "–", str(eval_set)]
        cells += [f"{successes}/{episodes}", f"{successes / episodes:.1%}"]
        rows.append(Row([*map(Cell, cells), Cell(of_seeds, "long")], is_baseline=not is_learned))
    columns = ["policy", "after episodes", "evaluation set", "successes", "rate", "each seed (95 % interval)"]
    return Table(columns, rows)


def _seeds(methods: dict[str, list[Run]]) -> Table:
    columns = {"return": "return, last ten", "success": "success, last ten", "steps": "control steps, last ten"}
    rows = []
    for name, runs in methods.items():
        after = [episodes_to_convergence(run.episodes) for run in runs]
        median = median_survival(*survival(after, [len(run.episodes) for run in runs]))
        never = sum(number is None for number in after)
        cells = [name, str(len(runs)), "never" if median is None else f"{median:g}", f"{never} of {len(runs)}"]
        for column in columns:
            mean, interval = interquartile_mean([float(run.episodes[column].tail(10).mean()) for run in runs])
            cells.append(f"{mean:.4g}" if interval is None else f"{mean:.4g} ({interval[0]:.4g} to {interval[1]:.4g})")
        rows.append(Row([Cell(text) for text in cells]))
    return Table(["method", "seeds", "episodes to convergence", "never converged", *columns.values()], rows)


SAFETY_COLUMNS = {
    "commanded_violations": "commanded violations",
    "max_commanded_violation": f"largest commanded violation [{VIOLATION}]",
    "measured_violations": "measured violations",
    "max_measured_violation": f"largest measured violation [{VIOLATION}]",
    "peak_force": "peak force [N]",
    "collisions": "collisions",
    "collision_steps": "steps in collision",
    "saturated_steps": "saturated steps",
    "timed_out_steps": "steps with timed-out command",
    "fallback_steps": "fallback steps",
}
"""Statistics of the safety table and their headings."""
LARGEST = ("max_commanded_violation", "max_measured_violation", "peak_force")  # maxima; the others are counts
MUST_BE_ZERO = ("commanded_violations", "collisions", "collision_steps", "timed_out_steps")


def _safety(safety: dict[str, list[dict[str, Any]]]) -> Table:
    rows = []
    for name, runs in safety.items():
        cells = [Cell(name), *(Cell(f"{sum(run[key] for run in runs):,}") for key in ("episodes", "steps"))]
        for key in SAFETY_COLUMNS:
            values = [run[key] for run in runs if run[key] is not None]
            if not values:
                cells.append(Cell("–"))
            elif key in LARGEST:
                cells.append(_largest(float(np.max(values)), key))
            else:
                is_bad = key in MUST_BE_ZERO and sum(values) > 0
                cells.append(Cell(f"{sum(values):,}", "bad" if is_bad else "good" if key in MUST_BE_ZERO else ""))
        rows.append(Row(cells))
    return Table(["method", "episodes", "control steps", *SAFETY_COLUMNS.values()], rows)


def _largest(value: float, key: str) -> Cell:
    if not np.isfinite(value) or value < UNCONSTRAINED:
        return Cell("–" if value < 0 else "not finite", "" if value < 0 else "bad")
    return Cell(f"{value:.3g}", "bad" if key == "max_commanded_violation" and value > TOLERANCE else "")


def _source(safety: dict[str, list[dict[str, Any]]]) -> str:
    sources = {run["source"] for runs in safety.values() for run in runs}
    if sources == {"step_log"}:
        return "Counted in control steps, from the step logs of the runs."
    if sources == {"table"}:
        return "From the tables of episodes, without complete step logs: violations are counted in episodes."
    return "From complete step logs; for other runs, from the tables of episodes, where violations count episodes."


def _configuration(methods: dict[str, list[Run]]) -> tuple[Table | None, Table]:
    """Return a table of settings that differ between methods (None if all agree) and a table of common settings."""
    settings = {name: _settings(runs) for name, runs in methods.items()}
    keys = list(dict.fromkeys(key for options in settings.values() for key in options))
    values = {key: [options.get(key, "–") for options in settings.values()] for key in keys}
    common = [key for key in keys if len(set(values[key])) == 1]
    rows = [Row([Cell(key.replace("_", " ")), *map(Cell, values[key])]) for key in keys if key not in common]
    differing = Table(["", *settings], rows) if rows else None
    return differing, Table(["", ""], [Row([Cell(key.replace("_", " ")), Cell(values[key][0])]) for key in common])


def _settings(runs: Sequence[Run]) -> dict[str, str]:
    """Return every setting of a method's runs as text; if the seeds have different values, all values are listed."""
    settings = [
        {**flat(run.config), "preset": run.config.preset, "episodes": len(run.episodes), "seeds": run.config.seed}
        for run in runs
    ]
    return {key: _join(cell(options.get(key)) for options in settings) for key in settings[0]}


def _join(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))


def _versions(runs: Sequence[Run]) -> Table | None:
    if not runs:
        return None
    names = dict.fromkeys(name for run in runs for name in run.config.versions)
    versions = {name: _join(run.config.versions.get(name, "–") for run in runs) for name in names}
    return Table(["", ""], [Row([Cell(name), Cell(version)]) for name, version in versions.items()])


def _commands(data: ReportData) -> tuple[list[str], list[str]]:
    """Return the commands that reproduce the report, and for a study, the commands of its individual runs."""
    of_runs = [command(run.config, f"runs/{name}") for run, name in zip(data.runs, data.folder_names, strict=True)]
    return (_study_commands(data.held_out), of_runs) if data.is_study else (of_runs, [])


def _study_commands(counts: pd.DataFrame) -> list[str]:
    """Return the commands that reproduce the studies of a table."""
    commands = []
    for name in filter(None, dict.fromkeys(counts["study"]) if len(counts) else ()):  # not of single runs
        rows = counts[counts["study"] == name]
        methods, seeds = ([str(value) for value in dict.fromkeys(rows[column])] for column in ("method", "seed"))
        part_of, source = (str(rows[column].iloc[0]) for column in ("part_of", "source"))
        part = f" --methods {','.join(methods)} --seeds {','.join(seeds)}" if part_of else ""
        commands.append(f"guiderail study {source}{part} --out studies")
    return commands


def _count(number: int, noun: str) -> str:
    return f"{number:,} {noun}{'' if number == 1 else 's'}"


# Figures, as SVG elements of the page.

SIZE = (4.6, 3.0)  # size of a figure [in]; two fit side by side on a wide screen
STYLE: Any = {"svg.fonttype": "none", "svg.hashsalt": "guiderail", "font.size": 9.0}
DASHES = ("-", (0, (5, 1.5)), (0, (2, 1)), (0, (6, 1.5, 1, 1.5)))  # line styles that distinguish coinciding curves


def _curve(data: ReportData, task: str, column: str, label: str) -> str:
    """Return the curve of a column over the training episodes: the mean over seeds and its bootstrap band."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, SIZE)
        axis = axes[0, 0]
        colors = data.colors(task)
        for (name, runs), dash in zip(data.methods(task).items(), cycle(DASHES), strict=False):
            values = [run.episodes[column].to_numpy(float) for run in runs]
            shade, text = colors[name], _label(name, runs)
            draw_runs(axis, values, color=shade, label=text, band=bootstrap_band, linestyle=dash)
        axis.set(xlabel="training episode", ylabel=f"{label}, mean of {WINDOW}")
        if column == "success":
            axis.set_ylim(-0.04, 1.04)
        legend_above(axis, columns=2)
        return to_svg(figure, f"{label} over the training episodes of {task}")


def _survival_curve(data: ReportData, task: str) -> str:
    """Return the Kaplan-Meier curve: fraction of runs not yet converged, over the training episodes."""
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, SIZE)
        axis = axes[0, 0]
        colors = data.colors(task)
        for (name, runs), dash in zip(data.methods(task).items(), cycle(DASHES), strict=False):
            after = [episodes_to_convergence(run.episodes) for run in runs]
            lengths = [len(run.episodes) for run in runs]
            steps, left = survival(after, lengths)
            steps, left = np.append(steps, max(lengths)), np.append(left, left[-1])
            axis.step(steps, left, where="post", color=colors[name], linestyle=dash, label=_label(name, runs))
            if None in after:
                axis.plot(steps[-1], left[-1], "|", color=colors[name], markersize=9)
        axis.set(xlabel="training episodes", ylabel="fraction not converged", ylim=(-0.04, 1.04))
        axis.set_xlim(left=0)
        legend_above(axis, columns=2)
        return to_svg(figure, f"fraction of the runs of {task} that have not converged, over the training episodes")


def _held_out_figure(data: ReportData) -> str:
    """Return the held-out success at each seed's last checkpoint, with Wilson intervals; baseline policies are gray."""
    rows, keys = data.held_out, ["study", "method", "policy", "seed", "eval_set"]
    rows = rows[rows["after_episodes"] == rows.groupby(keys)["after_episodes"].transform("max")]
    groups = list(rows.groupby(["study", "method", "policy", "eval_set"], sort=False))
    has_studies, has_eval_sets = rows["study"].nunique() > 1, rows["eval_set"].nunique() > 1
    with matplotlib.rc_context(STYLE):
        figure, axes = new_figure(1, 1, (1.35 * SIZE[0], 0.6 + 0.13 * len(rows) + 0.2 * len(groups)))
        axis, place, ticks = axes[0, 0], 0.0, []
        for (study, method, policy, eval_set), group in groups:
            first = place
            for row in group.itertuples():
                low, high = wilson(row.successes, row.episodes)
                shade = "#1f77b4" if policy == LEARNED else "0.6"
                axis.plot([low, high], [place, place], color=shade, linewidth=2, alpha=0.55, solid_capstyle="butt")
                axis.plot(row.successes / row.episodes, place, "o", color=shade, markersize=4)
                place -= 1.0
            parts = [str(method), *([] if policy == LEARNED else [str(policy)])]
            parts += [str(study)] * has_studies + [str(eval_set)] * has_eval_sets
            ticks.append((0.5 * (first + place + 1.0), ", ".join(dict.fromkeys(parts))))
            place -= 1.5
        axis.set_yticks([at for at, _ in ticks], [text for _, text in ticks])
        axis.set(
            xlim=(-0.02, 1.02),
            ylim=(place + 1.5, 1.0),
            xlabel="success on held-out episodes, each seed with its 95 % interval",
        )
        axis.grid(axis="x", color="0.9")
        axis.set_axisbelow(True)
        return to_svg(figure, "success on held-out episodes, each seed with its Wilson interval")


def _label(name: str, runs: list[Run]) -> str:
    return f"{name} ({_count(len(runs), 'seed')})"


def to_svg(figure: Any, description: str) -> str:
    """Return a figure as an SVG element, whose aspect ratio does not depend on its width."""
    content = io.StringIO()
    figure.savefig(content, format="svg", metadata={"Date": None, "Creator": None})
    text = content.getvalue()
    text = text[text.index("<svg") :]
    return text.replace("<svg ", f'<svg role="img" aria-label="{escape(description)}" ', 1)


def draw_runs(
    axis: Axes,
    runs: Sequence[Sequence[float] | np.ndarray],
    *,
    window: int = WINDOW,
    band: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] = lambda values: (values.min(0), values.max(0)),
    **line: Any,
) -> None:
    """Draw the learning curve of a method: the mean over runs of a moving mean, and a band.

    Args:
        axis: Axes.
        runs: Values over the episodes of each run, at least one run; longer runs are cut to the shortest.
        window: Episodes of the moving mean.
        band: Function from smoothed values (runs, n) to the lower and upper end of the band, (n,) each; by default the
            range of the runs.
        line: Arguments of the line, such as `color`, which the band has too, and `label`.
    """
    length = min(len(run) for run in runs)
    smooth = np.stack([rolling(run, window)[:length] for run in runs])
    episodes = np.arange(1, length + 1)
    if len(runs) > 1:
        axis.fill_between(episodes, *band(smooth), color=line.get("color"), alpha=0.15, linewidth=0)
    axis.plot(episodes, smooth.mean(axis=0), **line)
