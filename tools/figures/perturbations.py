"""Figure 5.4: sKGRL with a history of one keeps its course when the robot is pushed."""

from pathlib import Path
from typing import Any

import numpy as np

from guiderail.models.objects.narrow_passage import NarrowPassage
from guiderail.tools.figures.passage import TASK
from guiderail.tools.rollouts.rollout import EpisodeRecord
from guiderail.tools.studies.study import write_table
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.passage import draw_world
from guiderail.tools.viewing.style import new_figure, save_figure

# Where the robot is when it is pushed (y, m), and by how much in x (m). The last of each kind leads into the zone.
PUSHES = ((0.20, -0.10), (0.20, 0.05), (0.54, -0.02), (0.54, 0.02), (0.78, -0.10), (0.20, 0.15), (0.78, 0.20))


def figure_5_4(out: Path) -> dict[str, Any]:
    """Pushes where demonstrations differ and where they agree, some of them into the restricted zone."""
    env: Any = make_environment(TASK, {"guidance": "skgrl", "hold": 1, "history": 1, "history_source": "measured"})
    nominal, _, _ = _run(env, None)
    figure, ((plane, time),) = new_figure(1, 2, (11, 5.6))
    draw_world(plane)
    plane.plot(*nominal.T, color="black", linewidth=1.4, label="not pushed")
    period = env.unwrapped.trace.period
    time.plot(period * np.arange(len(nominal)), nominal[:, 0], color="black")
    rows: list[dict[str, Any]] = []
    for index, (height, push) in enumerate(PUSHES):
        step = int(np.argmax(nominal[:, 1] > height))
        path, commanded, row = _run(env, (step, np.array([push, 0.0])))
        colour = f"C{index}"
        pushed = nominal[step - 1] + [push, 0.0]
        plane.plot(*np.vstack([pushed, path[step:]]).T, color=colour, linewidth=1.1)
        plane.plot(*np.vstack([nominal[step - 1], pushed]).T, "--", color="firebrick", linewidth=1.2)
        time.plot(
            period * np.arange(step, len(path)), path[step:, 0], color=colour, label=f"{push:+.2f} m at y {height}"
        )
        rows.append(_recovery(height, push, step, nominal, path, commanded, row))
    env.close()
    time.axhline(NarrowPassage().zone_x, color="firebrick", linewidth=0.8)
    time.set(xlabel="time [s]", ylabel="x [m]")
    time.legend(frameon=False, fontsize=8)
    plane.legend(frameon=False, fontsize=8, loc="upper left")
    half = {height: [row["steps_to_half"] for row in rows if row["y"] == height] for height in (0.20, 0.54)}
    return {
        "picture": str(save_figure(figure, out / "figure_5_4.png")),
        "table": str(write_table(out / "figure_5_4", rows)),
        "all reach the goal": bool(all(row["success"] for row in rows)),
        "worst commanded violation": max(row["worst_commanded_violation"] for row in rows),
        "steps until half recovered, where demonstrations differ": str(half[0.20]),
        "steps until half recovered, in the passage": str(half[0.54]),
        "condition": "the history is the measured pose (P = 1), the action zero",
    }


def _run(env: Any, push: tuple[int, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """One episode without actions, pushed just before a step: measured and commanded path, and its row."""
    env.reset(seed=0)
    record = EpisodeRecord(env)
    action = np.zeros(env.action_space.shape, np.float32)
    finished, step = False, 0
    while not finished:
        if push is not None and step == push[0]:
            env.unwrapped.push(push[1])
        _, reward, terminated, truncated, info = env.step(action)
        record.add(float(reward), info)
        finished, step = terminated or truncated, step + 1
    trace = env.unwrapped.trace
    return trace.measured.copy(), trace.commanded.copy(), record.row(0)


def _recovery(
    height: float,
    push: float,
    step: int,
    nominal: np.ndarray,
    path: np.ndarray,
    commanded: np.ndarray,
    row: dict[str, Any],
) -> dict[str, Any]:
    """How fast, and how safely, the robot is back on its course."""
    length = min(len(nominal), len(path))
    away = np.abs(path[step:length, 0] - nominal[step:length, 0])

    def steps_until(share: float) -> int | None:
        below = np.flatnonzero(away < share * abs(push))
        return int(below[0]) + 1 if len(below) else None

    return {
        "y": height,
        "push": push,
        "steps_to_half": steps_until(0.5),
        "steps_to_a_tenth": steps_until(0.1),
        "largest_command_step": float(np.abs(np.diff(commanded[step:length, 0])).max()),
        "worst_commanded_violation": float((commanded[:, 0] - NarrowPassage().zone_x).max()),
        "steps_measured_in_the_zone": int((path[step:, 0] > NarrowPassage().zone_x + 1e-6).sum()),
        "collisions": row["collisions"],
        "fallbacks": row["fallbacks"],
        "success": row["success"],
    }
