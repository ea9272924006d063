"""`guiderail film`: an episode as a camera sees it, some moments of it in one picture."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.rollout import EnvCallback, Transition, rollout
from guiderail.tools.files import check_picture
from guiderail.tools.visualization.episode_spec import EpisodeSpec, outcome
from guiderail.tools.visualization.style import new_figure, save_figure

ROWS, COLUMNS = 2, 3
MOST = 24  # frames
PATH = "#00a33a"  # of what the robot did


class Frames(EnvCallback):
    """What a camera sees of an episode, evenly spread over it and never much: its length isn't known before.

    The environment is made with `render_mode="rgb_array"`.
    """

    def on_episode_start(self) -> None:
        """Looks at how it starts."""
        self.seen: list[Any] = [(0.0, 0.0, self.env.render())]
        self._stride, self._decisions = 1, 0

    def on_step(self, decision: Transition) -> None:
        """Looks at a decision if it is due; where there are `MOST` frames, every second one goes first."""
        self._decisions += 1
        if not decision.is_last and self._decisions % self._stride:
            return
        if len(self.seen) == MOST:
            self.seen, self._stride = self.seen[::2], 2 * self._stride
        time = len(self.base.trace) * self.base.task.control_period
        self.seen.append((time, decision.info["contact_force"], self.env.render()))

    def spread(self, number: int) -> list[Any]:
        """So many frames (time, force, image), from the first to the last."""
        return [self.seen[i] for i in np.linspace(0, len(self.seen) - 1, number).round().astype(int)]


def write_film(picture: Path, episode: EpisodeSpec) -> dict[str, Any]:
    """Runs an episode and writes what the task's camera sees of it at `ROWS` × `COLUMNS` moments; returns its row.

    Raises:
        InputError: if nothing can be rendered on this machine, or no such picture be written.
    """
    check_picture(picture)
    row, frames = watch(episode, ROWS * COLUMNS)
    figure, axes = new_figure(ROWS, COLUMNS, (3.6 * COLUMNS, 2.95 * ROWS))
    figure.suptitle(f"{episode.heading}: {outcome(row)}", fontsize=10)
    draw_frames(axes.flat, frames)
    save_figure(figure, picture)
    return row


def watch(episode: EpisodeSpec, moments: int) -> tuple[dict[str, Any], list[Any]]:
    """Runs an episode; its row, and what the task's camera sees at so many moments: (time, force, image, path) each.

    The path (n, 2) is where the robot was until then, in pixels of the image.

    Raises:
        InputError: if nothing can be rendered on this machine.
    """
    env = make_environment(episode.task, episode.environment, render_mode="rgb_array")
    env.reset(seed=episode.run_seed)
    frames = Frames(env)
    row = rollout(env, episode.policy(env), frames, seed=episode.seed, held_out=True)
    path = path_in_picture(frames.base)
    env.close()
    return row, [(*seen, path[: round(seen[0] / frames.base.trace.period)]) for seen in frames.spread(moments)]


def path_in_picture(base: Any) -> np.ndarray:
    """Where the poses (n, O) of an environment's trace are in the image of its task's camera: (n, 2) [pixel].

    None of them where a task's camera or its way to the world is not known.
    """
    task = base.task.declaration
    camera = None if task is None else task.camera()
    return np.empty((0, 2)) if camera is None else camera.project(task.scene().to_world(base.trace.measured))


def draw_frames(axes: Iterable[Axes], frames: list[Any], letter: str = "") -> None:
    """A moment in each of the axes with the path until then, numbered where a letter is given."""
    for number, (axis, (time, force, image, path)) in enumerate(zip(axes, frames, strict=True), start=1):
        axis.imshow(image)
        axis.plot(*path.T, color=PATH, linewidth=1.0, scalex=False, scaley=False)
        axis.set_title(f"{letter}{number}: " * bool(letter) + f"{time:.1f} s, {force:.0f} N", fontsize=9)
        axis.set_axis_off()
