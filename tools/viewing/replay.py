"""An episode as one self-contained page: robot, demonstrations, executed paths and the constraint, in any browser."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import Any, cast

import numpy as np

from guiderail.models.errors import InputError
from guiderail.models.policy import Policy
from guiderail.tools.files import write_atomically
from guiderail.tools.guidance import DEMONSTRATED
from guiderail.tools.learning.progress import TOLERANCE
from guiderail.tools.learning.run_folder import RunFolder
from guiderail.tools.rollouts.rollout import run_episode, standing_still
from guiderail.tools.tasks import make_environment
from guiderail.tools.viewing.film import Shown, outcome, write_film
from guiderail.tools.viewing.scenes import Camera, scene

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


def write_replay(
    run: Path,
    html: Path | None = None,
    *,
    seed: int = 1_000_000,
    station: str | None = None,
    picture: Path | None = None,
) -> Path:
    """Replays a run's deterministic policy on held-out initial conditions, and writes it as a page.

    Args:
        run: the run's folder.
        html: the page; `replay.html` in the run unless given, `replay-<station>.html` for another station. It is
            replaced.
        seed: of the episode shown.
        station: where the policy acts, for tasks that have several; where it learned unless given.
        picture: if given, what the task's camera sees of the same episode is written there.

    Raises:
        InputError: if there is no trained run, its task cannot be shown, or it has no such station.
    """
    folder = RunFolder(run)
    config, policy = folder.config(), Policy.load(folder.path)
    name = "replay.html" if station is None else f"replay-{station}.html"
    episode = Shown(
        task=config.task,
        environment=config.environment | ({} if station is None else {"station": station}),
        act=policy,
        acting="after learning",
        title=config.learner.algorithm.upper(),
        run_seed=config.seed,
        seed=seed,
    )
    html = folder.path / name if html is None else html
    if picture is not None:
        write_film(picture, episode)
    write_page(html, episode)
    return html


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

    shown = scene(episode.task)
    lines: dict[str, list[np.ndarray]] = {"demonstrations": [shown.to_world(d) for d in shown.demonstrations]}
    lines["constraint"] = list(shown.constraint)

    def path(act: Callable[[np.ndarray], np.ndarray], index: int) -> tuple[np.ndarray, dict[str, Any]]:
        row = run_episode(env, act, held_out_seed=episode.seed + index)
        return shown.to_world(base.trace.measured.copy()), row

    if episode.environment.get("guidance") in DEMONSTRATED:
        lines["alone"] = [path(standing_still(env), 0)[0]]
    lines["other_episodes"] = [path(episode.act, index)[0] for index in range(1, OTHER_PATHS + 1)]
    meshcat.StartRecording(frames_per_second=FRAMES_PER_SECOND)
    executed, row = path(episode.act, 0)
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
    camera = next(iter(views.values()), shown.camera)
    if camera is not None:
        meshcat.SetCameraPose(*(np.array(point) for point in camera))
    page = meshcat.StaticHtml()
    env.close()
    drawn = {name for name, paths in lines.items() if paths}
    write_atomically(html, _with_caption(page, episode, row, drawn, views).encode())
    return row


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


def _with_caption(page: str, episode: Shown, row: dict[str, Any], drawn: set[str], views: Mapping[str, Camera]) -> str:
    """The page with a legend over it: what it shows, the numbers of the episode shown, and where to look from."""
    entries = "".join(
        f'<div><span style="color:rgb({",".join(str(round(255 * c)) for c in colour[:3])})">&#9644;</span> '
        f"{escape(words.format(acting=episode.acting))}</div>"
        for name, colour, words in LEGEND
        if name in drawn
    )
    violations = (
        f"{name} {'none' if row[key] <= TOLERANCE else format(row[key], '.1e')}"
        for name, key in (("commanded", "worst_violation"), ("measured", "worst_measured_violation"))
    )
    numbers = f"{outcome(row)}, return {row['return']:.1f}, violations: {', '.join(violations)}"
    caption = (
        '<div style="position:fixed;left:12px;top:12px;padding:8px 12px;background:rgba(255,255,255,.88);'
        'font:13px sans-serif;border-radius:6px;max-width:340px;z-index:10">'
        f"<b>{escape(episode.heading)}</b>{entries}<div>{escape(numbers)}</div>{_buttons(views)}</div>"
    )
    head, body, tail = page.rpartition("</body>")
    return f"{head}{caption}{body}{tail}" if body else page + caption


def _buttons(views: Mapping[str, Camera]) -> str:
    """A button that lets one see the paths within things, and one for each view."""
    # Meshcat's own camera lives in a frame whose y is up. What is opaque is asked of whatever is on the page by then.
    script = (
        "<script>function look(eye, target) {"
        "viewer.set_property(['Cameras', 'default', 'rotated', '<object>'], 'position', eye);"
        "viewer.set_camera_target(target);}"
        "function see(button) {var through = button.dataset.through != 'yes';"
        "button.dataset.through = through ? 'yes' : 'no';"
        f"viewer.set_property(['drake', 'visualizer'], 'modulated_opacity', through ? {SEEN_THROUGH} : 1);}}</script>"
    )
    looks = (
        f'<button onclick="look({", ".join(str([x, z, -y]) for x, y, z in camera)})">{escape(name)}</button> '
        for name, camera in views.items()
    )
    return f'<div>{"".join(looks)}<button onclick="see(this)">see through</button></div>{script}'
