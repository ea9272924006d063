"""An episode as a camera sees it: some moments of it in one picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from guiderail.tools.episodes import EpisodeRecord, make_environment, reset_held_out
from guiderail.tools.pictures import new_figure, save_figure

ROWS, COLUMNS = 2, 3
FRAMES = 24  # kept at most: how long an episode takes isn't known before


@dataclass(frozen=True)
class Shown:
    """An episode that is shown, on held-out initial conditions.

    Args:
        task: its name.
        environment: arguments of its environment.
        act: the policy.
        acting: whose actions they are, in a few words.
        title: what to say beside task and guidance.
        run_seed: draws what is hidden and constant in a run.
        seed: of the episode.
    """

    task: str
    environment: Mapping[str, Any]
    act: Callable[[np.ndarray], np.ndarray]
    acting: str
    title: str
    run_seed: int = 0
    seed: int = 1_000_000

    @property
    def heading(self) -> str:
        """One line that says what it is."""
        parts = (self.task, self.environment.get("guidance"), self.title, self.environment.get("station"))
        return " · ".join(str(part) for part in parts if part)


def outcome(row: Mapping[str, Any]) -> str:
    """How an episode ended, from its row."""
    return f"{row['termination'] or 'running'} after {row['steps']} control steps, peak force {row['peak_force']:.1f} N"


def write_film(picture: Path, episode: Shown) -> dict[str, Any]:
    """Runs an episode and writes what the task's camera sees of it at `ROWS` × `COLUMNS` moments; returns its row.

    Raises:
        InputError: if nothing can be rendered on this machine.
    """
    env = make_environment(episode.task, episode.environment, render_mode="rgb_array")
    base = cast(Any, env.unwrapped)
    env.reset(seed=episode.run_seed)
    observation, over = reset_held_out(env, episode.seed), False
    record = EpisodeRecord(env)
    seen, decisions, stride = [(0.0, 0.0, env.render())], 0, 1
    while not over:
        observation, reward, terminated, truncated, info = env.step(episode.act(observation))
        record.add(float(reward), info)
        over, decisions = terminated or truncated, decisions + 1
        if over or decisions % stride == 0:
            if len(seen) == FRAMES:
                seen, stride = seen[::2], 2 * stride
            seen.append((len(base.trace) * base.task.control_period, info["contact_force"], env.render()))
    env.close()
    row = record.row(0)
    figure, axes = new_figure(ROWS, COLUMNS, (3.6 * COLUMNS, 2.95 * ROWS))
    figure.suptitle(f"{episode.heading}: {outcome(row)}", fontsize=10)
    moments = np.linspace(0, len(seen) - 1, ROWS * COLUMNS).round().astype(int)
    for axis, moment in zip(axes.flat, moments, strict=True):
        time, force, image = seen[moment]
        axis.imshow(cast(np.ndarray, image))
        axis.set_title(f"{time:.1f} s, {force:.0f} N", fontsize=9)
        axis.set_axis_off()
    save_figure(figure, picture)
    return row
