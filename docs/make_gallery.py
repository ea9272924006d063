"""Render the picture of the README and the animations of the gallery: `python docs/make_gallery.py [NAME …]`.

Each animation has episodes side by side with a common clock and their endings in the last frame. The commands of the
README make its picture, `readme`. The endings of all episodes are in `pictures/gallery.json`, from which a test detects
stale pictures and captions.
"""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageDraw, ImageFont
from pydrake.systems.framework import Context, EventStatus

from guiderail.models.policy import Policy
from guiderail.tools.environments import make_environment, task_named
from guiderail.tools.evaluation.baselines import BaselinePolicy, make_baseline, uniform_random, zero_policy
from guiderail.tools.evaluation.episode import PolicyFn
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.learning.train import train
from guiderail.tools.visualization.camera import path_in_picture
from guiderail.tools.visualization.figures import draw_passage
from guiderail_parts.create_task import create_task

HERE = Path(__file__).parent
FOLDER = HERE / "pictures"
FONT = Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"
GAP = 12  # between panels [pixels]
FRAMES = 45  # frames of an animation
REST = 2000  # duration of the last frame [ms]
GREEN, DARK, RED = (0, 150, 60), (28, 31, 36), (179, 38, 30)
SCALE = 2  # supersampling of lines, which Pillow does not smooth
LEARNING_EPISODES = 32  # ten more than `make demo` has
SCRATCH = tempfile.TemporaryDirectory()
ROOT = HERE.parent
ENDINGS = {"collision": "stopped by the force limit"}  # in pictures; other terminations are shown by name
ON_ARM = {"guidance": "kgrl", "difficulty": "hard", "station": "arm"}


@dataclass
class Panel:
    """Episode in an animation: its policy and environment, and its recording after `run_panel`."""

    title: str
    task: str | Callable[[], str]
    environment: dict[str, Any]
    act: Callable[[Any], PolicyFn]
    seed: int = 1_000_000
    color: tuple[int, int, int] = GREEN
    describe: Callable[[dict[str, Any]], str] | None = None
    row: dict[str, Any] = field(default_factory=dict)
    times: np.ndarray = field(default_factory=lambda: np.zeros(0))
    force: np.ndarray = field(default_factory=lambda: np.zeros(0))
    path: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    images: dict[int, Image.Image] = field(default_factory=dict)

    def ending(self) -> str:
        """Return a short description of the ending."""
        words = ENDINGS.get(self.row["termination"], str(self.row["termination"])).replace("_", " ")
        force = f", {self.row['peak_force']:.0f} N at most" if self.row["peak_force"] > 0 else ""
        return self.describe(self.row) if self.describe else f"{words}{force}"


def run_panel(panel: Panel, size: tuple[int, int], every: int | None) -> None:
    """Run the episode and render every `every` control steps; if None, draw the plane once."""
    task = panel.task if isinstance(panel.task, str) else panel.task()
    env = make_environment(task, panel.environment, render_mode=None if every is None else "rgb_array")
    base: Any = env.unwrapped
    env.reset(seed=0)
    act, period = panel.act(env), base.diagram.control_period
    images: dict[int, Image.Image] = {}

    def look(context: Context) -> EventStatus:
        step = round(context.get_time() / period)
        if every is not None and abs(context.get_time() - step * period) < 1e-6 and step % every == 0:
            images[step] = _fitted(env.render(), size)
        return EventStatus.DidNothing()

    if every is not None:
        base.simulator.set_monitor(look)
    panel.row = rollout(env, act, seed=panel.seed, held_out=True)
    panel.times = period * np.arange(len(base.trace) + 1)
    panel.force = np.append(0.0, base.trace.force)
    if every is None:
        image, to_pixels = _plane(size)
        images[0], panel.path = image, to_pixels(base.trace.measured)
    else:
        images[len(base.trace)] = _fitted(picture := env.render(), size)
        panel.path = path_in_picture(base) * SCALE * size[0] / picture.shape[1]
    panel.images = images
    env.close()


def _fitted(image: Any, size: tuple[int, int]) -> Image.Image:
    return Image.fromarray(np.asarray(image)[..., :3]).resize((SCALE * size[0], SCALE * size[1]), Image.LANCZOS)


def _plane(size: tuple[int, int]) -> tuple[Image.Image, Callable[[np.ndarray], np.ndarray]]:
    """Draw the narrow passage; return the image and the function from points (n, 2) to its pixels."""
    dpi = 100
    figure = Figure(figsize=(SCALE * size[0] / dpi, SCALE * size[1] / dpi), dpi=dpi)
    canvas = FigureCanvasAgg(figure)
    axis = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    draw_passage(axis)
    axis.set_axis_off()
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
    height = SCALE * size[1]
    return image, lambda points: axis.transData.transform(points) * [1, -1] + [0, height]


def compose(panels: Sequence[Panel], size: tuple[int, int], times: np.ndarray) -> list[Image.Image]:
    """Return frames with the panels side by side: title, path, time and force of each."""
    font, line = ImageFont.truetype(FONT, SCALE * 11), SCALE * 18
    frames = []
    for number, time in enumerate(times):
        frame = Image.new("RGB", (SCALE * ((size[0] + GAP) * len(panels) - GAP), SCALE * size[1] + 3 * line), "white")
        draw = ImageDraw.Draw(frame)
        for i, panel in enumerate(panels):
            left = SCALE * (size[0] + GAP) * i
            step = min(round(time / (panel.times[1] - panel.times[0])), len(panel.times) - 1)
            image = panel.images[max(n for n in panel.images if n <= step)].copy()
            path, ink = panel.path[:step], ImageDraw.Draw(image)
            if len(path) > 1:
                ink.line([tuple(p) for p in path], fill=panel.color, width=SCALE * 2, joint="curve")
            if len(path) and len(panel.images) == 1:
                (x, y), r = path[-1], SCALE * 4
                ink.ellipse((x - r, y - r, x + r, y + r), fill=(25, 90, 200))
            frame.paste(image, (left, line))
            draw.text((left, 2 * SCALE), panel.title, fill=DARK, font=font)
            over = number == len(times) - 1 or step == len(panel.times) - 1
            force = f"   {panel.force[step]:.0f} N" if panel.row["peak_force"] > 0 else ""
            words = f"{panel.times[step]:.1f} s{force}" + (f"\n{panel.ending()}" if over else "")
            failed = over and not panel.row["success"]
            foot = SCALE * size[1] + line + 3 * SCALE
            draw.text((left, foot), words, fill=RED if failed else DARK, font=font)
        frames.append(frame.resize((frame.width // SCALE, frame.height // SCALE), Image.LANCZOS))
    return frames


def save(path: Path, frames: Sequence[Image.Image], seconds: float) -> None:
    """Write an animated WebP that repeats after a pause."""
    each = round(1000 * seconds / (len(frames) - 1))
    durations = [each] * (len(frames) - 1) + [REST]
    options = {"save_all": True, "append_images": frames[1:], "duration": durations, "loop": 0}
    frames[0].save(path, quality=55, method=4, **options)


def _random(seed: int) -> Callable[[Any], PolicyFn]:
    return lambda env: BaselinePolicy(uniform_random, env, seed)


def _jerk(row: dict[str, Any]) -> str:
    return f"mean jerk of the command {row['jerk_commanded_linear']:.0f} m/s³"


def _worst(row: dict[str, Any]) -> str:
    outside = row["max_commanded_violation"]
    return "no command outside" if outside <= TOLERANCE else f"{1000 * outside:.0f} mm into the forbidden zone"


def _within(row: dict[str, Any]) -> str:
    outside = 1000 * row["max_commanded_violation"]
    bound = "no command outside" if row["max_commanded_violation"] <= TOLERANCE else f"{outside:.2f} mm outside"
    words = str(row["termination"]).replace("_", " ")
    return f"{words}, {bound}, jerk {row['jerk_commanded_linear']:.1f} m/s³"


def _obstacle(row: dict[str, Any]) -> str:
    return f"goal reached, obstacle cost {abs(row['reward_obstacle_cost']):.1f}"


def _learned(env: Any) -> PolicyFn:
    """Train the policy of the demo."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        train("NarrowPassage", "skgrl", out=out, preset="tqc_cheap_correlated", episodes=LEARNING_EPISODES, seed=0)
        return Policy.load(out)


def readme_commands() -> dict[str, list[str]]:
    """Return the arguments of the first `guiderail` commands of the README, by the name of the command."""
    text = (ROOT / "README.md").read_text(encoding="utf-8").replace("\\\n", " ")
    commands: dict[str, list[str]] = {}
    for line in re.findall(r"^guiderail (.*)$", text, re.MULTILINE):
        words = shlex.split(line, comments=True)
        commands.setdefault(words[0], words)
    return commands


def readme_run() -> Path:
    """Return the run of the README's training command; if it is missing, train it, which takes some minutes."""
    train = readme_commands()["train"]
    run = ROOT / train[train.index("--out") + 1]
    if not (run / "policy.safetensors").is_file():
        _run_guiderail(train)
    return run


def make_readme_picture(folder: Path) -> dict[str, str]:
    """Make the picture of the README by its own commands; return the ending of the episode by its title."""
    readme_run()
    visualize = readme_commands()["visualize"]
    _run_guiderail([*visualize, "--overwrite"])
    picture = ROOT / visualize[visualize.index("--image") + 1]
    (folder / "readme.jpg").write_bytes(picture.read_bytes())
    picture.unlink()
    panel = Panel(
        "an iiwa after 60 episodes",
        "BncConnector",
        ON_ARM | {"reward": "aligned"},
        _learned_on_arm,
    )
    run_panel(panel, SQUARE, 1000)
    return {panel.title: panel.ending()}


def _run_guiderail(arguments: Sequence[str]) -> None:
    subprocess.run([sys.executable, "-m", "guiderail", *arguments], cwd=ROOT, check=True)


def _learned_on_arm(env: Any) -> PolicyFn:
    """Return the policy of the README's training command."""
    return Policy.load(readme_run())


def _right(env: Any) -> PolicyFn:
    return BaselinePolicy(lambda rng, size: lambda observation: np.array([1.0, 0.0]), env)


@cache
def _created_task(name: str) -> str:
    """Create a task from parts of the tests; return its name."""
    sys.path.insert(0, str(HERE.parent / "tests"))
    try:
        from oracles.parts import PARTS
    finally:
        sys.path.remove(str(HERE.parent / "tests"))
    folder, drawn = Path(SCRATCH.name) / name, PARTS[name]()
    folder.mkdir()
    turn = float(dict(zip(drawn.options[::2], drawn.options[1::2], strict=True)).get("--turn", 0.0))
    create_task(*drawn.write(folder), folder / f"{name}_task", unit="mm", turn=turn, hard_episodes=0)
    return task_named(str(folder / f"{name}_task"))[0]


def _with_offset(distance: float) -> dict[str, Any]:
    """Return options with a socket offset [m]."""
    return {"guidance": "kgrl", "fixture_offset": "per_episode", "offset_range": [distance, distance]}


PASSAGE, SQUARE = (240, 350), (320, 240)

# Panels of each animation, their size in pixels, and control steps between renderings (None: a plane).
PICTURES: dict[str, tuple[Callable[[], list[Panel]], tuple[int, int], int | None]] = {
    "passage_methods": (
        lambda: [
            Panel(
                "KGRL, random actions",
                "NarrowPassage",
                {"guidance": "kgrl", "action_repeat": 10},
                _random(1),
                describe=_jerk,
            ),
            Panel(
                "sKGRL, the same actions",
                "NarrowPassage",
                {"guidance": "skgrl", "action_repeat": 10},
                _random(1),
                describe=_jerk,
            ),
        ],
        PASSAGE,
        None,
    ),
    "passage_constraint": (
        lambda: [
            Panel("residual, always to the right", "NarrowPassage", {"guidance": "residual"}, _right, describe=_worst),
            Panel("KGRL, always to the right", "NarrowPassage", {"guidance": "kgrl"}, _right, describe=_worst),
        ],
        PASSAGE,
        None,
    ),
    "passage_learned": (
        lambda: [
            Panel("before learning", "NarrowPassage", {"guidance": "skgrl"}, zero_policy, describe=_obstacle),
            Panel(
                f"after {LEARNING_EPISODES} episodes, sKGRL",
                "NarrowPassage",
                {"guidance": "skgrl"},
                _learned,
                describe=_obstacle,
            ),
        ],
        PASSAGE,
        None,
    ),
    "connector_learned": (
        lambda: [
            Panel("before learning", "BncConnector", ON_ARM, zero_policy),
            Panel("after 60 episodes, KGRL", "BncConnector", ON_ARM, _learned_on_arm),
        ],
        SQUARE,
        8,
    ),
    "connector": (
        lambda: [
            Panel("demonstration", "BncConnector", {"guidance": "kgrl"}, zero_policy),
            Panel(
                "scripted, through KGRL",
                "BncConnector",
                {"guidance": "kgrl"},
                make_baseline("BncConnector", "scripted"),
            ),
        ],
        SQUARE,
        8,
    ),
    "connector_methods": (
        lambda: [
            Panel(
                title,
                "BncConnector",
                {"difficulty": "hard", **guidance},
                make_baseline("BncConnector", "scripted"),
                seed=1_000_002,
                describe=_within,
            )
            for title, guidance in (
                ("scripted, through KGRL", {"guidance": "kgrl"}),
                ("scripted, through sKGRL", {"guidance": "skgrl", "history.adaptive": True}),
                ("scripted, residual RL", {"guidance": "residual", "action_scale": 1.85}),
            )
        ],
        SQUARE,
        8,
    ),
    "parts": (
        lambda: [
            Panel("bayonet, demonstration", partial(_created_task, "bayonet"), _with_offset(0.0), zero_policy),
            Panel("the same, socket 1.5 mm off", partial(_created_task, "bayonet"), _with_offset(0.0015), zero_policy),
            Panel("snap-fit, demonstration", partial(_created_task, "snap_fit"), _with_offset(0.0), zero_policy),
        ],
        SQUARE,
        8,
    ),
    "clamp": (
        lambda: [
            Panel("straight down", "GridClamp", {"seconds": 5.0}, make_baseline("GridClamp", "straight_descent")),
            Panel("scripted search", "GridClamp", {"seconds": 5.0}, make_baseline("GridClamp", "scripted")),
        ],
        SQUARE,
        3,
    ),
    "pouring": (
        lambda: [
            Panel("random inputs", "Pouring", {"time_limit": 6.0}, _random(1)),
            Panel("scripted inputs", "Pouring", {"time_limit": 6.0}, make_baseline("Pouring", "scripted")),
        ],
        SQUARE,
        6,
    ),
}


def draw(name: str) -> tuple[list[Panel], list[Image.Image], float]:
    """Run the episodes of an animation; return panels, frames and duration [s]."""
    panels_of, size, every = PICTURES[name]
    panels = panels_of()
    for panel in panels:
        run_panel(panel, size, every)
    end = max(panel.times[-1] for panel in panels)
    return panels, compose(panels, size, np.linspace(0.0, end, FRAMES)), end


def make(folder: Path, names: Sequence[str]) -> None:
    """Make the pictures of these names."""
    folder.mkdir(exist_ok=True)
    log = folder / "gallery.json"
    log_content = json.loads(log.read_text(encoding="utf-8")) if log.is_file() else {}
    for name in names:
        if name == "readme":
            log_content[name] = make_readme_picture(folder)
        else:
            log_content[name] = make_animation(folder, name)
        log.write_text(
            json.dumps(dict(sorted(log_content.items())), indent=1, ensure_ascii=False) + "\n", encoding="utf-8"
        )


def make_animation(folder: Path, name: str) -> dict[str, str]:
    """Render an animation; return the ending of each panel by its title."""
    panels, frames, seconds = draw(name)
    save(folder / f"{name}.webp", frames, seconds)
    return {panel.title: panel.ending() for panel in panels}


if __name__ == "__main__":
    make(FOLDER, sys.argv[1:] or ["readme", *PICTURES])
