"""Episodes as one self-contained page: before beside after, moving together, with what was measured, in any browser."""

from __future__ import annotations

import html as markup
import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import jinja2
import numpy as np
from pydrake.geometry import Rgba

from guiderail.diagrams.envs.scene import Scene, in_plane
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy, uniform_random, zero_policy
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.rollout import PolicyFn, rollout
from guiderail.tools.files import check_page, write_atomically
from guiderail.tools.visualization.episode_spec import EpisodeSpec, outcome
from guiderail.tools.visualization.motion import Motion, state_names, violation_unit
from guiderail.tools.visualization.style import is_demonstrated

TEMPLATE = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    Path(__file__).with_name("replay.html").read_text(encoding="utf-8")
)

SEEN_THROUGH = 0.35  # opacity of everything but paths, for who asks for it
EPISODES = 4  # held-out episodes to pick from

GREY, BLACK, GREEN, RED = (
    (0.55, 0.55, 0.6, 0.8),
    (0.1, 0.1, 0.1, 1.0),
    (0.1, 0.65, 0.25, 1.0),
    (0.85, 0.1, 0.1, 1.0),
)
PALE = 0.3  # opacity of the paths of episodes that aren't picked


@dataclass(frozen=True)
class Side:
    """One half of the page: who acts, and how its paths are drawn."""

    name: str
    words: str
    colour: tuple[float, ...]


def default_page(run: Path, environment: Mapping[str, Any]) -> Path:
    """Where the page of a run goes, with other arguments of its environment; of no run, the current folder."""
    name = f"replay-{environment['station']}.html" if "station" in environment else "replay.html"
    return run / name if run.is_dir() else Path(name)


def write_page(html: Path, episode: EpisodeSpec, *, episodes: int | None = None) -> dict[str, Any]:
    """Runs episodes and writes them as a page; returns the row of the first.

    Each of them is run twice, from the same conditions: by who is shown, and beside it without having learned. That is
    the demonstration alone (an action of zero) where guidance has one, and uniform random actions where it has none.

    Args:
        html: the page, .html.
        episode: the first; the seeds that follow its own are the others.
        episodes: how many to pick from, `EPISODES` unless given.

    Raises:
        InputError: if the task cannot be shown, there is no episode to show, or `html` is no page.
    """
    episodes = EPISODES if episodes is None else episodes
    if episodes < 1:
        raise InputError(f"a page shows at least one episode, not {episodes}")
    check_page(html)
    env = make_environment(episode.task, episode.environment, render_mode="human")
    base = cast(Any, env.unwrapped)
    meshcat = getattr(base.task, "meshcat", None)
    if meshcat is None:
        raise InputError(f"{episode.task} has nothing to show: guiderail plot draws its learning curve")
    base.simulator.set_target_realtime_rate(0.0)
    env.reset(seed=episode.run_seed)

    task = base.task.declaration
    scene = Scene(to_world=in_plane) if task is None else task.scene()
    demonstrated = is_demonstrated(episode.environment.get("guidance"))
    before: PolicyFn = zero_policy(env) if demonstrated else BaselinePolicy(uniform_random, env, episode.seed)
    sides = {
        Side("before", "before: the demonstration alone" if demonstrated else "before: random actions", BLACK): before,
        Side("after", episode.acting, GREEN): episode.policy(env),
    }
    motion = Motion(env)
    rows, shown = [], []
    for side, act in sides.items():
        told = []
        for index in range(episodes):
            row = rollout(env, act, motion, seed=episode.seed + index, held_out=True)
            rows.append(row)
            told.append(motion.shown() | {"outcome": outcome(row), "numbers": _numbers(row)})
            path = scene.to_world(base.trace.measured.copy())
            _draw(meshcat, f"/guiderail/{side.name}/{index}", path, 2.0 * scene.line_radius, side.colour)
        shown.append({"name": side.name, "colour": _css(side.colour), "rgba": side.colour, "episodes": told})
    for name, lines, radius, colour in (
        ("demonstrations", [scene.to_world(d) for d in scene.demonstrations], scene.line_radius, GREY),
        ("constraint", scene.constraint, 2.0 * scene.line_radius, RED),
    ):
        for index, points in enumerate(lines):
            _draw(meshcat, f"/guiderail/{name}/{index}", points, radius, colour)
    for ornament in ("/Grid", "/Axes"):
        meshcat.SetProperty(ornament, "visible", False)
    views = dict(scene.arm_views) if episode.environment.get("station") == "arm" else {}
    camera = next(iter(views.values()), scene.viewpoint)
    if camera is not None:
        meshcat.SetCameraPose(*(np.array(point) for point in camera))
    unit, scale = violation_unit(None if task is None else task.constraints(), base.trace.measured.shape[1])
    data = {
        "sides": shown,
        "violation": {"unit": unit, "scale": scale},
        "states": [] if task is None else list(state_names(task)),
        "pale": PALE,
        "seen_through": SEEN_THROUGH,
    }
    page = meshcat.StaticHtml()
    env.close()
    legend = [(_css(GREY), "demonstrations")] * bool(scene.demonstrations)
    legend += [(_css(RED), "the constraint")] * bool(len(scene.constraint))
    caption = TEMPLATE.render(
        heading=episode.heading,
        sides=sides,
        css=_css,
        legend=legend,
        seeds=[episode.seed + index for index in range(episodes)],
        report=report_beside(html, episode.run),
        run=episode.run,
        # Meshcat's own camera lives in a frame whose y is up.
        views=[(name, *([x, z, -y] for x, y, z in camera)) for name, camera in views.items()],
        # Nothing in it ends a script, whatever a body is called.
        data=json.dumps(data, separators=(",", ":")).replace("</", "<\\/"),
    )
    write_atomically(html, _whole(page, episode.heading, caption).encode())
    return rows[episodes]


def report_beside(html: Path, run: Path | None) -> str | None:
    """The way from the page to the report of its run, or of the study that the run is from, if somebody wrote one."""
    folders = [html.parent, *([] if run is None else [run, run.parent])]
    found = next((folder / "report.html" for folder in folders if (folder / "report.html").is_file()), None)
    return None if found is None else Path(os.path.relpath(found, html.parent)).as_posix()


def _numbers(row: Mapping[str, Any]) -> str:
    violations = (
        f"{name} {'none' if row[key] <= TOLERANCE else format(row[key], '.1e')}"
        for name, key in (("commanded", "max_commanded_violation"), ("measured", "max_measured_violation"))
    )
    return f"return {row['return']:.1f}; violations: {', '.join(violations)}"


def _css(colour: tuple[float, ...]) -> str:
    return f"rgb({','.join(str(round(255 * c)) for c in colour[:3])})"


def _draw(meshcat: Any, name: str, points: np.ndarray, radius: float, colour: tuple[float, ...]) -> None:
    """A path as a tube: browsers draw lines one pixel wide, whatever they are asked for."""
    vertices, faces = tube(points, radius)
    meshcat.SetTriangleMesh(name, vertices.T, faces.T, Rgba(*colour))


def tube(points: np.ndarray, radius: float, sides: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n·sides, 3) and triangles (m, 3) of a tube along points (n, 3), every third of which is enough."""
    points = np.vstack([points[:-1:3], points[-1:]])
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    across = np.cross(along, np.where(np.abs(along[:, 2:]) < 0.9, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    angles = np.linspace(0, 2 * np.pi, sides, endpoint=False)
    ring = np.cos(angles)[:, None] * across[:, None] + np.sin(angles)[:, None] * np.cross(along, across)[:, None]
    i, j = np.meshgrid(np.arange(len(points) - 1), np.arange(sides), indexing="ij")
    a, b = (i * sides + j).ravel(), (i * sides + (j + 1) % sides).ravel()
    faces = np.vstack([np.column_stack([a, b, a + sides]), np.column_stack([b, b + sides, a + sides])])
    return (points[:, None] + radius * ring).reshape(-1, 3), faces


def _whole(page: str, title: str, caption: str) -> str:
    """Meshcat's page with ours around it: fit for a phone, and with its name."""
    head = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    page = re.sub(r"<title>.*?</title>", lambda _: f"{head}\n<title>{markup.escape(title)}</title>", page, count=1)
    start, body, tail = page.rpartition("</body>")
    return f"{start}{caption}{body}{tail}" if body else page + caption
