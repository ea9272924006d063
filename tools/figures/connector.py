"""Figures 4.8, 5.8, 5.9 and 5.10: KGRL and sKGRL learn the bayonet connector, in simulation."""

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.tasks.bnc_connector import ALIGNMENT
from guiderail.models.demonstrations import bnc_connector
from guiderail.tools.figures import runs
from guiderail.tools.guidance import COLOURS, NAMES
from guiderail.tools.rollouts.rollout import run_episode
from guiderail.tools.studies.study import write_table
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.style import legend, new_figure, save_figure

TASK = "BncConnector"
METHODS = ("kgrl", "skgrl")
EPISODES, PRESET, EVALUATIONS = 45, "robust", 25
ENVIRONMENT = {"uncertainty": "calibration", "reward": "shaped"}
CONDITION = (
    "in simulation, on rails; a hidden offset of 1.0 to 1.5 mm per run and a few tenths per episode; the robust "
    "preset, actions in x and y held ten control steps; the thesis's reward and 5 per millimetre of depth"
)


def figure_4_8(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """KGRL: success, return, interaction force and episode length."""
    results = _train(out, ("kgrl",), seeds, episodes)
    figure, axes = new_figure(2, 2, (10, 7))
    for axis, (column, label) in zip(
        axes.flat,
        (
            ("success", "success"),
            ("return", "return"),
            ("mean_force", "mean contact force [N]"),
            ("steps", "control steps"),
        ),
        strict=True,
    ):
        runs.draw_learning(axis, results, ("kgrl",), column, label)
    rows = [runs.table_row(result) for result in results]
    return {
        "picture": str(save_figure(figure, out / "figure_4_8.png")),
        "table": str(write_table(out / "figure_4_8", rows)),
        **_learned(rows, ("kgrl",)),
        "condition": CONDITION,
    }


def figure_5_8(out: Path, seeds: int = 1, episodes: int = 3) -> dict[str, Any]:
    """Where exploring motions go: x and y over time, commanded and measured."""
    figure, axes = new_figure(2, 2, (11, 6.4))
    rows: list[dict[str, Any]] = []
    for index, kind in enumerate(METHODS):
        for row, commanded, measured, period in _wander(kind, seeds, episodes):
            time = period * np.arange(1, len(commanded) + 1)
            for output, name in enumerate("xy"):
                axis = axes[output, index]
                axis.plot(time, 1e3 * commanded[:, output], color=COLOURS[kind], linewidth=0.8)
                axis.plot(time, 1e3 * measured[:, output], color="0.5", linewidth=0.8)
                axis.set(ylabel=f"{name} [mm]", xlabel="time [s]")
            rows.append({"method": kind, **{key: row[key] for key in row if key.startswith(("jerk", "worst", "peak"))}})
        axes[0, index].set_title(f"{NAMES[kind]}: commanded, and measured in grey")
    for axis in axes.flat:
        for bound in (-1e3 * ALIGNMENT, 1e3 * ALIGNMENT):
            axis.axhline(bound, color="firebrick", linewidth=0.8)
        axis.set_ylim(-1.2e3 * ALIGNMENT, 1.2e3 * ALIGNMENT)
    return {
        "picture": str(save_figure(figure, out / "figure_5_8.png")),
        "table": str(write_table(out / "figure_5_8", rows)),
        "demonstrations": len(bnc_connector.load().outputs),
        "condition": "random actions in x and y, held ten control steps, gains calibrated by authority",
    }


def figure_5_9(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """Success and return of both while learning, and held-out success afterwards."""
    results = _train(out, METHODS, seeds, episodes)
    figure, (axes,) = new_figure(1, 3, (13, 4))
    for axis, (column, label) in zip(
        axes, (("success", "success"), ("return", "return"), ("mean_force", "mean contact force [N]")), strict=True
    ):
        runs.draw_learning(axis, results, METHODS, column, label)
    legend(figure, axes[0])
    rows = [runs.table_row(result) for result in results]
    return {
        "picture": str(save_figure(figure, out / "figure_5_9.png")),
        "table": str(write_table(out / "figure_5_9", rows)),
        **_learned(rows, METHODS),
        "condition": CONDITION,
    }


def figure_5_10(out: Path, seeds: int = 3, episodes: int = EPISODES) -> dict[str, Any]:
    """Mean jerk of the first ten training episodes, linear and angular, commanded and measured."""
    results = _train(out, METHODS, seeds, episodes, evaluations=0)
    figure, (axes,) = new_figure(1, 2, (10, 4.4))
    rows: list[dict[str, Any]] = []
    for axis, part, unit in zip(axes, ("linear", "angular"), ("m/s³", "rad/s³"), strict=True):
        boxes, labels = [], []
        for kind in METHODS:
            for which in ("commanded", "measured"):
                values = [value for run in runs.runs_of(results, kind, f"jerk_{which}_{part}") for value in run[:10]]
                boxes.append(values)
                labels.append(f"{NAMES[kind]}\n{which}")
                rows.append(
                    {
                        "part": part,
                        "method": kind,
                        "which": which,
                        "median": float(np.median(values)),
                        "lowest": float(np.min(values)),
                        "highest": float(np.max(values)),
                    }
                )
        axis.boxplot(boxes, tick_labels=labels)
        axis.set(yscale="log", ylabel=f"mean {part} jerk [{unit}]")
    ratio = {(row["part"], row["which"], row["method"]): row["median"] for row in rows}
    return {
        "picture": str(save_figure(figure, out / "figure_5_10.png")),
        "table": str(write_table(out / "figure_5_10", rows)),
        **{
            f"sKGRL's {part} jerk below KGRL's, {which}": (
                f"{ratio[part, which, 'kgrl'] / max(ratio[part, which, 'skgrl'], 1e-12):.1f} times"
            )
            for part in ("linear", "angular")
            for which in ("commanded", "measured")
        },
        "condition": CONDITION + "; gains calibrated by authority, not by RMS",
    }


def _train(
    out: Path, guidance: tuple[str, ...], seeds: int, episodes: int, evaluations: int = EVALUATIONS
) -> list[dict[str, Any]]:
    return runs.train_all(
        out,
        TASK,
        guidance,
        seeds=seeds,
        episodes=episodes,
        preset=PRESET,
        environment=ENVIRONMENT,
        evaluations=evaluations,
    )


def _learned(rows: list[dict[str, Any]], guidance: tuple[str, ...]) -> dict[str, str]:
    """Each seed's own numbers."""
    said = {}
    for kind in guidance:
        said[f"{NAMES[kind]}, ten in a row after episode"] = runs.of_each_seed(rows, kind, "converged_after")
        said[f"{NAMES[kind]}, held-out success"] = runs.of_each_seed(rows, kind, "held_out_success", "{:.0%}")
    return said


def _wander(kind: str, seeds: int, episodes: int) -> list[tuple[dict[str, Any], np.ndarray, np.ndarray, float]]:
    """Episodes of random actions: row, commanded and measured poses, and the control period."""
    env: Any = make_environment(TASK, {"guidance": kind, **ENVIRONMENT})
    explored = []
    for seed in range(seeds):
        random = np.random.default_rng(seed)
        env.reset(seed=seed)
        shape = env.action_space.shape
        for index in range(episodes):
            row = run_episode(env, lambda _: random.uniform(-1, 1, shape).astype(np.float32), episode=index)  # noqa: B023
            trace = env.unwrapped.trace
            explored.append((row, trace.commanded.copy(), trace.measured.copy(), trace.period))
    env.close()
    return explored
