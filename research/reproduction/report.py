"""Report of the reproduction: each figure and table of chapters 2 to 5 with its verdict, from stored tables."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.tools.files import write_atomically
from guiderail.tools.tables import read_table
from research.figures import FIGURES as REPRODUCED
from research.figures import figure_command
from research.figures.thesis import THESIS
from research.reproduction.knowledge import count_knowledge
from research.reproduction.tables import TABLES

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "research" / "results"
PAGE = ROOT / "docs" / "thesis.md"
DETAILS = ROOT / "research" / "reproduction" / "figures.md"
BEGIN, END = "<!-- report: begin -->", "<!-- report: end -->"
NO_LEARNING = "no learning"  # runs of a figure that is computed or counted
STREAK = 10  # consecutive successes that count as convergence
LONGEST = 1400  # planned episodes of a run of figures 3.5 and 3.6
POURING_REPEAT = 10  # control steps of an action in the study of figure 3.7
AVOIDED = -5.0  # mean obstacle cost of five episodes above which the obstacle counts as avoided
HOLDS, PARTLY, NOT, OPEN = "holds", "holds partly", "does not hold", "open"


@dataclass(frozen=True)
class Entry:
    """Figure or table of the thesis in the report.

    Attributes:
        numbers: Numbers of the figures or tables, as keys of `THESIS`.
        verdict: Verdict, with its reason where it is not `HOLDS`.
        measure: Measure on which the verdict depends.
        ours: Results, one sentence each.
        runs: Number of runs of each method, and of the thesis.
        differences: Differences from the thesis.
        tables: Names of the stored files, relative to `research`.
        command: Command that makes the results.
        hours: Duration of the runs, each in one process, if it was measured [h].
        title: Title instead of the numbers, for a task that is not in the thesis.
    """

    numbers: tuple[str, ...]
    verdict: str
    measure: str
    ours: tuple[str, ...]
    runs: str
    differences: str
    tables: tuple[str, ...]
    command: str
    hours: float | None = None
    title: str = ""


def write_report(tables: Path = TABLES, page: Path = PAGE, details: Path = DETAILS) -> tuple[Path, Path]:
    """Write the verdicts between their markers in the page and a file with the details, and return both paths."""
    before, _, rest = page.read_text("utf-8").partition(BEGIN)
    after = rest.partition(END)[2]
    all_entries = entries(tables)
    write_atomically(page, f"{before}{BEGIN}\n\n{format_verdicts(all_entries)}\n{END}{after}".encode())
    write_atomically(details, format_details(all_entries).encode())
    return page, details


def format_verdicts(all_entries: list[Entry]) -> str:
    """Return the table of the verdicts as Markdown, and a sentence with those that hold without learning."""
    computed = [entry for entry in all_entries if (entry.verdict, entry.runs) == (HOLDS, NO_LEARNING)]
    lines = ["| figure or table | verdict | runs here (thesis) |", "|---|---|---|"]
    lines += [f"| {_name(entry)} | {entry.verdict} | {entry.runs} |" for entry in all_entries if entry not in computed]
    hours = sum(entry.hours or 0.0 for entry in all_entries)
    numbers = [number for entry in computed for number in entry.numbers]
    figures = [number for number in numbers if not number.startswith("table")]
    tables = [number.removeprefix("table ") for number in numbers if number.startswith("table")]
    lines += ["", f"Without learning, figures {_enumerate(figures)} and tables {_enumerate(tables)} hold."]
    return "\n".join([*lines, "", f"The stored training runs took {hours:.1f} hours, one process each.", ""])


def format_details(all_entries: list[Entry]) -> str:
    """Return a section for each entry as Markdown."""
    lines = ["# Figures and tables of the thesis", "", "Written by `python -m research.thesis`. The number after ± is "]
    lines[-1] += "the standard deviation over runs."
    lines += [""]
    for entry in all_entries:
        lines += [f"## {_name(entry)}", ""]
        lines += [f"- **Thesis**, {number}: {THESIS[number]}." for number in entry.numbers]
        lines += [f"- **Verdict:** {entry.verdict}."]
        lines += [f"- **Here:** {'; '.join(entry.ours)}.", f"- **Measure:** {entry.measure}."]
        lines += [f"- **Differences:** {entry.differences}."] if entry.differences != "none" else []
        cost = "" if entry.hours is None else f" ({entry.hours:.2f} hours)"
        stored = ", ".join(f"`research/{name}`" for name in entry.tables)
        lines += [f"- `{entry.command}`{cost}; stored in {stored}.", ""]
    return "\n".join(lines)


def _name(entry: Entry) -> str:
    if entry.title:
        return entry.title
    tables = [number for number in entry.numbers if number.startswith("table")]
    figures = [number for number in entry.numbers if not number.startswith("table")]
    names = [f"figure{'s' if len(figures) > 1 else ''} {_enumerate(figures)}"] if figures else []
    return " and ".join([*names, *tables]).capitalize()


def _enumerate(names: list[str]) -> str:
    return " and ".join(filter(None, [", ".join(names[:-1]), names[-1]]))


def entries(tables: Path = TABLES) -> list[Entry]:
    """Return the entries in the order of the thesis."""
    return [
        _computed("2.2", "states and inputs of the template", "the template is in `models/objects/pouring`"),
        _computed("3.4", "a rendered scene", "Drake instead of Bullet"),
        *_pouring_endings(tables),
        _robot_pouring(),
        *_hard_pouring(tables),
        _clamp_curves(tables),
        _clamp_return(tables),
        _computed("table 3.2", "settings of the presets", "none"),
        _knowledge(),
        _demonstration_alone(tables),
        _exploration_2d(),
        _computed("4.3", "a drawing of the passage", "own dimensions, because the thesis gives none"),
        _explored_positions(),
        _passage_success(tables),
        _passage_safety(tables),
        _images(tables),
        _connector(),
        _computed("table 4.1", "settings of the presets", "none"),
        _computed("5.2", "jump between successive windows", "random actions at the same RMS"),
        _computed("5.3", "a drawing of the passage", "own dimensions, because the thesis gives none"),
        _computed(
            "5.4",
            "steps until half of a push is recovered; constraint violation of the commands",
            "own dimensions and pushes; after a push into the zone the first command is on its edge",
        ),
        _smooth_exploration(),
        _return_comparison(tables),
        _computed(
            "5.7",
            "endings of two episodes",
            f"the unsuccessful episode has random actions before learning; {EARLIER_CONTACT}",
            "1 of sKGRL (1)",
        ),
        _positions(),
        _connector_comparison(tables),
        _jerk(tables),
    ]


def _stored(number: str) -> dict[str, Any]:
    name = REPRODUCED[number]
    return json.loads((RESULTS / f"{name}.json").read_text("utf-8"))


def _results_of(number: str) -> tuple[str, ...]:
    known = ("figure", "the thesis", "command", "seconds", "seeds", "condition", "picture", "table", "demonstrations")
    return tuple(
        f"{key.replace('_', ' ')}: {_short(value)}" for key, value in _stored(number).items() if key not in known
    )


def _percent(share: float, digits: int = 0) -> str:
    return f"{100 * share:.{digits}f} %"


def _short(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _positions() -> Entry:
    stored = _stored("5.8")
    commanded, measured = (
        stored[f"sKGRL's largest change of x, y in a control step below KGRL's, {which}"]
        for which in ("commanded", "measured")
    )
    entry = _computed(
        "5.8",
        "mean over exploring episodes of the largest change of x, y in a control step, and of the jerk",
        "in simulation, on the gantry; the shipped ρ and commanded history",
        f"{stored['seeds']} seeds",
    )
    return replace(
        entry, verdict=f"{PARTLY}: jumps of the command are {commanded} smaller, of the measured position {measured}"
    )


def _computed(number: str, measure: str, differences: str, runs: str = NO_LEARNING) -> Entry:
    """Return the entry of a figure whose stored numbers agree with the thesis's statement.

    The stored condition is a difference.
    """
    results = _results_of(number) or ("the picture is drawn by the command",)
    differences = "; ".join(filter(None, [differences, _stored(number).get("condition")]))
    name = REPRODUCED[number]
    return Entry(
        (number,),
        HOLDS,
        measure,
        results,
        runs,
        differences,
        (f"results/{name}.json",),
        figure_command(number),
    )


def _runs_of(table: pd.DataFrame, method: str) -> list[pd.DataFrame]:
    """Return the episodes of each run of a method."""
    own = table[table["method"] == method]
    return [run.reset_index(drop=True) for _, run in own.groupby("seed")]


def _read(tables: Path, name: str) -> pd.DataFrame | None:
    file = tables / f"{name}.csv"
    return read_table(file) if file.is_file() else None


def _hours(table: pd.DataFrame, methods: tuple[str, ...] = ()) -> float:
    own = table if not methods else table[table["method"].isin(methods)]
    return float(own["wall_time"].sum()) / 3600


def converged_at(success: pd.Series) -> int | None:
    """Return the number of episodes before the first `STREAK` consecutive successes; None if there are none."""
    streak = 0
    for index, is_success in enumerate(success):
        streak = streak + 1 if is_success else 0
        if streak == STREAK:
            return index + 1 - STREAK
    return None


def _convergence(runs: list[pd.DataFrame], planned: int) -> str:
    """Return the episodes to convergence of each run; "not yet" for a run with fewer than `planned` episodes."""
    converged = [(converged_at(run["success"]), len(run)) for run in runs]
    return ", ".join(
        str(value) if value is not None else "not yet" if number < planned else "never" for value, number in converged
    )


def avoided_at(obstacle_cost: pd.Series) -> int | None:
    """Return the first episode from which five episodes have a mean obstacle cost above `AVOIDED`; None if none."""
    means = obstacle_cost.rolling(5).mean()
    reached = np.flatnonzero(means.to_numpy(float) > AVOIDED)
    return int(reached[0]) - 4 if len(reached) else None


def _each(runs: list[pd.DataFrame], value: Callable[[pd.DataFrame], Any]) -> str:
    """Return a value of each run as text."""
    return ", ".join("never" if (v := value(run)) is None else _short(v) for run in runs)


def _mean(runs: list[pd.DataFrame], column: str, part: slice) -> tuple[float, float]:
    """Return mean and standard deviation over runs of a column's mean over some episodes."""
    values = [float(run[column].iloc[part].mean()) for run in runs]
    return float(np.mean(values)), float(np.std(values))


def _band(runs: list[pd.DataFrame], column: str, part: slice, form: str = "{:.1f}") -> str:
    mean, deviation = _mean(runs, column, part)
    return f"{form.format(mean)} ± {form.format(deviation)}"


def _pouring_endings(tables: Path) -> list[Entry]:
    """Return the entries of figures 3.5, 3.6 and 3.8."""
    names = {"rl_sparse": "RL-Sparse", "rl_shaped": "RL-Shaped", "rl_sct_sparse": "RL-SCT-Sparse",
             "rl_sct_shaped": "RL-SCT-Shaped"}  # fmt: skip
    found = []
    for algorithm, number, claimed in (("sac", "3.5", (1200, 600)), ("tqc", "3.6", (700, 1000))):
        claims = dict(zip(names, ("never", *claimed, 250), strict=True))
        name = f"thesis_pouring_{algorithm}"
        table = _read(tables, name)
        ours: list[str] = []
        stored: tuple[str, ...] = (f"studies/{name}.yaml",)
        stored += () if table is None else (f"reproduction/tables/{name}.csv",)
        ended, complete = dict.fromkeys(names, 0), []
        for method, label in names.items() if table is not None else ():
            runs = _runs_of(table, method)
            if runs:
                converged = [converged_at(run["success"]) for run in runs]
                ended[method] = sum(
                    c is not None or len(run) == LONGEST for c, run in zip(converged, runs, strict=True)
                )
                if ended[method] == 10:
                    within = (
                        "never"
                        if None in converged
                        else f"after {max(c for c in converged if c is not None)} or fewer episodes"
                    )
                    complete.append(f"{within} with {label} (thesis: {claims[method]})")
                ours.append(
                    f"{label}, {len(runs)} of 10 runs so far, episodes done {_each(runs, len)}, episodes until ten "
                    f"successes in a row {_convergence(runs, LONGEST)}, spills "
                    f"{_each(runs, lambda run: int((run['termination'] == 'spill').sum()))}, collisions "
                    f"{_each(runs, lambda run: int((run['termination'] == 'collision').sum()))}"
                )
        if algorithm == "sac" and (probes := _read(tables, "pouring_probes")) is not None:
            ours += _probe_sentences(probes)
            stored += ("reproduction/tables/pouring_probes.csv",)
        found.append(
            Entry(
                (number,),
                f"{OPEN}: {', '.join(f'{number} of 10 runs of {names[method]}' for method, number in ended.items())} "
                "have ended" + "".join(f"; ten successes in a row begin {text}" for text in complete),
                "episodes until ten successes in a row; spills and collisions per episode",
                tuple(ours) or ("no run yet",),
                f"{sum(ended.values())} of 40 ended (40)",
                "`difficulty=thesis`: inputs a quarter as fast as at the standard difficulty and 20 s, so that a "
                "success needs about as many actions as in the thesis; the template pours from 90 mm instead of 75 mm "
                "and has no funnel, so that RL-SCT needs about as many episodes as in the thesis; it therefore spills "
                "more often; own template and vessels; a spill ends the episode; Drake instead of Bullet",
                stored,
                f"python -m research.thesis --figure {number} --resume",
                None if table is None else _hours(table),
            )
        )
    found.append(
        Entry(
            ("3.8",),
            f"{OPEN}: it summarizes figures 3.5 and 3.6",
            "as figures 3.5 and 3.6",
            ("see figures 3.5 and 3.6",),
            "those of figures 3.5 and 3.6",
            "as figures 3.5 and 3.6",
            ("studies/thesis_pouring_sac.yaml", "studies/thesis_pouring_tqc.yaml"),
            "python -m research.thesis --figure 3.8 --resume",
        )
    )
    return found


def _probe_sentences(probes: pd.DataFrame) -> list[str]:
    """Return sentences on what makes the standard task easy, from one run of each change (RL-SCT-Shaped, SAC)."""
    texts = {
        "pace": "inputs a quarter as fast and 20 s (`input_speed=0.25 time_limit=20`)",
        "pour_distance": "a template that pours from 100 mm and has no funnel (`pour_distance=0.1 funnel=false`), fast "
        "inputs",
        "funnel": "slow inputs and 20 s, from 100 mm with the funnel",
    } | {
        f"near_{distance:g}": f"slow inputs and 20 s, from {distance:g} mm without the funnel"
        for distance in (87.5, 90, 92.5, 95)
    }
    sentences = []
    for method, text in texts.items():
        run = _runs_of(probes, method)[0]
        converged = converged_at(run["success"])
        when = (
            "no ten successes in a row" if converged is None else f"ten successes in a row after {converged} episodes"
        )
        spills = int((run["termination"] == "spill").sum())
        sentences.append(f"one run with {text}: {when}; {spills} of {len(run)} episodes spill")
    return [
        *sentences,
        "so the standard task is easy because its template leads every approach to where both balls fall into the mug, "
        "not because its inputs are fast; 5 mm of the distance from which the template pours decide whether RL-SCT "
        "needs 5 episodes or more than 150",
    ]


def _robot_pouring() -> Entry:
    rows = read_table(RESULTS / "pouring_sac.csv")
    shaped = rows[rows["method"] == "rl_sct_shaped"]
    converged = ", ".join(str(int(value)) for value in shaped["training_episodes_to_convergence"])
    constant = read_table(RESULTS / "pouring_baselines.csv").set_index("method").loc["best_constant", "success_rate"]
    actions = shaped["training_total_steps"].sum() / shaped["training_episodes"].sum() / POURING_REPEAT
    return Entry(
        ("3.7",),
        f"{PARTLY}: without spills and collisions, but on an easier task",
        "episodes until ten successes in a row",
        (
            f"ten successes in a row begin after {converged} episodes ({len(shaped)} runs of the standard difficulty)",
            f"spills of each run: {', '.join(str(int(v)) for v in shaped['training_ended_in_spill'])}; collisions: "
            f"{', '.join(str(int(v)) for v in shaped['training_ended_in_collision'])}",
        ),
        f"{len(shaped)} (5)",
        f"in simulation; at the standard difficulty one constant action pours in {_percent(constant)} of the "
        "episodes, because the template leads every approach to where both balls fall into the mug, and a training "
        "episode has "
        f"{actions:.0f} actions instead of the thesis's {9700 / 65:.0f}; `difficulty=thesis` changes both; the preset "
        "pouring, whose learning starts after 300 actions, instead of table 3.2; own template and vessels",
        ("results/pouring_sac.csv", "results/pouring_baselines.csv"),
        "guiderail study research/studies/pouring_sac.yaml --out studies",
        float(shaped["training_wall_time"].sum()) / 3600,
    )


def _hard_pouring(tables: Path) -> list[Entry]:
    """Return the entry of pouring at difficulty hard with the shielded template; empty without a table."""
    table = _read(tables, "pouring_hard_shield")
    if table is None:
        return []
    runs = _runs_of(table, "rl_sct")
    finished = [run for run in runs if len(run) == 150]
    spills = [int((run["termination"] == "spill").sum()) for run in runs]
    evaluated = _read(tables, "pouring_hard_shield_evaluated")
    ours = [
        f"{len(finished)} of 10 runs so far have their 150 episodes; episodes done: {_each(runs, len)}",
        f"spills of each run in training: {', '.join(map(str, spills))}; collisions: "
        f"{_each(runs, lambda run: int((run['termination'] == 'collision').sum()))}; episodes until ten "
        f"successes in a row: {_convergence(runs, 150)}",
    ]
    held_out = []
    if evaluated is not None:
        for method, rows in evaluated.groupby("method", sort=False):
            rates = [f"{int(own['success'].sum())} of {len(own)}" for _, own in rows.groupby("seed")]
            ours.append(f"held out, {str(method).replace('_', ' ')}: success in {', '.join(rates)} episodes")
            if method == "rl_sct":
                held_out = [float(own["success"].mean()) for _, own in rows.groupby("seed")]
    earlier = read_table(RESULTS / "pouring_hard.csv").set_index("method")
    before = earlier.loc[["rl_sct", "rl_sct_longer"]]
    percent = 100 * before["training_ended_in_spill"].sum() / before["training_episodes"].sum()
    ours.append(
        f"without the shield {percent:.0f} % of the training episodes spill, and the policies succeed in "
        f"{_percent(before['success_rate'].min())} to {_percent(before['success_rate'].max())} of held-out episodes; "
        f"RL without a template succeeds in {_percent(earlier.loc['rl', 'success_rate'].max())}"
    )
    line = read_table(tables / "pour_line.csv")
    near = np.hypot(line["x_mm"], line["y_mm"] + 35.0) <= 25.0
    ours.append(
        f"where the spills come from: both balls fall into the mug in {int((line['ending'][near] == 'success').sum())} "
        f"of {int(near.sum())} episodes if the thermos is tilted within 25 mm of 35 mm before the mug's axis, and in "
        f"{int((line['ending'][~near] == 'success').sum())} of {int((~near).sum())} elsewhere; without the shield the "
        "policy may tilt beyond 80° anywhere in the state pour"
    )
    enough = len(finished) == 10 and len(held_out) == 10
    reached = (
        bool(held_out) and min(held_out) >= 0.97 and all(s <= 0.02 * len(r) for s, r in zip(spills, runs, strict=True))
    )
    so_far = "reached" if reached else "not reached"
    return [
        Entry(
            (),
            f"target {so_far}" if enough else f"{OPEN}: {len(held_out)} of 10 runs evaluated, target {so_far} in them",
            "at least 97 of 100 held-out episodes of every run, at most 2 % of the training episodes spill",
            tuple(ours),
            f"{len(held_out)} of 10 (–)",
            "not in the thesis: the template expects the mug 35 to 50 mm from its actual position. The template "
            "`pouring_shielded` tilts beyond 80° only within 15 mm of the line from which both balls fall into the "
            "observed mug; the policy observes the same position",
            (
                "reproduction/tables/pouring_hard_shield.csv",
                "reproduction/tables/pouring_hard_shield_evaluated.csv",
                "reproduction/tables/pour_line.csv",
                "results/pouring_hard.csv",
            ),
            "python -m research.thesis --figure hard --resume",
            _hours(table),
            "Pouring at difficulty hard",
        )
    ]


FORCE = {"sct": "with the cost of force", "sct_no_force": "without it"}


def _clamp_runs(table: pd.DataFrame) -> str:
    runs = _runs_of(table, "sct")
    return f"{len(runs)} of {min(map(len, runs))} episodes (5)"


def _clamp_curves(tables: Path) -> Entry:
    table = read_table(tables / "thesis_grid_clamp.csv")
    ours, forces = [], {}
    for method, label in FORCE.items():
        runs = _runs_of(table, method)
        forces[method] = _mean(runs, "mean_squared_force", slice(0, 70))[0]
        ours.append(
            f"{label}: ten successes in a row begin after {_each(runs, lambda r: converged_at(r['success']))} "
            f"episodes; success in episodes 71 to 100 {_band(runs, 'success', slice(70, 100), '{:.3f}')}; mean squared "
            f"force in episodes 1 to 70 {_band(runs, 'mean_squared_force', slice(0, 70))} N², in episodes 71 to 100 "
            f"{_band(runs, 'mean_squared_force', slice(70, 100))} N²; control steps of the first 70 episodes "
            f"{np.mean([run['steps'].iloc[:70].sum() for run in runs]):.0f} in total, of each of the last ten "
            f"{_band(runs, 'steps', slice(90, 100))}; collisions "
            f"{_each(runs, lambda r: int((r['termination'] == 'collision').sum()))}"
        )
    lower = 1.0 - forces["sct"] / forces["sct_no_force"]
    ours.append(f"the cost of force lowers the mean squared force of the first 70 episodes by {_percent(lower)}")
    with_cost, without = (_mean(_runs_of(table, method), "steps", slice(90, 100))[0] for method in FORCE)
    longer = with_cost / without - 1.0
    ours.append(f"it makes the last ten episodes {_percent(longer)} longer")
    converged = [converged_at(run["success"]) for method in FORCE for run in _runs_of(table, method)]
    is_learned = all(value is not None and value + STREAK <= 70 for value in converged)
    baselines = read_table(RESULTS / "grid_clamp_baselines.csv").set_index("method")["success_rate"]
    random = _percent(baselines["uniform_random"])
    ours.append(f"uniform random actions succeed in {random} of the standard task's held-out episodes")
    verdict = (
        f"{PARTLY}: learned within 70 episodes with {_percent(lower)} less force, but {_percent(longer)} longer "
        f"episodes; random actions succeed in {random}"
    )
    verdict = verdict if is_learned else f"{NOT}: not learned within 70 episodes"
    return Entry(
        ("3.10",),
        verdict,
        "success, the thesis's mean squared force of each episode, steps of an episode",
        tuple(ours),
        _clamp_runs(table),
        "in simulation, on the gantry; control steps of 20 ms instead of 100 ms; the preset sac_gridclamp instead of "
        "table 3.2; a hidden table offset of 1.8 to 2.2 mm per run and six grasp offsets of up to 1 mm",
        ("reproduction/tables/thesis_grid_clamp.csv", "results/grid_clamp_baselines.csv"),
        "python -m research.thesis --figure 3.10 --resume",
        _hours(table),
    )


def _clamp_return(tables: Path) -> Entry:
    table = read_table(tables / "thesis_grid_clamp.csv")
    ours, is_converged = [], True
    for method, label in FORCE.items():
        runs = _runs_of(table, method)
        first, late, last = (_mean(runs, "return", part)[0] for part in (slice(0, 10), slice(60, 70), slice(90, 100)))
        is_converged &= abs(last - late) < 0.1 * abs(last - first)
        ours.append(
            f"{label}: return of episodes 1 to 10, 61 to 70 and 91 to 100: "
            + ", ".join(_band(runs, "return", part) for part in (slice(0, 10), slice(60, 70), slice(90, 100)))
            + f" (least of a run {min(float(run['return'].iloc[90:].mean()) for run in runs):.1f})"
        )
    return Entry(
        ("3.11",),
        HOLDS if is_converged else f"{PARTLY}: the return still changes by more than a tenth after 70 episodes",
        "change of the mean return after 70 episodes, less than a tenth of the whole change",
        tuple(ours),
        _clamp_runs(table),
        "as figure 3.10; the returns of the two reward functions have different scales",
        ("reproduction/tables/thesis_grid_clamp.csv",),
        "python -m research.thesis --figure 3.11 --resume",
    )


def _knowledge() -> Entry:
    counts = count_knowledge()
    template, reward = counts["template"], counts["reward"]
    rows = read_table(RESULTS / "pouring_sac.csv").groupby("method")
    endings = "; ".join(
        f"{label}: {100 * g['training_ended_in_spill'].sum() / g['training_episodes'].sum():.1f} % spills, "
        f"{100 * g['training_ended_in_collision'].sum() / g['training_episodes'].sum():.1f} % collisions of "
        f"{int(g['training_episodes'].sum())} training episodes"
        for label, g in ((m, rows.get_group(m)) for m in ("rl_shaped", "rl_sct_shaped") if m in rows.groups)
    )
    return Entry(
        ("table 3.3",),
        HOLDS,
        "parts and numbers counted in the template's file and in the reward functions",
        (
            "template (`models/objects/pouring/pouring.yaml`): "
            + ", ".join(f"{value} {name}" for name, value in template.items()),
            "hand-shaped reward (equations 3.5 to 3.10): "
            + ", ".join(f"{value} {name}" for name, value in reward.items()),
            "both have the phases of moving near and pouring, a distance, and a tilt; only the template has limits "
            f"that every action satisfies. Endings at the standard difficulty (SAC): {endings or 'not stored'}",
        ),
        NO_LEARNING,
        "own template and vessels; near means 70 mm instead of 40 mm in the reward",
        ("results/pouring_sac.csv",),
        figure_command("table 3.3"),
    )


def _exploration_2d() -> Entry:
    return _computed("4.2", "violation, and correlation of exploration with the demonstrations' deviation", "own arch")


def _explored_positions() -> Entry:
    stored = _stored("4.4")
    return Entry(
        ("4.4",),
        HOLDS,
        "RMS distance of the commanded x from that without actions, in the passage and before it; success of uniform "
        "random actions",
        _results_of("4.4"),
        f"{stored['seeds']} seeds of random actions",
        "own dimensions; an action lasts five control steps (the thesis: one) or one",
        ("results/figure_4_4.json",),
        figure_command("4.4"),
    )


def _passage_success(tables: Path) -> Entry:
    table = read_table(tables / "thesis_narrow_passage.csv")
    names = {"kgrl": "KGRL", "residual": "residual RL", "safe_residual": "safe residual RL"}
    runs = {method: _runs_of(table, method) for method in names}
    ours = tuple(
        f"{label}: success {_band(runs[method], 'success', slice(None), '{:.2f}')} of 60 episodes, "
        f"{sum(int(run['success'][0]) for run in runs[method])} of {len(runs[method])} first episodes; return of the "
        f"last ten episodes {_band(runs[method], 'return', slice(50, 60))}"
        for method, label in names.items()
    )
    is_one = all(run["success"].all() for run in runs["kgrl"])
    is_lower = all(_mean(runs[method], "success", slice(None))[0] < 0.8 for method in ("residual", "safe_residual"))
    return Entry(
        ("4.5",),
        f"{HOLDS}, with actions of five control steps" if is_one and is_lower else PARTLY,
        "success in training from the first episode on",
        ours,
        f"{len(runs['kgrl'])} (not given)",
        "own dimensions; an action lasts five control steps (with the thesis's one, random actions of residual RL "
        "seldom get stuck: figure 4.4); the preset tqc_fast; walls do not let the robot slide",
        ("reproduction/tables/thesis_narrow_passage.csv",),
        "python -m research.thesis --figure 4.5 --resume",
        _hours(table, tuple(names)),
    )


def _passage_safety(tables: Path) -> Entry:
    table = read_table(tables / "thesis_narrow_passage.csv")
    counted = {}
    for method in ("kgrl", "residual", "safe_residual"):
        own = table[table["method"] == method]
        counted[method] = (int(own["collisions"].sum()), int((own["max_measured_violation"] > 0).sum()), len(own))
    names = {"kgrl": "KGRL", "residual": "residual RL", "safe_residual": "safe residual RL"}
    is_safe = all(counted[method][:2] == (0, 0) for method in ("kgrl", "safe_residual"))
    rare = counted["residual"][1] < 0.1 * counted["residual"][2]
    return Entry(
        ("4.6",),
        f"{PARTLY}: residual RL collides often, but seldom enters the zone" if is_safe and rare else HOLDS,
        "wall collisions, and episodes with a measured position in the restricted zone",
        tuple(
            f"{names[method]}: {collisions} collisions, {zone} episodes in the zone, of {number} episodes"
            for method, (collisions, zone, number) in counted.items()
        ),
        f"{table.loc[table['method'] == 'kgrl', 'seed'].nunique()} (not given)",
        "as figure 4.5; the mean of the demonstrations keeps a distance from the zone, which the thesis does not give; "
        "random actions of the thesis's one control step enter the zone more often (figure 4.4)",
        ("reproduction/tables/thesis_narrow_passage.csv",),
        "python -m research.thesis --figure 4.6 --resume",
    )


def _images(tables: Path) -> Entry:
    runs = _runs_of(read_table(tables / "narrow_passage_images.csv"), "kgrl")
    evaluated = read_table(tables / "narrow_passage_images_evaluated.csv")
    baselines = {m: evaluated[evaluated["method"] == m] for m in ("demonstration", "uniform_random")}
    evaluated = evaluated[evaluated["method"] == "kgrl"]
    by_seed = evaluated.groupby(["after_episodes", "seed"])[["return", "reward_obstacle_cost"]].mean()
    numbers = by_seed.index.unique("after_episodes")
    returns = [by_seed.loc[number, "return"] for number in numbers]
    costs = [by_seed.loc[number, "reward_obstacle_cost"].mean() for number in numbers]
    greedy = (
        f"after {_enumerate([str(number) for number in numbers])} episodes the greedy policies have mean returns of "
        f"{', '.join(f'{rows.mean():.0f}' for rows in returns)} (least of a run "
        f"{', '.join(f'{rows.min():.0f}' for rows in returns)}) and obstacle costs of "
        f"{', '.join(f'{cost:.0f}' for cost in costs)}"
    )
    last = evaluated[evaluated["after_episodes"] == evaluated["after_episodes"].max()]
    is_avoided = bool((last["reward_obstacle_cost"] == 0).all()) and bool(last["success"].all())
    pixels = _runs_of(read_table(tables / "narrow_passage_images.csv"), "kgrl_pixels")
    return Entry(
        ("4.7",),
        HOLDS if is_avoided else PARTLY,
        "return and obstacle cost over episodes, and those of the greedy policy every five episodes",
        (
            f"training: return {_band(runs, 'return', slice(0, 5))} in the first five episodes, "
            f"{_band(runs, 'return', slice(25, 30))} in the last five; obstacle cost "
            f"{_band(runs, 'reward_obstacle_cost', slice(0, 5))} and "
            f"{_band(runs, 'reward_obstacle_cost', slice(25, 30))}",
            greedy,
            "; ".join(
                f"{name.replace('_', ' ')}: return {rows['return'].mean():.1f}, obstacle cost "
                f"{rows['reward_obstacle_cost'].mean():.1f}"
                for name, rows in baselines.items()
            ),
            f"without averaging the pixels: {len(pixels)} of 10 runs so far",
        ),
        f"{len(runs)} (not given)",
        "pixels are averaged five by five before the first layer; an action lasts five control steps; the preset "
        "tqc_fast",
        ("reproduction/tables/narrow_passage_images.csv", "reproduction/tables/narrow_passage_images_evaluated.csv"),
        "python -m research.thesis --figure 4.7 --resume",
        sum(float(run["wall_time"].sum()) for run in runs) / 3600,
    )


EARLIER_CONTACT = (
    "in an earlier contact at a plant step of 10 ms, which had not converged "
    "([converged contact](../../docs/experiments.md#converged-contact-of-the-connector))"
)
AT_10_HZ = (
    f"in simulation, on the gantry at 10 Hz, {EARLIER_CONTACT}; scripted demonstrations, own connector, stiffness and "
    "scales ([the connector at 10 Hz](../../docs/thesis.md#the-connector-at-10-hz))"
)
CONNECTOR_STUDY = "guiderail study research/studies/connector_10hz.yaml --out studies"


def _connector_rows(method: str) -> pd.DataFrame:
    rows = read_table(RESULTS / "connector_10hz.csv")
    return rows[rows["method"] == method]


def _connector_sentence(method: str, label: str) -> str:
    rows = _connector_rows(method)
    last, returns = rows["training_success_rate_last_10"], rows["training_mean_return_last_10"]
    is_one = last == 1.0
    converged = ", ".join("never" if pd.isna(v) else f"{v:.0f}" for v in rows["training_episodes_to_convergence"])
    steps = rows["training_total_steps"] / rows["training_episodes"]
    return (
        f"{label}, {len(rows)} runs: success in the first 35 of 45 training episodes "
        f"{_percent(_success_before_last_10(rows))}, in the last ten {_percent(last.mean())} (in all of them with "
        f"{is_one.sum()} runs), held out {_percent(rows['success_rate'].mean(), 1)}; return of the last ten "
        f"{returns.mean():.1f}, with those {is_one.sum()} runs {returns[is_one].mean():.1f}; ten successes in a row, "
        f"which the thesis counts for pouring only, begin after {converged} episodes; mean squared force in training "
        f"{rows['training_mean_squared_force'].mean():.0f} N², of the final policies "
        f"{rows['mean_squared_force'].mean():.0f} N²; control steps of an episode {steps.mean():.1f} and "
        f"{rows['mean_steps'].mean():.1f}"
    )


def _success_before_last_10(rows: pd.DataFrame) -> float:
    """Return the mean success rate of the training episodes before the last ten."""
    number = rows["training_episodes"]
    successes = number * rows["training_success_rate"] - 10 * rows["training_success_rate_last_10"]
    return float((successes / (number - 10)).mean())


def _demonstration_alone(tables: Path) -> Entry:
    """Return the entry of figures 4.1 and 5.1."""
    slow = read_table(RESULTS / "connector_thesis.csv")
    slow = slow[slow["method"] == "demonstration"]
    evaluated = _read(tables, "connector_10hz_evaluated")
    at_10_hz = pd.DataFrame() if evaluated is None else evaluated[evaluated["method"] == "demonstration"]
    num_slow, num_fast = int(slow["episodes"].sum()), len(at_10_hz)
    success_slow = int((slow["success_rate"] * slow["episodes"]).sum())
    success_fast = int(at_10_hz["success"].sum()) if num_fast else 0
    stored: tuple[str, ...] = ("results/connector_thesis.csv",)
    return Entry(
        ("4.1", "5.1"),
        HOLDS if not success_slow + success_fast else f"{PARTLY}: the demonstrations' motion succeeds in some episodes",
        "success of the demonstrations' motion without actions, with a hidden offset",
        (
            f"at 50 Hz {success_slow} of {num_slow} episodes succeed ({len(slow)} offsets)",
            f"at 10 Hz {success_fast} of {num_fast} episodes succeed"
            + (f" ({at_10_hz['seed'].nunique()} offsets)" if num_fast else ""),
        ),
        f"{len(slow) + (at_10_hz['seed'].nunique() if num_fast else 0)} offsets (not given)",
        f"in simulation, on the gantry, at 50 Hz {EARLIER_CONTACT}, at 10 Hz in the present contact; scripted "
        "demonstrations",
        stored if evaluated is None else (*stored, "reproduction/tables/connector_10hz_evaluated.csv"),
        "python -m research.thesis --figure 4.1 --resume",
    )


def _connector() -> Entry:
    random = _connector_rows("uniform_random")
    success = _percent(random["success_rate"].mean())
    rows = _connector_rows("kgrl")
    num_weaker = (rows["mean_squared_force"] < rows["training_mean_squared_force"]).sum()
    num_shorter = (rows["mean_steps"] < rows["training_total_steps"] / rows["training_episodes"]).sum()
    return Entry(
        ("4.8",),
        f"{PARTLY}: {_percent(rows['training_success_rate_last_10'].mean())} of the last ten of 45 episodes succeed, "
        f"but {success} with random actions; less force in {num_weaker} and shorter episodes in {num_shorter} of "
        f"{len(rows)} runs",
        "success in training; force and steps of the final policy in held-out episodes, compared with training",
        (
            _connector_sentence("kgrl", "KGRL"),
            f"uniform random actions through KGRL's guidance lock {success} of held-out episodes, with a mean squared "
            f"force of {random['mean_squared_force'].mean():.0f} N² in {random['mean_steps'].mean():.1f} control steps",
        ),
        f"{len(rows)} (not given)",
        AT_10_HZ,
        ("results/connector_10hz.csv",),
        CONNECTOR_STUDY,
        float(rows["training_wall_time"].sum()) / 3600,
    )


def _present_runs(tables: Path) -> dict[str, list[pd.DataFrame]]:
    """Return the first ten training episodes of the stored runs in the present contact by method."""
    table = _read(tables, "connector_10hz")
    if table is None:
        return {}
    return {method: [run.head(10) for run in _runs_of(table, method)] for method in ("kgrl", "skgrl")}


def _connector_comparison(tables: Path) -> Entry:
    kgrl, skgrl = (_connector_rows(method) for method in ("kgrl", "skgrl"))
    success = [_percent(rows["training_success_rate_last_10"].mean()) for rows in (kgrl, skgrl)]
    column = "training_mean_return_last_10"
    is_higher = kgrl[column].mean() > skgrl[column].mean()
    returns = "KGRL's return is higher" if is_higher else "sKGRL's return is higher, not KGRL's"
    return Entry(
        ("5.9",),
        f"{PARTLY}: {success[0]} (KGRL) and {success[1]} (sKGRL) of the last ten of 45 episodes succeed; {returns}",
        "success and return of the last ten training episodes",
        (
            _connector_sentence("kgrl", "KGRL"),
            _connector_sentence("skgrl", "sKGRL"),
            *(
                f"in the present contact {_percent(pd.concat(runs)['success'].mean())} of the first ten training "
                f"episodes of {len(runs)} runs of {method.replace('kgrl', 'KGRL')} succeed"
                for method, runs in _present_runs(tables).items()
            ),
        ),
        f"{len(skgrl)} (10)",
        AT_10_HZ,
        ("results/connector_10hz.csv", "reproduction/tables/connector_10hz.csv"),
        CONNECTOR_STUDY,
        float(skgrl["training_wall_time"].sum()) / 3600,
    )


def _jerk(tables: Path) -> Entry:
    columns = {
        "jerk_commanded_linear": "command, linear",
        "jerk_commanded_angular": "command, angular",
        "jerk_measured_linear": "measured pose, linear",
        "jerk_measured_angular": "measured pose, angular",
    }
    earlier = {
        column: _connector_rows("kgrl")[stored].mean() / _connector_rows("skgrl")[stored].mean()
        for column in columns
        if (stored := f"training_{column}_first_10") in _connector_rows("kgrl")
    }
    ours = [f"{label}: {earlier[column]:.1f} times" for column, label in columns.items() if column in earlier]
    stored_files: tuple[str, ...] = ("results/connector_10hz.csv",)
    if runs := _present_runs(tables):
        means = {method: pd.concat(own)[list(columns)].mean() for method, own in runs.items()}
        ratios = ", ".join(f"{label} {means['kgrl'][c] / means['skgrl'][c]:.1f} times" for c, label in columns.items())
        ours.append(f"in the present contact, {len(runs['skgrl'])} runs: {ratios}")
        stored_files += ("reproduction/tables/connector_10hz.csv",)
    return Entry(
        ("5.10",),
        f"{PARTLY}: {earlier['jerk_commanded_angular']:.0f} times smaller in rotation, "
        f"{earlier['jerk_commanded_linear']:.0f} times in translation",
        "mean jerk of the first ten training episodes, KGRL's divided by sKGRL's",
        tuple(ours),
        f"{len(_connector_rows('skgrl'))} (10)",
        f"{AT_10_HZ}; the thesis measures the pose of the arm's end effector; the angular jerk of the measured pose is "
        "stored for the present contact only",
        stored_files,
        f"{CONNECTOR_STUDY}` and `python -m research.thesis --figure 5.10 --resume",
    )


def _smooth_exploration() -> Entry:
    return _computed(
        "5.5",
        "jerk of random actions at the same RMS, with the thesis's ρ = 1e-06 and an action at every control step",
        "own dimensions",
    )


def _return_comparison(tables: Path) -> Entry:
    table = read_table(tables / "thesis_narrow_passage.csv")
    names = {
        "kgrl": "KGRL, a new action every five steps",
        "skgrl": "sKGRL, a new action every five steps",
        "kgrl_constant": "KGRL, one action in each of the first ten episodes",
        "skgrl_constant": "sKGRL, one action in each of the first ten episodes",
    }
    runs = {method: _runs_of(table, method) for method in names}
    final = {method: _mean(runs[method], "return", slice(50, 60))[0] for method in names}
    ours = [
        f"{label}: return of the last ten episodes {_band(runs[method], 'return', slice(50, 60))}; action cost of the "
        f"first ten {_band(runs[method], 'reward_action_cost', slice(0, 10), '{:.2f}')}, of the last ten "
        f"{_band(runs[method], 'reward_action_cost', slice(50, 60), '{:.2f}')}; obstacle avoided from episode "
        f"{_each(runs[method], lambda run: avoided_at(run['reward_obstacle_cost']))}"
        for method, label in names.items()
    ]
    higher = [final[f"skgrl{kind}"] > final[f"kgrl{kind}"] for kind in ("", "_constant")]
    verdict = HOLDS if all(higher) else f"{NOT}: KGRL has the higher return"
    if any(higher) and not all(higher):
        number = sum(float(run["return"].iloc[50:].mean()) > final["kgrl"] for run in runs["skgrl"])
        never = sum(avoided_at(run["reward_obstacle_cost"]) is None for run in runs["skgrl"])
        verdict = (
            f"{PARTLY}: lower cost of actions and later avoidance; higher return in {number} of {len(runs['skgrl'])} "
            f"runs, {never} never avoid the obstacle; after constant actions a higher return, but no later avoidance"
        )
    return Entry(
        ("5.6",),
        verdict,
        "mean return of the last ten episodes, action cost, and first five episodes with a mean obstacle cost above −5",
        tuple(ours),
        f"{len(runs['skgrl'])} (10)",
        "as figure 4.5; the methods with constant actions repeat one random action in each of the first ten episodes",
        ("reproduction/tables/thesis_narrow_passage.csv",),
        "python -m research.thesis --figure 5.6 --resume",
        _hours(table, ("skgrl", "kgrl_constant", "skgrl_constant")),
    )
