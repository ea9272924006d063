"""Figures 3.5, 3.6 and 3.8 and table 3.3: pouring learned with and without a shared control template."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.diagrams.tasks.pouring import make_skill
from guiderail.diagrams.tasks.pouring_rewards import APPROACH, NEAR, NEAR_BONUS, TERMINAL, TILT
from guiderail.models.skills.drawing import draw, state_lines
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.studies.pouring_study import FIRST_SEED, METHODS, job, training_row
from guiderail.tools.studies.study import Job, run_jobs, write_table
from guiderail.tools.viewing.style import draw_runs, legend, new_figure, save_figure

COLOURS = {"rl_sparse": "#d62728", "rl_shaped": "#e6a700", "rl_sct_sparse": "#1f77b4", "rl_sct_shaped": "#2ca02c"}
ENDINGS = ("success", "spill", "collision")
TICKS = (10, 20, 50, 100, 200, 500)  # episodes
CONDITION = (
    "an iiwa in simulation; the preset 'pouring'; an action lasts 10 control steps, and 40 where the reward is sparse; "
    "the template's inputs are 1.7 times as fast there"
)


def figure_3_5(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """SAC: success, spill and collision rate over the episodes."""
    return _learning_curves(out, "3_5", "sac", seeds, episodes)


def figure_3_6(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """TQC: the same."""
    return _learning_curves(out, "3_6", "tqc", seeds, episodes)


def figure_3_8(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Episodes until ten in a row succeeded, and how many of a hundred spilled or collided, with both learners."""
    figure, axes = new_figure(3, 2, (9, 9))
    rows: list[dict[str, Any]] = []
    for column, algorithm in enumerate(("sac", "tqc")):
        found = [_row(result) for result in _results(out, METHODS, algorithm, seeds, episodes)]
        rows += found
        axes[0, column].set_title(algorithm.upper())
        for axis, key, label in zip(
            axes[:, column],
            ("ten_in_a_row_at", "spill_percent", "collision_percent"),
            ("episodes until ten in a row", "% of episodes that spill", "% that collide"),
            strict=True,
        ):
            _boxes(axis, found, key)
            axis.set_ylabel(label)
    for axis in axes[0]:
        axis.set(yscale="log", yticks=TICKS)
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("")
    for row in axes[1:]:
        top = max(axis.get_ylim()[1] for axis in row)
        for axis in row:
            axis.set_ylim(-0.05 * top, top)
    return {
        "picture": str(save_figure(figure, out / "figure_3_8.png")),
        "table": str(write_table(out / "figure_3_8", rows)),
        **{f"{name}, {key}": value for name in ("sac", "tqc") for key, value in _said(rows, name).items()},
        "condition": CONDITION,
    }


def table_3_3(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """What is known about pouring, once as a reward and once as a template; and what that comes to while learning."""
    skill = make_skill(PouringConfig())
    collision = f"collision {TERMINAL['collision']:g}"
    far = f"{APPROACH:g} a metre gained; turning about any axis -0.25 a radian; {collision}"
    near = (
        f"{APPROACH:g} a metre gained; {NEAR_BONUS:g} a decision within {1e3 * NEAR:g} mm; "
        f"tilting towards the mug {TILT / 4:g} a radian, turning otherwise -0.25; {collision}"
    )
    rows = [
        {
            "state": state.name,
            "reward function": near if state is skill.states[-1] else far,
            "shared control template": "; ".join(state_lines(state)),
        }
        for state in skill.states
    ]
    results = _results(out, ("rl_shaped", "rl_sct_shaped"), "sac", seeds, episodes)
    outcomes = [_row(result) for result in results]
    rows.append(
        {
            "state": "what it comes to (SAC)",
            "reward function": _outcome(outcomes, "rl_shaped"),
            "shared control template": _outcome(outcomes, "rl_sct_shaped"),
        }
    )
    picture = out / "table_3_3.png"
    out.mkdir(parents=True, exist_ok=True)
    draw(skill, picture)
    return {
        "picture": str(picture),
        "table": str(write_table(out / "table_3_3", rows)),
        **_said(outcomes, "sac"),
        "condition": CONDITION,
    }


def _results(
    out: Path, methods: Iterable[str], algorithm: str, seeds: int, episodes: int | None
) -> list[dict[str, Any]]:
    """Runs and their episodes: of whatever seeds the folder has, and of more where those are fewer than `seeds`."""
    jobs: list[Job] = []
    for method in methods:
        folder = job(out, method, algorithm, FIRST_SEED, episodes).folder
        done = folder.parent.glob(folder.name.removesuffix(str(FIRST_SEED)) + "*/policy.json")
        found = sorted(int(file.parent.name.split("-")[-1]) for file in done)
        others = (seed for seed in itertools.count(FIRST_SEED) if seed not in found)
        wanted = found + list(itertools.islice(others, max(seeds - len(found), 0)))
        jobs += [job(out, method, algorithm, seed, episodes) for seed in sorted(wanted)]
    return [
        result | {"algorithm": algorithm, "rows": RunFolder(result["folder"]).episodes()} for result in run_jobs(jobs)
    ]


def _row(result: Mapping[str, Any]) -> dict[str, Any]:
    """A run in a figure's table."""
    rows = result["rows"]
    counted = training_row(rows)
    return {
        "method": result["name"],
        "algorithm": result["algorithm"],
        "seed": result["seed"],
        **counted,
        **{f"{what}_percent": 100.0 * counted[key] / len(rows) for what, key in zip(ENDINGS, _COUNTS, strict=True)},
        "worst_violation": result["worst_violation"],
        "wall_time": result["wall_time"],
    }


_COUNTS = ("successes", "spills", "collisions")


def _learning_curves(out: Path, number: str, algorithm: str, seeds: int, episodes: int | None) -> dict[str, Any]:
    results = _results(out, METHODS, algorithm, seeds, episodes)
    figure, (axes,) = new_figure(1, 3, (13, 4.2))
    for axis, ending in zip(axes, ENDINGS, strict=True):
        for name, method in METHODS.items():
            runs = [[row["termination"] == ending for row in one["rows"]] for one in results if one["name"] == name]
            label = f"{method.label} ({len(runs)} {'run' if len(runs) == 1 else 'runs'})"
            draw_runs(axis, runs, colour=COLOURS[name], label=label)
        axis.set(xlabel="episode", ylabel=f"{ending} rate (mean of 10)", xscale="log", ylim=(-0.04, 1.04))
        axis.xaxis.set_major_formatter("{x:g}")
    legend(figure, axes[0])
    rows = [_row(result) for result in results]
    return {
        "picture": str(save_figure(figure, out / f"figure_{number}.png")),
        "table": str(write_table(out / f"figure_{number}", rows)),
        **_said(rows, algorithm),
        "condition": CONDITION,
    }


def _boxes(axis: Axes, rows: Sequence[Mapping[str, Any]], key: str) -> None:
    """A box and every run's own point; a run that never got there is an open one at its last episode."""
    for place, method in enumerate(METHODS):
        of_method = [row for row in rows if row["method"] == method]
        there = [row[key] for row in of_method if row[key] is not None]
        never = [row["episodes"] for row in of_method if row[key] is None]
        if there:
            axis.boxplot([there], positions=[place], widths=0.5, showfliers=False, medianprops={"color": "0.2"})
        axis.scatter([place] * len(there), there, color=COLOURS[method], s=22, zorder=3)
        axis.scatter([place] * len(never), never, facecolors="none", edgecolors=COLOURS[method], marker="^", s=40)
        if never:
            axis.annotate("never", (place, max(never)), xytext=(0, 6), textcoords="offset points", ha="center")
    axis.set_xticks(range(len(METHODS)), [method.label for method in METHODS.values()], fontsize=7)
    axis.axvline(1.5, color="0.8", linewidth=0.8)
    axis.set_xlim(-0.6, len(METHODS) - 0.4)
    axis.margins(y=0.15)


def _said(rows: Sequence[Mapping[str, Any]], algorithm: str) -> dict[str, str]:
    """Each run's own numbers."""
    said = {}
    for name, method in METHODS.items():
        of_method = [row for row in rows if row["method"] == name and row["algorithm"] == algorithm]
        if of_method:
            reached = ", ".join(str(row["ten_in_a_row_at"] or "never") for row in of_method)
            said[f"{method.label}, ten in a row at episode"] = reached
            said[f"{method.label}, spills and collisions"] = ", ".join(
                f"{row['spills']} and {row['collisions']} of {row['episodes']}" for row in of_method
            )
    return said


def _outcome(rows: Sequence[Mapping[str, Any]], method: str) -> str:
    of_method = [row for row in rows if row["method"] == method]
    percent = {what: float(np.mean([row[f"{what}_percent"] for row in of_method])) for what in ENDINGS}
    return ", ".join(f"{value:.0f} % {what}" for what, value in percent.items()) + f" (runs: {len(of_method)})"
