"""An episode as a camera sees it: some moments of it in one picture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np

from guiderail.tools.rollouts.rollout import EpisodeRecord, reset_held_out
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.style import new_figure, save_figure

ROWS, COLUMNS = 2, 3
FRAMES = 24  # kept at most


@dataclass
class Frames:
    """What is seen of an episode, evenly spread over it and never much: how long it takes isn't known before."""

    seen: list[Any]
    stride: int = 1  # decisions from one to the next

    def due(self, decision: int) -> bool:
        """Whether this decision is one to look at."""
        return decision % self.stride == 0

    def keep(self, frame: Any) -> None:
        """Takes one more; where there are `FRAMES`, every second one goes."""
        if len(self.seen) == FRAMES:
            self.seen, self.stride = self.seen[::2], 2 * self.stride
        self.seen.append(frame)

    def spread(self, number: int) -> list[Any]:
        """So many of them, from the first to the last."""
        return [self.seen[i] for i in np.linspace(0, len(self.seen) - 1, number).round().astype(int)]


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
    frames, decisions = Frames([(0.0, 0.0, env.render())]), 0
    while not over:
        observation, reward, terminated, truncated, info = env.step(episode.act(observation))
        record.add(float(reward), info)
        over, decisions = terminated or truncated, decisions + 1
        if over or frames.due(decisions):
            frames.keep((len(base.trace) * base.task.control_period, info["contact_force"], env.render()))
    env.close()
    row = record.row(0)
    figure, axes = new_figure(ROWS, COLUMNS, (3.6 * COLUMNS, 2.95 * ROWS))
    figure.suptitle(f"{episode.heading}: {outcome(row)}", fontsize=10)
    for axis, (time, force, image) in zip(axes.flat, frames.spread(ROWS * COLUMNS), strict=True):
        axis.imshow(cast(np.ndarray, image))
        axis.set_title(f"{time:.1f} s, {force:.0f} N", fontsize=9)
        axis.set_axis_off()
    save_figure(figure, picture)
    return row
