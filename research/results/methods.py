"""Tables of methods: one for each task, and the hard tasks in one table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.subject import has_constant_offset
from guiderail.tools.imports import import_modules
from guiderail.tools.learning.learner_config import resolve_preset
from guiderail.tools.tables import read_table
from guiderail_studies.declaration import Study, load_study
from guiderail_studies.job import Job
from guiderail_studies.statistics import Scores, bootstrap_interval, interquartile_mean, probability_of_improvement
from research.results.sections import BASELINES, SECTIONS, Row, Section
from research.studies import study_path

COLUMNS = (
    "method", "training episodes (seeds)", "held-out success [%]", "IQM (95 %) [%]", "episodes to convergence",
    "stopped in training [%]", "max. commanded violation", "peak force held out (in training) [N]",
)  # fmt: skip
HARD_TASKS_COLUMNS = (
    "task", "guided, success [%]", "residual RL, success [%]", "scripted / random, success [%]",
    "stopped in training, guided / residual RL [%]", "episodes with violations, guided / residual RL [%]",
    "training episodes per seed (seeds)",
)  # fmt: skip
# Columns and rows of the README's table of hard tasks: without an effect, and with an effect of template and primitive.
README_COLUMNS = 5
README_TITLES = (
    "Connector, hard, converged contact",
    "Grid clamp, hard, 6 s, force not bounded",
    "Narrow passage, hard",
)
MISSING = "–"
ALWAYS = (0, 2)  # columns that every table of methods has: name and success
BRIEF = (0, 1, 2, 5, 6)  # columns of a brief table of methods
BEGIN, END = "<!-- Written by python -m research.results -->", "<!-- End of the written table -->"
GUIDED = ("sct", "kgrl", "skgrl")
RUN_OFFSET = " †"  # mark of results that were evaluated with the hidden offset of each run
MIN_SEEDS = 3  # smallest number of seeds for an interval
MIN_EQUAL_SEEDS = 5  # smallest number of seeds for an interval without width


def task_table(task: str, tables: Path) -> str:
    """Return the Markdown tables of a task's methods; empty if there is no result.

    Args:
        task: Name of the task.
        tables: Folder of the studies' tables.
    """
    parts = []
    for section in SECTIONS.get(task, ()):
        rows = [(row, seeds) for row in section.rows if len(seeds := last_rows(tables, row))]
        if rows:
            studies = ", ".join(f"`{study}`" for study in dict.fromkeys(row.study for row, _ in rows))
            table = methods_table([(row.name, seeds) for row, seeds in rows], section.is_brief)
            remarks = "".join(f"\n{line}\n" for write in REMARKS for line in write(section, tables))
            parts.append(f"## {section.title}\n\nStudies: {studies}.\n\n{table}\n{remarks}")
    return "\n".join(parts)


def hard_tasks_table(tables: Path, columns: int = len(HARD_TASKS_COLUMNS), titles: Sequence[str] | None = None) -> str:
    """Return the Markdown table of the hard tasks: a row for each of their sections.

    Args:
        tables: Folder of the studies' tables.
        columns: Number of columns.
        titles: Titles of the sections; by default all.
    """
    rows = []
    sections = [section for of_task in SECTIONS.values() for section in of_task if ", hard" in section.title]
    sections = [section for section in sections if titles is None or section.title in titles]
    for section in sections:
        named = {row.name: (row, seeds) for row in section.rows if len(seeds := last_rows(tables, row))}
        guided = [named[name] for name in section.guided if name in named]
        if not guided:
            continue
        residual, scripted, random = (named.get(name) for name in ("residual RL", BASELINES[3], BASELINES[1]))
        efforts = [*dict.fromkeys(_effort(*result) for result in guided)]
        if residual and (effort := _effort(*residual)) not in efforts:
            efforts.append(f"residual RL: {effort}")
        rows.append(
            (
                section.title,
                "; ".join(f"{_label(row)} {_percent((row, seeds))}" for row, seeds in guided),
                _percent(residual),
                f"{_percent(scripted)} / {_percent(random)}",
                _compared(_stopped, guided, residual),
                _compared(_violated, guided, residual),
                "; ".join(efforts),
            )[:columns]
        )
    return markdown_table(HARD_TASKS_COLUMNS[:columns], rows)


def replace_table(text: str, table: str) -> str:
    """Return the text of a page with the table between its markers.

    Raises:
        ValueError: If the markers are missing.
    """
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not begin or not end:
        raise ValueError(f"the page has no place for the table: put {BEGIN!r} and {END!r} there")
    return f"{before}{BEGIN}\n\n{table}\n\n{END}{after}"


@cache
def _study(name: str) -> Study:
    """Return a study of the research; reading it takes longer than everything else that a row needs."""
    return load_study(study_path(name))


def last_rows(tables: Path, row: Row) -> pd.DataFrame:
    """Return the rows of a method after the last training episode of each seed; empty if there is no table."""
    path = tables / f"{row.study}.csv"
    if not path.is_file():
        return pd.DataFrame()
    result = read_table(path)
    result = result[(result["method"] == row.method) & ((row.eval_set is None) | (result["eval_set"] == row.eval_set))]
    return result.sort_values(["seed", "after_episodes"], kind="stable").drop_duplicates("seed", keep="last")


def markdown_table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def methods_table(methods: Sequence[tuple[str, pd.DataFrame]], is_brief: bool = False) -> str:
    """Return the Markdown table of learned methods, and a sentence with the success of policies without learning.

    Another sentence replaces a column in which all learned methods are equal.

    Args:
        methods: Name and rows of each method.
        is_brief: True for success, stops and violations only.
    """
    rows = [(name, *_method_cells(seeds)) for name, seeds in methods if is_trained(seeds)]
    fixed = [f"{name} {_fixed_cell(seeds)}" for name, seeds in methods if not is_trained(seeds)]
    columns = BRIEF if is_brief else range(len(COLUMNS))
    values = {index: {row[index] for row in rows} for index in columns}
    kept = [index for index in columns if len(values[index]) > 1 or index in ALWAYS]
    equal = {COLUMNS[index]: cell for index in columns if index not in kept for cell in values[index]}
    sentences = "; ".join(f"{name}: {cell}" for name, cell in equal.items() if cell != MISSING)
    parts = [f"The same for all learned methods: {sentences}."] if sentences else []
    if rows:
        parts.append(markdown_table([COLUMNS[i] for i in kept], [[row[i] for i in kept] for row in rows]))
    if fixed:
        parts.append(f"Without learning: {'; '.join(fixed)}.")
    return "\n\n".join(parts)


def _fixed_cell(seeds: pd.DataFrame) -> str:
    """Return the success of a policy that does not learn, and its largest violation if it has any."""
    success = _interval(seeds.iloc[0].to_dict()) if len(seeds) == 1 else success_cell(seeds)
    violation = largest_violation([_safety(seeds, "")])
    return success if violation == "none" else f"{success}, violation {violation}"


def _method_cells(seeds: pd.DataFrame) -> tuple[str, ...]:
    """Return the cells of a learned method's row after its name: of all its seeds together, not of each."""
    held_out = _is_evaluated(seeds)
    success = success_cell(seeds) if held_out else f"{mean_and_range(seeds, 'training_success_rate')} in training"
    parts = [_safety(seeds, prefix) for prefix in (("", "training_") if held_out else ("training_",))]
    forces = _forces(parts) if held_out else f"({_forces(parts)})"
    converged = _converged(seeds["training_episodes_to_convergence"])
    return effort_cell(seeds), success, _middle(seeds), converged, _stopped(seeds), largest_violation(parts), forces


def effort_cell(seeds: pd.DataFrame) -> str:
    """Return the number of training episodes and the seeds; a dash for a policy that does not learn."""
    if not is_trained(seeds):
        return "–"
    episodes = "/".join(f"{n:g}" for n in dict.fromkeys(seeds["training_episodes"]))
    return f"{episodes} ({span(seeds['seed'])})"


def success_cell(seeds: pd.DataFrame) -> str:
    """Return the mean success with its range, and the number of episodes of each seed if it is not 100."""
    numbers = [*dict.fromkeys(seeds["episodes"].astype(int))]
    each = "" if numbers == [100] else f", of {'/'.join(map(str, numbers))} each"
    return f"{mean_and_range(seeds)}{each}"


def _converged(episodes: pd.Series) -> str:
    """Return the median number of episodes to convergence, and its range; NaN means never."""
    numbers = episodes.fillna(np.inf).to_numpy(float)
    low, middle, high = (
        "never" if np.isinf(value) else f"{value:g}" for value in (numbers.min(), np.median(numbers), numbers.max())
    )
    return middle if low == high else f"{middle} ({low}–{high})"


def _scores(seeds: pd.DataFrame) -> list[np.ndarray] | None:
    """Return the held-out success of the seeds; None for too few seeds or a method that does not learn."""
    if not (len(seeds) >= MIN_SEEDS and is_trained(seeds) and _is_evaluated(seeds)):
        return None
    return [seeds["success_rate"].to_numpy(dtype=float)]


def _middle(seeds: pd.DataFrame) -> str:
    """Return the interquartile mean of the seeds' held-out success with its interval [%]; a dash for too few seeds.

    The interval is omitted if it has no width and the seeds are few.
    """
    scores = _scores(seeds)
    if scores is None:
        return "–"
    low, high = bootstrap_interval(interquartile_mean, scores)
    mean = f"{100 * interquartile_mean(scores):.3g}"
    return f"{mean} ({100 * low:.3g}–{100 * high:.3g})" if _has_interval(low, high, scores) else mean


def _has_interval(low: float, high: float, *methods: Scores) -> bool:
    """Return False for an interval without width of too few seeds, which would overstate the certainty."""
    return low < high or min(len(scores) for method in methods for scores in method) >= MIN_EQUAL_SEEDS


def improvements(section: Section, tables: Path) -> list[str]:
    """Return a sentence with the probability that each guided method is better than the best peer."""
    scores = {row.name: result for row in section.rows if (result := _scores(last_rows(tables, row))) is not None}
    peers = [row.name for row in section.rows if row.name in scores and not is_guided(row)]
    guided = [name for name in section.guided if name in scores]
    if not peers or not guided:
        return []
    best = max(peers, key=lambda name: (float(interquartile_mean(scores[name])), -peers.index(name)))
    parts = []
    for name in guided:
        pair = scores[name], scores[best]
        low, high = bootstrap_interval(probability_of_improvement, *pair)
        interval = f" (95 %: {low:.2f}–{high:.2f})" if _has_interval(low, high, *pair) else ""
        parts.append(f"{name} {probability_of_improvement(*pair):.2f}{interval}")
    return [f"Probability that a seed succeeds more often than one of {best}: {'; '.join(parts)}."]


def is_guided(row: Row) -> bool:
    """Return True for a method of the thesis, and False for a method that is compared with it."""
    study = _study(row.study)
    environment = {**study.env, **study.methods[row.method].env}
    return environment.get("guidance", GUIDED[0]) in GUIDED


def knowledge(section: Section, tables: Path) -> list[str]:
    """Return sentences about the demonstrated episodes of the learned methods, if there are any.

    The sentences state the number of demonstrated episodes, and the methods without a successful training episode.
    """
    methods: dict[int, list[str]] = {}  # names by number of demonstrated episodes
    failed = []
    for row in section.rows:
        seeds = last_rows(tables, row)
        if is_trained(seeds):
            methods.setdefault(number := demonstrated_episodes(row), []).append(row.name)
            if number and not seeds.get("training_ended_in_success", pd.Series([1])).any():
                failed.append(row.name)
    sentences = []
    if failed:
        sentences = [
            "The scripted policy acts through the guidance of each method. No training episode succeeded, not even a "
            f"demonstrated one: {'; '.join(failed)}."
        ]
    if len(methods) < 2:
        return [f"Demonstrated episodes of every learned method: {number}." for number in methods if number] + sentences
    counts = sorted(filter(None, methods), reverse=True)
    parts = [f"{number} demonstrated episodes: {', '.join(methods[number])}" for number in counts]
    parts += ["none: the other methods"] if 0 in methods else []
    return [f"**The methods do not have equal knowledge.** {'; '.join(parts)}.", *sentences]


def demonstrated_episodes(row: Row) -> int:
    """Return the number of demonstrated episodes from which a method of a study learns.

    The imports of the study are executed only if the default of the method's learner is needed.
    """
    study = _study(row.study)
    choices = [study.learner, study.methods[row.method].learner]
    # As in `Job.config`: the value null of a method overrides the study's choice.
    names = ("algorithm", "preset")
    given = {name: getattr(choice, name) for choice in choices for name in names if name in choice.model_fields_set}
    algorithm, preset = given.get("algorithm"), given.get("preset")
    settings = {**choices[0].settings, **choices[1].settings}
    if "demonstration_episodes" in settings or algorithm is None:
        return int(settings.get("demonstration_episodes", 0))
    import_modules(study.imports)  # modules of this checkout, because the study is
    return resolve_preset(preset, algorithm).demonstration_episodes


def has_run_offset(row: Row) -> bool:
    """Return True if all held-out episodes of a seed have the hidden offset of its training."""
    study = _study(row.study)
    import_modules(study.imports)
    environment = Job(study, row.method, study.seeds[0], Path()).config(1).environment
    return any(
        has_constant_offset(study.task, {**environment, **eval_set.env}) and not eval_set.options.get("new_run")
        for eval_set in study.eval_set
        if row.eval_set in (None, eval_set.name)
    )


def offsets(section: Section, tables: Path) -> list[str]:
    """Return a sentence that names the methods whose held-out episodes have the hidden offset of their run."""
    rows = {row.name: seeds for row in section.rows if len(seeds := last_rows(tables, row))}
    fixed = [row.name for row in section.rows if row.name in rows and has_run_offset(row)]
    if not fixed:
        return []
    others = [name for name in rows if name not in fixed]
    sentence = "One hidden offset for each seed, in training and in held-out episodes"
    if not others:
        return [f"{sentence}."]
    if fixed == [name for name, seeds in rows.items() if is_trained(seeds)]:
        return [f"{sentence}: learned methods. A new one in every held-out episode: baseline policies."]
    return [f"{sentence}: {'; '.join(fixed)}. A new one in every held-out episode: {'; '.join(others)}."]


def is_trained(seeds: pd.DataFrame) -> bool:
    """Return True for a method that learns, and False for a baseline policy."""
    return "training_episodes" in seeds and bool(seeds["training_episodes"].notna().any())


def _is_evaluated(seeds: pd.DataFrame) -> bool:
    return "success_rate" in seeds and bool(seeds["success_rate"].notna().all())


REMARKS = (improvements, knowledge, offsets)  # functions that return the sentences below the table of a section
_SAFETY = ("max_commanded_violation", "violating_episodes", "peak_force")


def _safety(seeds: pd.DataFrame, prefix: str) -> pd.DataFrame:
    return seeds[[f"{prefix}{name}" for name in _SAFETY]].set_axis(_SAFETY, axis=1)


def training_safety(seeds: pd.DataFrame) -> pd.DataFrame:
    """Return the violations and peak forces of the training of a method, in the columns of an evaluation."""
    return _safety(seeds, "training_")


def span(seeds: Iterable[float]) -> str:
    """Return consecutive seeds as a range, others as a list."""
    numbers = sorted(int(seed) for seed in seeds)
    if len(numbers) > 2 and numbers == list(range(numbers[0], numbers[-1] + 1)):
        return f"{numbers[0]}–{numbers[-1]}"
    return ", ".join(map(str, numbers))


def _interval(row: Mapping[Any, Any]) -> str:
    """Return a success rate with its Wilson interval and its number of episodes."""
    rate, low, high = (100 * row[name] for name in ("success_rate", "success_low", "success_high"))
    return f"{rate:.3g} ({low:.1f}–{high:.1f}) of {row['episodes']:.0f}"


def largest_violation(parts: Sequence[pd.DataFrame]) -> str:
    """Return the largest commanded violation and the number of episodes with violations, held-out and training."""
    worst = max(float(part["max_commanded_violation"].max()) for part in parts)
    if worst <= TOLERANCE:
        return "none"
    episodes = sum(int(part["violating_episodes"].sum()) for part in parts)
    return f"{1000 * worst:.2f} mm, in {episodes} episodes"


def _forces(parts: Sequence[pd.DataFrame]) -> str:
    held_out, *training = (f"{float(part['peak_force'].max()):.1f}" for part in parts)
    return held_out + "".join(f" ({force})" for force in training)


def mean_and_range(seeds: pd.DataFrame, column: str = "success_rate") -> str:
    """Return the mean success [%] with the range over several seeds; a single seed is marked."""
    rates = 100 * seeds[column].astype(float)
    interval = "" if rates.min() == rates.max() else f" ({rates.min():.0f}–{rates.max():.0f})"
    is_single = len(seeds) == 1 and is_trained(seeds)
    is_exact = 99.5 <= rates.mean() < 100 or 0 < rates.mean() < 10  # 99.6 is not written as 100
    mean = f"{rates.mean():.1f}".removesuffix(".0") if is_exact else f"{rates.mean():.0f}"
    return f"{mean}{' (one seed)' if is_single else interval}"


def _percent(result: tuple[Row, pd.DataFrame] | None) -> str:
    """Return the success of a row, marked if evaluated with the hidden offset of each run; a dash without a result."""
    return f"{mean_and_range(result[1])}{RUN_OFFSET if has_run_offset(result[0]) else ''}" if result else "–"


def _label(row: Row) -> str:
    """Return the name of a row with its setting in brackets, except for the number of demonstrated episodes."""
    name, _, setting = row.name.partition(", ")
    return f"{name} ({setting})" if setting and "demonstration" not in setting else name


def _effort(row: Row, seeds: pd.DataFrame) -> str:
    """Return the number of training episodes, how many of them are demonstrated, and the number of seeds."""
    episodes, demonstrated = "/".join(f"{n:g}" for n in dict.fromkeys(seeds["training_episodes"])), ""
    if number := demonstrated_episodes(row):
        demonstrated = f", {number} of them demonstrated"
    return f"{episodes}{demonstrated} ({len(seeds)})"


def _compared(
    share: Callable[[pd.DataFrame], str],
    guided: Sequence[tuple[Row, pd.DataFrame]],
    residual: tuple[Row, pd.DataFrame] | None,
) -> str:
    """Return a share [%] of the guided methods, by name if they differ, and of residual RL; a dash if it is missing."""
    shares = [share(seeds) for _, seeds in guided]
    named = ", ".join(f"{text} ({row.name.split(',')[0]})" for (row, _), text in zip(guided, shares, strict=True))
    return f"{named if len(set(shares)) > 1 else shares[0]} / {share(residual[1]) if residual else '–'}"


def _violated(seeds: pd.DataFrame) -> str:
    """Return the share of held-out episodes with a command outside the constraints [%]."""
    return f"{100 * seeds['violating_episodes'].sum() / seeds['episodes'].sum():.0f}"


def _stopped(seeds: pd.DataFrame) -> str:
    """Return the share of training episodes that ended in a collision or a spill [%]; a dash if it is unknown."""
    columns = ["training_ended_in_collision", "training_ended_in_spill"]
    if not {*columns} <= {*seeds} or seeds[columns].isna().any(axis=None):
        return "–"
    return f"{100 * seeds[columns].sum(axis=None) / seeds['training_episodes'].sum():.0f}"
