"""A run as one self-contained page: robot, demonstrations, executed paths and the constraint, in any browser."""

import logging
from collections.abc import Callable
from html import escape
from pathlib import Path
from typing import Any, cast

import numpy as np

from guiderail.models.errors import InputError
from guiderail.tools.episodes import DEMONSTRATED, make_environment, run_episode, standing_still
from guiderail.tools.files import write_atomically
from guiderail.tools.policy import Policy
from guiderail.tools.progress import TOLERANCE
from guiderail.tools.run_folder import RunConfig, RunFolder
from guiderail.tools.scenes import scene

FRAMES_PER_SECOND = 32.0
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
    ("before_learning", BLACK, "before learning: the demonstration alone"),
    ("other_episodes", PALE_GREEN, "after learning: other held-out episodes"),
    ("executed", GREEN, "after learning: the episode shown"),
    ("constraint", RED, "the constraint"),
)


def write_replay(run: Path, html: Path | None = None, *, seed: int = 1_000_000) -> Path:
    """Replays a run's deterministic policy on held-out initial conditions, and writes it as a page.

    Args:
        run: the run's folder.
        html: the page; `replay.html` in the run unless given. It is replaced.
        seed: of the episode shown.

    Raises:
        InputError: if there is no trained run, or its task cannot be shown.
    """
    folder = RunFolder(run)
    config, policy = folder.config(), Policy.load(folder.path)
    logging.getLogger("drake").setLevel(logging.WARNING)  # where Meshcat listens is of no interest to a page
    env = make_environment(config.task, config.environment, render_mode="human")
    base = cast(Any, env.unwrapped)
    meshcat = getattr(base.task, "meshcat", None)
    if meshcat is None:
        raise InputError(f"{config.task} has nothing to show: guiderail plot draws its learning curve")
    base.simulator.set_target_realtime_rate(0.0)
    env.reset(seed=config.seed)

    shown = scene(config.task)
    lines: dict[str, list[np.ndarray]] = {"demonstrations": [shown.to_world(d) for d in shown.demonstrations]}
    lines["constraint"] = list(shown.constraint)

    def path(act: Callable[[np.ndarray], np.ndarray], episode: int) -> tuple[np.ndarray, dict[str, Any]]:
        row = run_episode(env, act, held_out_seed=seed + episode)
        return shown.to_world(base.trace.measured.copy()), row

    if config.environment.get("guidance") in DEMONSTRATED:
        lines["before_learning"] = [path(standing_still(env), 0)[0]]
    lines["other_episodes"] = [path(policy, index)[0] for index in range(1, OTHER_PATHS + 1)]
    meshcat.StartRecording(frames_per_second=FRAMES_PER_SECOND)
    executed, row = path(policy, 0)
    meshcat.StopRecording()
    meshcat.PublishRecording()
    lines["executed"] = [executed]

    for name, colour, _ in LEGEND:
        radius = shown.line_radius * (2.0 if name in ("executed", "constraint") else 1.0)
        for index, points in enumerate(lines.get(name, [])):
            _draw(meshcat, f"/guiderail/{name}/{index}", points, radius, colour)
    for ornament in ("/Grid", "/Axes"):
        meshcat.SetProperty(ornament, "visible", False)
    if shown.camera is not None:
        meshcat.SetCameraPose(*(np.array(point) for point in shown.camera))
    page = meshcat.StaticHtml()
    env.close()
    html = folder.path / "replay.html" if html is None else html
    write_atomically(html, _with_caption(page, config, row, {name for name, paths in lines.items() if paths}).encode())
    return html


def _draw(meshcat: Any, name: str, points: np.ndarray, radius: float, colour: tuple[float, ...]) -> None:
    """A path as a tube: browsers draw lines one pixel wide, whatever they are asked for."""
    from pydrake.geometry import Rgba

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


def _with_caption(page: str, config: RunConfig, row: dict[str, Any], drawn: set[str]) -> str:
    """The page with a legend over it: what it shows, and the numbers of the episode shown."""
    entries = "".join(
        f'<div><span style="color:rgb({",".join(str(round(255 * c)) for c in colour[:3])})">&#9644;</span> '
        f"{escape(words)}</div>"
        for name, colour, words in LEGEND
        if name in drawn
    )
    title = f"{config.task} · {config.environment.get('guidance', '')} · {config.learner.algorithm.upper()}"
    outcome = row["termination"] or "running"
    violations = (
        f"{name} {'none' if row[key] <= TOLERANCE else format(row[key], '.1e')}"
        for name, key in (("commanded", "worst_violation"), ("measured", "worst_measured_violation"))
    )
    numbers = (
        f"{outcome} after {row['steps']} control steps, return {row['return']:.1f}, "
        f"peak force {row['peak_force']:.1f} N, violations: {', '.join(violations)}"
    )
    caption = (
        '<div style="position:fixed;left:12px;top:12px;padding:8px 12px;background:rgba(255,255,255,.88);'
        'font:13px sans-serif;border-radius:6px;max-width:340px;z-index:10">'
        f"<b>{escape(title)}</b>{entries}<div>{escape(numbers)}</div></div>"
    )
    head, body, tail = page.rpartition("</body>")
    return f"{head}{caption}{body}{tail}" if body else page + caption
