"""`guiderail report`: what runs and studies came to, as one page that needs nothing else."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.metrics import (
    TOLERANCE,
    episodes_to_convergence,
    interquartile_mean,
    median_survival,
    survival,
    wilson_of_each,
)
from guiderail.tools.files import check_page, write_atomically
from guiderail.tools.tables import cell
from guiderail.tools.visualization import report_figures as figures
from guiderail.tools.visualization.report_data import LEARNED, Gathered, Run, command, finite, flat, gather
from research.thesis import describe_differences

PAGE = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    Path(__file__).with_name("report.html").read_text(encoding="utf-8")
)
UNBOUNDED = -1e20  # below it there is no constraint


@dataclass(frozen=True)
class Cell:
    """What stands in a table, and whether it is good or bad."""

    text: str
    mark: str = ""


@dataclass(frozen=True)
class Row:
    """Of a table; `null` where nothing was learned."""

    cells: Sequence[Cell]
    null: bool = False


@dataclass(frozen=True)
class Table:
    """Of the page."""

    columns: Sequence[str]
    rows: Sequence[Row]


def write_report(paths: Sequence[Path], out: Path, *, episodes: int = 0) -> Path:
    """Writes the page of runs and studies.

    Args:
        paths: folders that `guiderail train` or `guiderail study` made.
        out: the page, .html.
        episodes: held-out episodes to judge runs on that no study judged; none for 0.

    Raises:
        InputError: if there is nothing to report on, or `out` is no page.
    """
    if episodes < 0:
        raise InputError(f"runs are judged on a number of episodes from 0, not {episodes}")
    check_page(out)
    gathered = gather(paths, episodes)
    write_atomically(out, page(gathered, paths).encode())
    return out


def page(gathered: Gathered, paths: Sequence[Path]) -> str:
    """The page's text."""
    runs, tasks = gathered.runs, gathered.tasks
    seeds = len({run.config.seed for run in runs})
    episodes = _count(sum(len(run.episodes) for run in runs), "training episode")
    lead = f"{_count(len(runs), 'run')}, {_count(seeds, 'seed')}, {episodes}"
    commands, every = _commands(gathered, paths)
    return PAGE.render(
        title=gathered.name,
        lead=f"{', '.join(tasks)}: {lead}." if runs else _lead(gathered),
        held_out={"table": _held_out(gathered), "figure": figures.held_out(gathered)}
        if len(gathered.held_out)
        else None,
        tasks=[_task(gathered, task) for task in tasks],
        tolerance=f"{TOLERANCE:g}",
        commands=commands,
        runs=every,
        versions=_versions(runs),
    )


def _task(gathered: Gathered, task: str) -> dict[str, Any]:
    methods = gathered.methods(task)
    terms = [
        ("success", "success rate"), ("return", "return"), ("mean_squared_force", "mean squared force [N²]"),
    ]  # fmt: skip
    known = [(name, words) for name, words in terms if all(name in run.episodes for run in gathered.runs)]
    touched = any((run.episodes["peak_force"] > 0).any() for runs in methods.values() for run in runs)
    known = [one for one in known if touched or one[0] != "mean_squared_force"]
    drawn = [figures.curve(gathered, task, name, words) for name, words in known]
    drawn.insert(2, figures.survival_curve(gathered, task))
    safety = {name: [run.safety for run in runs] for name, runs in methods.items()}
    differing, common = _configuration(methods)
    return {
        "name": task,
        "figures": drawn,
        "few": "" if all(len(runs) > 1 for runs in methods.values()) else "; one seed has no band",
        "seeds": _seeds(methods),
        "safety": _safety(safety),
        "source": _source(safety),
        "differences": _differences(methods),
        "differing": differing,
        "common": common,
    }


def _held_out(gathered: Gathered) -> Table:
    rows, judged = [], gathered.held_out
    several = judged["study"].nunique() > 1
    for (study, method, policy, mark, where), group in judged.groupby(
        ["study", "method", "policy", "after_episodes", "eval_set"], sort=False
    ):
        successes, episodes = int(group["successes"].sum()), int(group["episodes"].sum())
        intervals = wilson_of_each(group["successes"], group["episodes"])
        counts = [f"{row.successes}/{row.episodes}" for row in group.itertuples()]
        told = [f"{low:.1%} to {high:.1%}" for low, high in intervals]
        each = ", ".join(f"{count} ({interval})" for count, interval in zip(counts, told, strict=True))
        learned = policy == LEARNED
        name = str(method) if learned or str(method) == str(policy) else f"{method}: {policy}"
        name = f"{study}: {name}" if several else name
        cells = [name, str(mark) if learned and mark else "–", str(where), f"{successes}/{episodes}"]
        cells += [f"{successes / episodes:.1%}", each]
        rows.append(Row([*map(Cell, cells[:-1]), Cell(cells[-1], "long")], null=not learned))
    return Table(["who acts", "after episodes", "judged on", "successes", "rate", "each seed, and its 95 %"], rows)


def _seeds(methods: dict[str, list[Run]]) -> Table:
    names = {"return": "return, last ten", "success": "success, last ten", "steps": "control steps, last ten"}
    rows = []
    for name, runs in methods.items():
        after, lengths = [episodes_to_convergence(run.episodes) for run in runs], [len(run.episodes) for run in runs]
        median = median_survival(*survival(after, lengths))
        never = sum(one is None for one in after)
        cells = [name, str(len(runs)), "never" if median is None else f"{median:g}", f"{never} of {len(runs)}"]
        for column in names:
            mean, interval = interquartile_mean([float(run.episodes[column].tail(10).mean()) for run in runs])
            cells.append(f"{mean:.4g}" if interval is None else f"{mean:.4g} ({interval[0]:.4g} to {interval[1]:.4g})")
        rows.append(Row([Cell(text) for text in cells]))
    return Table(["method", "seeds", "episodes to convergence", "never converged", *names.values()], rows)


def _safety(safety: dict[str, list[dict[str, Any]]]) -> Table:
    counted = {
        "commands_outside": "commands outside", "poses_outside": "poses outside", "collisions": "collisions",
        "collision_steps": "steps in collision", "saturated": "steps saturated", "held": "held by watchdog",
        "fallback_steps": "fallback_steps",
    }  # fmt: skip
    worst = {"worst_command": "worst command", "worst_pose": "worst pose", "peak_force": "peak force [N]"}
    bad = {"commands_outside", "collisions", "collision_steps", "held"}
    rows = []
    for name, found in safety.items():
        cells = [Cell(name), *(Cell(f"{sum(one[key] for one in found):,}") for key in ("episodes", "steps"))]
        for key in (
            "commands_outside",
            "worst_command",
            "poses_outside",
            "worst_pose",
            "peak_force",
            *list(counted)[2:],
        ):
            values = [one[key] for one in found if one[key] is not None]
            if not values:
                cells.append(Cell("–"))
            elif key in worst:
                cells.append(_worst(max(values), key))
            else:
                total = sum(values)
                cells.append(Cell(f"{total:,}", "bad" if total and key in bad else "good" if key in bad else ""))
        rows.append(Row(cells))
    order = [
        "commands outside",
        "worst command",
        "poses outside",
        "worst pose",
        "peak force [N]",
        *list(counted.values())[2:],
    ]
    return Table(["method", "episodes", "control steps", *order], rows)


def _worst(value: float, key: str) -> Cell:
    if not finite(value) or value < UNBOUNDED:
        return Cell("–" if value < 0 else "not finite", "" if value < 0 else "bad")
    return Cell(f"{value:.3g}", "bad" if key == "worst_command" and value > TOLERANCE else "")


def _source(safety: dict[str, list[dict[str, Any]]]) -> str:
    sources = {one["source"] for found in safety.values() for one in found}
    if sources == {"step_log"}:
        return "Counted in control steps, from the step logs of the runs."
    if sources == {"table"}:
        return "From the tables of the episodes, because there is no step log: violations are counted in episodes."
    return "From the step logs, and for runs without one from the tables of their episodes, whose violations count episodes."


def _differences(methods: dict[str, list[Run]]) -> list[dict[str, Any]]:
    """What all methods differ in from the thesis, and then what single ones do."""
    told = {
        name: list(dict.fromkeys(w for run in runs for w in describe_differences(run.config)))
        for name, runs in methods.items()
    }
    first = next(iter(told.values()))
    common = [words for words in first if all(words in others for others in told.values())]
    groups = [{"names": "", "words": common}] if common else []
    for name, words in told.items():
        own = [one for one in words if one not in common]
        if own:
            groups.append({"names": f"{name} also in" if common else name, "words": own})
    return groups or [{"names": "", "words": ["nothing that its configuration tells"]}]


def _configuration(methods: dict[str, list[Run]]) -> tuple[Table | None, Table]:
    settings = {name: _resolved(runs) for name, runs in methods.items()}
    keys = list(dict.fromkeys(key for one in settings.values() for key in one))
    values = {key: [one.get(key, "–") for one in settings.values()] for key in keys}
    common = [key for key in keys if len(set(values[key])) == 1]
    rows = [Row([Cell(key.replace("_", " ")), *map(Cell, values[key])]) for key in keys if key not in common]
    differing = Table(["", *settings], rows) if rows else None
    return differing, Table(["", ""], [Row([Cell(key.replace("_", " ")), Cell(values[key][0])]) for key in common])


def _resolved(runs: Sequence[Run]) -> dict[str, str]:
    """Every setting of a method's runs, in words; those of several seeds side by side."""
    told = [{**flat(run.config), "preset": run.config.preset, "episodes": len(run.episodes)} for run in runs]
    told = [{**one, "seeds": run.config.seed} for one, run in zip(told, runs, strict=True)]
    return {key: _several(cell(one.get(key)) for one in told) for key in told[0]}


def _several(values: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(values))


def _versions(runs: Sequence[Run]) -> Table | None:
    if not runs:
        return None
    names = dict.fromkeys(name for run in runs for name in run.config.versions)
    told = {name: _several(run.config.versions.get(name, "–") for run in runs) for name in names}
    return Table(["", ""], [Row([Cell(name), Cell(version)]) for name, version in told.items()])


def _commands(gathered: Gathered, paths: Sequence[Path]) -> tuple[list[str], list[str]]:
    """What repeats it all, and each run."""
    every = [command(run.config, f"runs/{name}") for run, name in zip(gathered.runs, gathered.called, strict=True)]
    if gathered.study:
        return _studies(gathered.held_out), every
    return every, []


def _studies(judged: pd.DataFrame) -> list[str]:
    """What repeats the studies of a table; a part of one, whose table's name goes on after a dash, with its methods."""
    found = []
    names = [str(name) for name in dict.fromkeys(judged["study"])] if len(judged) else []
    for name in names:
        rows = judged[judged["study"] == name]
        methods, seeds = ([str(one) for one in dict.fromkeys(rows[column])] for column in ("method", "seed"))
        parts = ("-".join(chosen) for chosen in ([*methods, *seeds], methods, seeds))
        wholes = [one for one in names if name.startswith(f"{one}-")]
        wholes += [name.removesuffix(f"-{part}") for part in parts if name.endswith(f"-{part}")]
        part = f" --methods {','.join(methods)} --seeds {','.join(seeds)}" if wholes else ""
        found.append(f"guiderail study {[*wholes, name][0]}{part} --out studies")
    return found


def _lead(gathered: Gathered) -> str:
    """What tables without their runs are of."""
    learned = (gathered.held_out["policy"] == LEARNED).any() if len(gathered.held_out) else False
    return "Tables of studies, without their runs." if learned else "Policies that learned nothing."


def _count(number: int, what: str) -> str:
    return f"{number:,} {what}{'' if number == 1 else 's'}"
