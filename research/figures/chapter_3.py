"""Figures 3.4 to 3.8 and table 3.3 (pouring), 3.10 and 3.11 (the grid clamp): with and without a template."""

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from guiderail.diagrams.stations.pouring import PouringConfig
from guiderail.diagrams.tasks.pouring import APPROACH, NEAR, NEAR_BONUS, TERMINAL, TILT, make_template
from guiderail.systems.support.drake_multibody import pose_to_transform
from guiderail.tools.environments import make_environment
from guiderail.tools.tables import write_table
from guiderail.tools.visualization.figures import legend, new_figure
from guiderail_data.template_drawing import draw, state_lines
from guiderail_studies.job import Job
from guiderail_studies.report import draw_runs
from guiderail_studies.study import ratio, run_study
from research.figures.runs import (
    episodes_of,
    figure_study,
    learning_curves,
    numbers_of_seeds,
    save_results,
    settings_table,
)
from research.figures.thesis import TABLE_3_2

METHODS = {
    "rl_sparse": ("RL-Sparse", "#d62728"),
    "rl_shaped": ("RL-Shaped", "#e6a700"),
    "rl_sct_sparse": ("RL-SCT-Sparse", "#1f77b4"),
    "rl_sct_shaped": ("RL-SCT-Shaped", "#2ca02c"),
}
NAMES = {method: name for method, (name, _) in METHODS.items()}
FORCE = {"sct": ("with the cost of force", "#2ca02c"), "sct_no_force": ("without it", "#d62728")}
ENDINGS = ("success", "spill", "collision")  # terminations that are counted
TICKS = (1, 10, 20, 50, 100, 200, 500)  # ticks of the axis of episodes
POURING = (
    "an iiwa in simulation; the preset 'pouring'; an action lasts 10 control steps, and 40 where the reward is sparse; "
    "the template's inputs are 1.7 times as fast there"
)
CLAMP = (
    "in simulation, on the gantry, SAC with the preset sac_gridclamp; a hidden table offset of 1.8 to 2.2 mm per run "
    "and six grasp offsets of up to 1 mm; the thesis: a real robot, five sessions of 70 episodes"
)


def figure_3_4(out: Path) -> dict[str, Any]:
    """Render the scene with the frames of the tips of thermos and mug."""
    env: Any = make_environment("Pouring", {"guidance": "sct"}, render_mode="rgb_array")
    env.reset(seed=0)
    diagram, task = env.unwrapped.diagram.diagram, env.unwrapped.diagram.task
    X_WT = PouringConfig().X_WT
    pose = diagram.GetOutputPort("pose").Eval(env.unwrapped.simulator.get_context())
    frames = {"mug tip": X_WT, "thermos tip": X_WT @ pose_to_transform(pose)}
    figure, ((axis,),) = new_figure(1, 1, (7.2, 5.4))
    axis.imshow(env.render())
    env.close()
    rows = []
    for name, X_WF in frames.items():
        tips = [X_WF.translation() + 0.06 * X_WF.rotation().col(i) for i in range(3)]
        (u, v), *ends = task.scene().camera.project(np.stack([X_WF.translation(), *tips]))
        for (x, y), color in zip(ends, ("red", "green", "blue"), strict=True):
            axis.annotate("", (x, y), (u, v), arrowprops={"arrowstyle": "->", "color": color, "linewidth": 1.6})
        axis.annotate(name, (u, v), xytext=(8, 10), textcoords="offset points", color="black", fontsize=9)
        rows.append({"frame": name} | dict(zip("xyz", X_WF.translation().tolist(), strict=True)))
    axis.set_axis_off()
    return save_results(out, "figure_3_4", figure, rows)


def figure_3_7(out: Path, seeds: int = 5, episodes: int | None = None) -> dict[str, Any]:
    """Draw success, spills and return of RL-SCT-Shaped with SAC, in simulation; the thesis used a real robot."""
    rows = _pouring(out, "sac", seeds, episodes, ("rl_sct_shaped",))
    figure, (axes,) = new_figure(1, 3, (13, 4.2))
    runs, (name, shade) = episodes_of(rows, "rl_sct_shaped"), METHODS["rl_sct_shaped"]
    values = {"success rate": [run["termination"] == "success" for run in runs]}
    values |= {"spill rate": [run["termination"] == "spill" for run in runs], "return": [run["return"] for run in runs]}
    for axis, (quantity, series) in zip(axes, values.items(), strict=True):
        draw_runs(axis, series, color=shade, label=f"{name} ({len(runs)} runs)")
        axis.set(xlabel="episode", ylabel=f"{quantity} (mean of 10)")
        if quantity.endswith("rate"):
            axis.set_ylim(-0.04, 1.04)
    return {**save_results(out, "figure_3_7", figure, rows), **_run_numbers(rows), "condition": POURING}


def figure_3_5(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw success, spill and collision rate over the episodes with SAC."""
    return _endings(out, "3_5", "sac", seeds, episodes)


def figure_3_6(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw success, spill and collision rate over the episodes with TQC."""
    return _endings(out, "3_6", "tqc", seeds, episodes)


def figure_3_8(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw episodes to convergence and the percentages of spills and collisions with both learners."""
    figure, axes = new_figure(3, 2, (9, 9))
    tables = {algorithm: _pouring(out, algorithm, seeds, episodes) for algorithm in ("sac", "tqc")}
    for column, (algorithm, rows) in enumerate(tables.items()):
        axes[0, column].set_title(algorithm.upper())
        for axis, key, label in zip(
            axes[:, column],
            ("training_episodes_to_convergence", "spill_percent", "collision_percent"),
            ("episodes to convergence", "% of episodes that end in a spill", "% that end in a collision"),
            strict=True,
        ):
            _boxes(axis, rows, key)
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
        **save_results(out, "figure_3_8", figure, pd.concat(tables.values())),
        **{f"{name}, {key}": value for name, rows in tables.items() for key, value in _run_numbers(rows).items()},
        "condition": POURING,
    }


def table_3_2(out: Path) -> dict[str, Any]:
    """Compare the thesis's learner settings for templates with those of the presets."""
    return settings_table(out / "table_3_2", TABLE_3_2, ("pouring", "sac_gridclamp"))


def table_3_3(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Compare prior knowledge about pouring as a reward function and as a template, with the endings in training."""
    template = make_template(PouringConfig())
    collision = f"collision {TERMINAL['collision']:g}"
    far = f"{APPROACH:g} per meter gained; turning about any axis -0.25 per radian; {collision}"
    near = (
        f"{APPROACH:g} per meter gained; {NEAR_BONUS:g} per action within {1e3 * NEAR:g} mm; "
        f"tilting towards the mug {TILT / 4:g} per radian, turning otherwise -0.25; {collision}"
    )
    result = _pouring(out, "sac", seeds, episodes, ("rl_shaped", "rl_sct_shaped"))
    rows = [
        {
            "state": state.name,
            "reward function": near if state is template.states[-1] else far,
            "shared control template": "; ".join(state_lines(state)),
        }
        for state in template.states
    ]
    endings = {
        method: ", ".join(f"{runs[f'{ending}_percent'].mean():.0f} % {ending}" for ending in ENDINGS)
        + f" (runs: {len(runs)})"
        for method, runs in result.groupby("method")
    }
    described = {"reward function": endings["rl_shaped"], "shared control template": endings["rl_sct_shaped"]}
    rows.append({"state": "endings in training (SAC)", **described})
    picture = out / "table_3_3.png"
    draw(template, picture)
    table = write_table(out / "table_3_3", rows)
    return {"picture": str(picture), "table": str(table), **_run_numbers(result), "condition": POURING}


def _pouring(
    out: Path, algorithm: str, seeds: int, episodes: int | None, methods: tuple[str, ...] = tuple(METHODS)
) -> pd.DataFrame:
    """Return a row for each run: of all finished seeds in the folder, and of new seeds until there are `seeds` runs."""
    study = figure_study(f"pouring_{algorithm}", seeds=seeds, episodes=episodes, methods=methods, evaluate=False)
    selected = {}
    for method, known in study.methods.items():
        folder = Job(study, method, study.seeds[0], out).folder.path
        done = folder.parent.glob(folder.name.removesuffix(str(study.seeds[0])) + "*/policy.json")
        result = sorted(int(file.parent.name.split("-")[-1]) for file in done)
        others = (seed for seed in itertools.count(study.seeds[0]) if seed not in result)
        seeds_of = sorted(result + list(itertools.islice(others, max(seeds - len(result), 0))))
        selected[method] = known.model_copy(update={"seeds": tuple(seeds_of)})
    rows = run_study(study.model_copy(update={"methods": selected}), out)
    percent = {f"{e}_percent": 100.0 * rows[f"training_ended_in_{e}"] / rows["training_episodes"] for e in ENDINGS}
    return rows.assign(**percent)


def _endings(out: Path, number: str, algorithm: str, seeds: int, episodes: int | None) -> dict[str, Any]:
    rows = _pouring(out, algorithm, seeds, episodes)
    figure, (axes,) = new_figure(1, 3, (13, 4.2))
    for method, (name, shade) in METHODS.items():
        runs = episodes_of(rows, method)
        label = f"{name} ({len(runs)} {'run' if len(runs) == 1 else 'runs'})"
        for axis, ending in zip(axes, ENDINGS, strict=True):
            draw_runs(axis, [run["termination"] == ending for run in runs], color=shade, label=label)
    for axis, ending in zip(axes, ENDINGS, strict=True):
        axis.set(xlabel="episode", ylabel=f"{ending} rate (mean of 10)", xscale="log", ylim=(-0.04, 1.04))
        axis.xaxis.set_major_formatter("{x:g}")
    legend(figure, axes[0])
    return {**save_results(out, f"figure_{number}", figure, rows), **_run_numbers(rows), "condition": POURING}


def _boxes(axis: Axes, rows: pd.DataFrame, key: str) -> None:
    """Draw a box and a point for every run; a run that did not converge is an open point at its last episode."""
    for position, (method, (_, shade)) in enumerate(METHODS.items()):
        of_method = rows[rows["method"] == method]
        reached = of_method[key].dropna().astype(float)
        never = of_method[of_method[key].isna()]["training_episodes"]
        if len(reached):
            axis.boxplot([reached], positions=[position], widths=0.5, showfliers=False, medianprops={"color": "0.2"})
        axis.scatter([position] * len(reached), reached, color=shade, s=22, zorder=3)
        axis.scatter([position] * len(never), never, facecolors="none", edgecolors=shade, marker="^", s=40)
        if len(never):
            axis.annotate("never", (position, max(never)), xytext=(0, 6), textcoords="offset points", ha="center")
    axis.set_xticks(range(len(METHODS)), NAMES.values(), fontsize=7)
    axis.axvline(1.5, color="0.8", linewidth=0.8)
    axis.set_xlim(-0.6, len(METHODS) - 0.4)
    axis.margins(y=0.15)


def _run_numbers(rows: pd.DataFrame) -> dict[str, str]:
    """Return the numbers of each run."""
    return numbers_of_seeds(
        rows,
        {
            "training_episodes_to_convergence": ("episodes to convergence", "{}"),
            "training_ended_in_spill": ("episodes that ended in a spill", "{}"),
            "training_ended_in_collision": ("episodes that ended in a collision", "{}"),
        },
        NAMES,
    )


def figure_3_10(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw success, mean squared force and length of each episode."""
    return _clamp(
        out,
        "figure_3_10",
        figure_study("grid_clamp_figures", seeds=seeds, episodes=episodes),
        {"success": "success", "mean_squared_force": "mean squared force [N²]", "steps": "control steps of 20 ms"},
        {
            "training_episodes_to_convergence": ("episodes to convergence", "{}"),
            "success_rate": ("held-out success", "{:.0%}"),
            "training_mean_squared_force": ("mean squared force of each seed [N²]", "{:.1f}"),
        },
    )


def figure_3_11(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw the return of each reward function. The two scales differ and cannot be compared."""
    return _clamp(
        out,
        "figure_3_11",
        figure_study("grid_clamp_figures", seeds=seeds, episodes=episodes, evaluate=False),
        {"return": "return of an episode"},
        {"training_mean_return_last_10": ("return of the last ten episodes, each seed", "{:.1f}")},
    )


def _clamp(
    out: Path, name: str, study: Any, columns: Mapping[str, str], numbers: Mapping[str, tuple[str, str]]
) -> dict[str, Any]:
    rows = run_study(study, out)
    size = (13.0, 4.0) if len(columns) > 1 else (7.0, 4.2)
    figure, _ = learning_curves(rows, columns, (1, len(columns)), size, lines=FORCE)
    names = {method: name for method, (name, _) in FORCE.items()}
    ratios = {k: v for declared in study.ratios for k, v in ratio(rows, declared).items()} if len(columns) > 1 else {}
    return {
        **save_results(out, name, figure, rows),
        **numbers_of_seeds(rows, numbers, names),
        **ratios,
        "condition": CLAMP,
    }
