"""Figures 5.2 and 5.5: how KGRL and sKGRL explore, and how smooth that is at the same exploration RMS."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from guiderail.diagrams.stations.plane import PlaneConfig
from guiderail.diagrams.tasks.narrow_passage import make_skill
from guiderail.models.objects.narrow_passage import NarrowPassage
from guiderail.models.primitives import LcNsKmp
from guiderail.models.primitives.gains import rms_gains
from guiderail.tools.figures.passage import TASK
from guiderail.tools.guidance import COLOURS, NAMES
from guiderail.tools.rollouts.rollout import run_episode
from guiderail.tools.studies.study import write_table
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.passage import draw_world
from guiderail.tools.viewing.style import new_figure, save_figure

VARIANCES = (1e-4, 1e-6, 1e-8, 1e-10)  # ρ, m²
SHOWN = 1e-6  # ρ of the thesis
HOLDS = (1, 5)  # control steps of an action: the thesis's, and what is learned with here


def primitive_of(kind: str, variance: float = SHOWN) -> LcNsKmp:
    """The narrow passage's primitive, with a history for sKGRL."""
    skill = make_skill(NarrowPassage(), PlaneConfig(), history_variance=variance)
    return skill.primitive(history=kind == "skgrl")


def figure_5_2(out: Path) -> dict[str, Any]:
    """Reference windows, modified windows and the executed path of one exploring motion, both with the same RMS."""
    figure, (axes,) = new_figure(1, 2, (11, 6))
    rows: list[dict[str, Any]] = []
    for axis, kind in zip(axes, ("kgrl", "skgrl"), strict=True):
        primitive = primitive_of(kind)
        steps, windows, executed = _explore(primitive, rms_gains(primitive), seed=0)
        draw_world(axis, demonstrations=False)
        _draw_spread(axis, primitive)
        for n in range(60, 200, 12):
            reference = primitive.reference.means[np.minimum(n + np.arange(primitive.horizon + 1), len(steps) - 1)]
            past = executed[max(n - primitive.history, 0) : n]
            axis.plot(*np.vstack([past, reference]).T, ":", color="tab:blue", linewidth=0.9)
            axis.plot(*windows[n].T, color="tomato", linewidth=0.8, alpha=0.8)
        axis.plot(*executed[:300].T, color="firebrick", linewidth=1.6)
        axis.set(title=f"{NAMES[kind]} exploration", xlim=(0.2, 0.65), ylim=(0.03, 0.5))
        # Where the last window said the robot would go next, and where it was then sent.
        jumps = np.linalg.norm(executed[1:] - np.array([window[1] for window in windows[:-1]]), axis=1)
        rows.append(
            {
                "method": NAMES[kind],
                "history_variance": primitive.history_variance if primitive.history else None,
                "mean_jump_between_windows": float(jumps.mean()),
                "largest_jump_between_windows": float(jumps.max()),
                "rms_deviation": float(np.sqrt(((executed - _quiet(primitive)) ** 2).mean())),
            }
        )
    smaller = rows[0]["mean_jump_between_windows"] / rows[1]["mean_jump_between_windows"]
    return {
        "picture": str(save_figure(figure, out / "figure_5_2.png")),
        "table": str(write_table(out / "figure_5_2", rows)),
        "sKGRL's mean jump from window to window is smaller by": f"{smaller:.0f} times, at the same RMS",
    }


def _explore(primitive: LcNsKmp, gain: np.ndarray, seed: int) -> tuple[range, list[np.ndarray], np.ndarray]:
    """Uniformly random actions at every step: the modified windows (H+1, 2), and the executed motion (N, 2)."""
    random = np.random.default_rng(seed)
    steps = range(primitive.num_steps)
    past = [primitive.reference.means[0]] * primitive.history
    windows, executed = [], []
    for n in steps:
        history = np.array(past[-primitive.history :]) if primitive.history else None
        prediction = primitive.predict(n, gain * random.uniform(-1, 1, primitive.num_outputs), history)
        windows.append(prediction.trajectory)
        executed.append(prediction.output)
        past.append(prediction.output)
    return steps, windows, np.array(executed)


def _quiet(primitive: LcNsKmp) -> np.ndarray:
    """The same motion without actions."""
    return _explore(primitive, np.zeros(primitive.num_outputs), 0)[2]


def _draw_spread(axis: Axes, primitive: LcNsKmp) -> None:
    """One and two standard deviations of the demonstrations in x."""
    means, deviation = primitive.reference.means, primitive.reference.standard_deviations[:, 0]
    for width in (1, 2):
        axis.fill_betweenx(
            means[:, 1],
            means[:, 0] - width * deviation,
            means[:, 0] + width * deviation,
            color="tab:blue",
            alpha=0.08,
            linewidth=0,
        )


def figure_5_5(out: Path, seeds: int = 3, episodes: int = 5) -> dict[str, Any]:
    """One motion of KGRL and five of sKGRL; jerk at the same exploration RMS over ρ, commanded and measured.

    Args:
        out: the folder.
        seeds: of the random actions.
        episodes: of each seed.
    """
    figure, (axes,) = new_figure(1, 3, (14, 5.4))
    rows: list[dict[str, Any]] = []
    for hold in HOLDS:
        rough = _smoothness("kgrl", SHOWN, hold, _wander("kgrl", SHOWN, hold, range(seeds), episodes))
        rows.append(rough | {"times_below_kgrl_commanded": 1.0, "times_below_kgrl_measured": 1.0})
        for variance in VARIANCES:
            row = _smoothness("skgrl", variance, hold, _wander("skgrl", variance, hold, range(seeds), episodes))
            for column in ("commanded", "measured"):
                row[f"times_below_kgrl_{column}"] = rough[f"jerk_{column}"] / row[f"jerk_{column}"]
            rows.append(row)
    for axis, kind, count, words in ((axes[0], "kgrl", 1, "one motion"), (axes[1], "skgrl", 5, "five motions")):
        draw_world(axis)
        for _, path in _wander(kind, SHOWN, HOLDS[0], range(1), count):
            axis.plot(*path.T, linewidth=1, color=COLOURS[kind] if count == 1 else None)
        axis.set_title(f"{NAMES[kind]}, {words}")
    for hold, colour in zip(HOLDS, ("tab:blue", "tab:orange"), strict=True):
        for column, style in (("commanded", "o-"), ("measured", "x--")):
            times = [
                row[f"times_below_kgrl_{column}"] for row in rows if row["hold"] == hold and row["method"] != "KGRL"
            ]
            label = f"{column}, an action lasts {hold} control step{'s' if hold > 1 else ''}"
            axes[2].loglog(VARIANCES, times, style, color=colour, label=label)
    axes[2].axhline(1.0, color="0.6", linewidth=0.8)
    axes[2].set(xlabel="history variance ρ [m²]", ylabel="KGRL's mean jerk / sKGRL's, at the same exploration RMS")
    axes[2].legend(frameon=False, fontsize=8)
    return {
        "picture": str(save_figure(figure, out / "figure_5_5.png")),
        "table": str(write_table(out / "figure_5_5", rows)),
        **{
            f"jerk below KGRL's at ρ = {row['history_variance']:.0e}, action held {row['hold']}": (
                f"{row['times_below_kgrl_commanded']:.0f} times commanded, "
                f"{row['times_below_kgrl_measured']:.0f} times measured"
            )
            for row in rows
            if row["method"] != "KGRL"
        },
        "condition": "gains give every method the same RMS for its hold, one demonstration deviation",
    }


def _gains(kind: str, variance: float, hold: int) -> np.ndarray:
    return rms_gains(primitive_of(kind, variance), hold=hold)


def _wander(
    kind: str, variance: float, hold: int, seeds: Sequence[int], episodes: int
) -> list[tuple[dict[str, Any], np.ndarray]]:
    """Episodes of random actions in the simulated plane, gains calibrated to an RMS of one standard deviation."""
    gains = tuple(_gains(kind, variance, hold).tolist())
    arguments = {"guidance": kind, "hold": hold, "history_variance": variance, "gains": gains}
    env: Any = make_environment(TASK, arguments)
    explored = []
    for seed in seeds:
        random = np.random.default_rng(seed)
        for index in range(episodes):
            row = run_episode(env, lambda _: random.uniform(-1, 1, 2).astype(np.float32), episode=index)  # noqa: B023
            explored.append((row, env.unwrapped.trace.commanded.copy()))
    env.close()
    return explored


def _smoothness(
    kind: str, variance: float, hold: int, explored: list[tuple[dict[str, Any], np.ndarray]]
) -> dict[str, Any]:
    primitive = primitive_of(kind, variance)
    quiet = _quiet(primitive)
    deviation = np.sqrt((primitive.reference.standard_deviations**2).mean(0))
    moved = [((path - quiet[: len(path)]) / deviation) ** 2 for _, path in explored]
    return {
        "method": NAMES[kind],
        "hold": hold,
        "history_variance": variance if kind == "skgrl" else None,
        "episodes": len(explored),
        "rms_in_deviations": float(np.sqrt(np.mean(np.concatenate(moved)))),
        "jerk_commanded": float(np.mean([row["jerk_commanded_linear"] for row, _ in explored])),
        "jerk_measured": float(np.mean([row["jerk_measured_linear"] for row, _ in explored])),
        "success": float(np.mean([row["success"] for row, _ in explored])),
        "collisions": int(sum(row["collisions"] for row, _ in explored)),
        "worst_violation": float(max(row["worst_violation"] for row, _ in explored)),
    }
