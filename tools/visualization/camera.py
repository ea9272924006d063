"""Camera images of an episode: some frames in one picture, or many of them as an animation."""

from __future__ import annotations

import io
import logging
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from guiderail.tools.environments import make_environment, task_of
from guiderail.tools.evaluation.episode import EnvCallback, Transition
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import EpisodeSpec, outcome
from guiderail.tools.files import check_picture, check_video, write_atomically
from guiderail.tools.visualization.figures import new_figure, save_figure

_LOGGER = logging.getLogger(__name__)

ROWS, COLUMNS = 2, 3
MAX_FRAMES = 24  # frames stored for a picture
MAX_VIDEO_FRAMES = 240  # frames stored for a video
LAST_FRAME = 1000  # duration of a video's last frame [ms]
PATH = "#00a33a"  # color of the robot's path


class Frames(EnvCallback):
    """Camera frames of an episode, evenly spaced although the length of the episode is not known in advance.

    The environment must have been created with `render_mode="rgb_array"`.

    Attributes:
        frames: Time [s], force of the impedance or, without one, of the contact [N], and
            image (height, width, 3) of each frame.
    """

    def __init__(self, env: Any, max_frames: int = MAX_FRAMES):
        """Construct the callback; `max_frames` must be even, or the spacing of the frames would become uneven."""
        super().__init__(env)
        self._max_frames = max_frames

    def on_episode_start(self) -> None:
        """Render the first frame."""
        self.frames: list[Any] = [(0.0, 0.0, self.env.render())]
        self._stride, self._actions = 1, 0

    def on_step(self, transition: Transition) -> None:
        """Render a frame if it is due or the episode ends.

        When `max_frames` are stored, drop every second frame and double the interval.
        """
        self._actions += 1
        if not transition.is_last and self._actions % self._stride:
            return
        if len(self.frames) == self._max_frames:
            self.frames, self._stride = self.frames[::2], 2 * self._stride
        time = len(self.base.trace) * self.base.diagram.control_period
        self.frames.append((time, float(self.base.trace.force[-1]), self.env.render()))

    def select(self, number: int) -> list[Any]:
        """Return `number` evenly spaced frames, including the first and the last."""
        return [self.frames[i] for i in np.linspace(0, len(self.frames) - 1, number).round().astype(int)]


def write_image(picture: Path, episode: EpisodeSpec) -> dict[str, Any]:
    """Run an episode and write `ROWS` × `COLUMNS` of its camera frames as one picture; return its row."""
    check_picture(picture)
    row, frames = record_frames(episode, ROWS * COLUMNS)
    figure, axes = new_figure(ROWS, COLUMNS, (3.6 * COLUMNS, 2.95 * ROWS))
    figure.suptitle(f"{episode.heading}: {outcome(row)}", fontsize=10)
    draw_frames(axes.flat, frames)
    save_figure(figure, picture)
    return row


def write_video(video: Path, episode: EpisodeSpec) -> dict[str, Any]:
    """Run an episode and write its camera frames as an animated image in real time; return the row of its metrics."""
    from PIL import Image

    check_video(video)
    row, frames = _run(episode, MAX_VIDEO_FRAMES)
    images = [Image.fromarray(image) for _, _, image in frames.frames]
    times = np.array([time for time, _, _ in frames.frames])
    durations = [max(int(1e3 * step), 20) for step in np.diff(times)]  # [ms]; browsers slow shorter frames down
    content = io.BytesIO()
    images[0].save(
        content,
        format=video.suffix[1:],
        save_all=True,
        append_images=images[1:],
        duration=[*durations, LAST_FRAME],
        loop=0,
    )
    write_atomically(video, content.getvalue())
    return row


def record_frames(episode: EpisodeSpec, number: int) -> tuple[dict[str, Any], list[Any]]:
    """Run an episode; return the row of its metrics and `number` camera frames: time, force, image and path of each.

    The path (n, 2) is the robot's path up to the frame, in pixels of the image.
    """
    row, frames = _run(episode, MAX_FRAMES)
    path = path_in_picture(frames.base)
    period = frames.base.trace.period
    return row, [(*frame, path[: round(frame[0] / period)]) for frame in frames.select(number)]


def _run(episode: EpisodeSpec, max_frames: int) -> tuple[dict[str, Any], Frames]:
    """Run an episode; return the row of its metrics and at most `max_frames` camera frames."""
    env = make_environment(episode.task, episode.environment, render_mode="rgb_array")
    task_of(env, episode.task)
    env.reset(seed=episode.run_seed)
    frames, policy = Frames(env, max_frames), episode.policy(env)
    _LOGGER.info("simulating a held-out episode, then writing its camera frames")
    row = rollout(env, policy, frames, seed=episode.seed, held_out=True)
    env.close()
    return row, frames


def path_in_picture(base: Any) -> np.ndarray:
    """Return the measured positions of an environment's trace in the image of its task's camera, (n, 2) [pixels].

    The result is empty if the task has no camera.
    """
    task = base.diagram.task
    camera = None if task is None else task.scene().camera
    return np.empty((0, 2)) if camera is None else camera.project(task.scene().to_world(base.trace.measured))


def draw_frames(axes: Iterable[Axes], frames: list[Any], letter: str = "") -> None:
    """Draw a frame with its path into each of the axes; with a letter, number the frames."""
    for number, (axis, (time, force, image, path)) in enumerate(zip(axes, frames, strict=True), start=1):
        axis.imshow(image)
        axis.plot(*path.T, color=PATH, linewidth=1.0, scalex=False, scaley=False)
        axis.set_title(f"{letter}{number}: " * bool(letter) + f"{time:.1f} s, {force:.0f} N", fontsize=9)
        axis.set_axis_off()
