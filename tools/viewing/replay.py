"""An episode as one self-contained page: robot, demonstrations, executed paths and the constraint, in any browser."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import jinja2
import numpy as np
from pydrake.geometry import Rgba

from guiderail.diagrams.scene import Scene, Viewpoint, in_plane
from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.guidance import is_demonstrated
from guiderail.tools.rollouts.metrics import TOLERANCE
from guiderail.tools.rollouts.null_policies import still
from guiderail.tools.rollouts.rollout import Act, rollout
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.shown import Shown, outcome

TEMPLATE = Path(__file__).with_name("page.html").read_text(encoding="utf-8")
CAPTION = jinja2.Template(TEMPLATE, autoescape=True, trim_blocks=True, lstrip_blocks=True)

FRAMES_PER_SECOND = 32.0
SEEN_THROUGH = 0.35  # opacity of everything but paths, for who asks for it
REPETITIONS = 1000  # of the motion, before it rests
OTHER_PATHS = 5  # held-out episodes whose paths are drawn beside the one that is shown

GREY, BLACK, GREEN, PALE_GREEN, RED = (
    (0.55, 0.55, 0.6, 0.8),
    (0.1, 0.1, 0.1, 1.0),
    (0.1, 0.65, 0.25, 1.0),
    (0.55, 0.85, 0.6, 1.0),
    (0.85, 0.1, 0.1, 1.0),
)

# What each line on the page is: name, colour, words.
LEGEND = (
    ("demonstrations", GREY, "demonstrations"),
    ("alone", BLACK, "the demonstration alone"),
    ("other_episodes", PALE_GREEN, "{acting}: other held-out episodes"),
    ("executed", GREEN, "{acting}: the episode shown"),
    ("constraint", RED, "the constraint"),
)


def default_page(run: Path, environment: Mapping[str, Any]) -> Path:
    """Where the page of a run goes, with other arguments of its environment; of no run, the current folder."""
    name = f"replay-{environment['station']}.html" if "station" in environment else "replay.html"
    return run / name if run.is_dir() else Path(name)


def write_page(html: Path, episode: Shown) -> dict[str, Any]:
    """Runs an episode and writes it as a page; returns the episode's row.

    Raises:
        InputError: if the task cannot be shown.
    """
    logging.getLogger("drake").setLevel(logging.WARNING)  # where Meshcat listens is of no interest to a page
    env = make_environment(episode.task, episode.environment, render_mode="human")
    base = cast(Any, env.unwrapped)
    meshcat = getattr(base.task, "meshcat", None)
    if meshcat is None:
        raise InputError(f"{episode.task} has nothing to show: guiderail plot draws its learning curve")
    base.simulator.set_target_realtime_rate(0.0)
    env.reset(seed=episode.run_seed)

    declared = base.task.declaration
    shown = Scene(to_world=in_plane) if declared is None else declared.scene()
    lines: dict[str, list[np.ndarray]] = {"demonstrations": [shown.to_world(d) for d in shown.demonstrations]}
    lines["constraint"] = list(shown.constraint)

    def path(act: Act, index: int) -> tuple[np.ndarray, dict[str, Any]]:
        row = rollout(env, act, seed=episode.seed + index, held_out=True)
        return shown.to_world(base.trace.measured.copy()), row

    if is_demonstrated(episode.environment.get("guidance")):
        lines["alone"] = [path(still(env), 0)[0]]
    policy = episode.policy(env)
    lines["other_episodes"] = [path(policy, index)[0] for index in range(1, OTHER_PATHS + 1)]
    meshcat.StartRecording(frames_per_second=FRAMES_PER_SECOND)
    executed, row = path(policy, 0)
    meshcat.StopRecording()
    meshcat.get_mutable_recording().set_repetitions(REPETITIONS)
    meshcat.PublishRecording()
    lines["executed"] = [executed]

    for name, colour, _ in LEGEND:
        radius = shown.line_radius * (2.0 if name in ("executed", "constraint") else 1.0)
        for index, points in enumerate(lines.get(name, [])):
            _draw(meshcat, f"/guiderail/{name}/{index}", points, radius, colour)
    for ornament in ("/Grid", "/Axes"):
        meshcat.SetProperty(ornament, "visible", False)
    views = dict(shown.arm_views) if episode.environment.get("station") == "arm" else {}
    camera = next(iter(views.values()), shown.viewpoint)
    if camera is not None:
        meshcat.SetCameraPose(*(np.array(point) for point in camera))
    page = meshcat.StaticHtml()
    env.close()
    drawn = {name for name, paths in lines.items() if paths}
    write_atomically(html, _with_caption(page, episode, row, drawn, views).encode())
    return row


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


def _with_caption(
    page: str, episode: Shown, row: dict[str, Any], drawn: set[str], views: Mapping[str, Viewpoint]
) -> str:
    """The page with a legend over it: what it shows, the numbers of the episode shown, and where to look from."""
    violations = (
        f"{name} {'none' if row[key] <= TOLERANCE else format(row[key], '.1e')}"
        for name, key in (("commanded", "worst_violation"), ("measured", "worst_measured_violation"))
    )
    caption = CAPTION.render(
        heading=episode.heading,
        legend=[
            (",".join(str(round(255 * c)) for c in colour[:3]), words.format(acting=episode.acting))
            for name, colour, words in LEGEND
            if name in drawn
        ],
        numbers=f"{outcome(row)}, return {row['return']:.1f}, violations: {', '.join(violations)}",
        # Meshcat's own camera lives in a frame whose y is up.
        views=[(name, *([x, z, -y] for x, y, z in camera)) for name, camera in views.items()],
        seen_through=SEEN_THROUGH,
    )
    head, body, tail = page.rpartition("</body>")
    return f"{head}{caption}{body}{tail}" if body else page + caption
