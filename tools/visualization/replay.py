"""Self-contained HTML page of episodes before and after learning: animation and plots on one time axis.

`guiderail visualize` and the end of a training write it. The script in `replay.html` reads the data by the keys that
`MotionRecorder.data` and `write_page` give them.
"""

from __future__ import annotations

import base64
import html as markup
import json
import logging
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import jinja2
import numpy as np
from pydrake.geometry import Cylinder, Rgba, Role
from pydrake.systems.framework import Context, EventStatus

from guiderail.diagrams.envs.assemble import template_of
from guiderail.diagrams.envs.scene import NEWTONS_PER_METER, Scene, contact_forces, in_plane
from guiderail.diagrams.guidance.registry import is_demonstrated
from guiderail.diagrams.tasks.registry import environment_id, is_task_folder
from guiderail.models.common.arrays import as_whole
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import MM
from guiderail.models.primitives import LinearConstraints
from guiderail.systems.command_checks import ConstraintViolation
from guiderail.tools.environments import make_environment, task_of
from guiderail.tools.evaluation.baselines import BaselinePolicy, uniform_random, zero_policy
from guiderail.tools.evaluation.episode import EnvCallback, PolicyFn, Transition
from guiderail.tools.evaluation.metrics import VIOLATION, violation_text
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.subject import EpisodeSpec, outcome
from guiderail.tools.files import check_page, write_atomically

_LOGGER = logging.getLogger(__name__)

POINTS = 400  # largest number of samples of an episode, about the width of a page in pixels
VISUALIZER_PATH = "/drake/visualizer"  # path of Drake's visualizer in Meshcat's scene tree
DIGITS = 5  # significant digits of a plotted number
CONTACTS = 8  # largest number of contacts whose forces are drawn, those with the largest forces
CONTACT_PATH = "/guiderail/contact"  # path of their lines in Meshcat's scene tree
CONTACT_RADIUS = 0.001  # radius of a line [m]


class MotionRecorder(EnvCallback):
    """Recorder of the poses of all visible bodies, the contacts and the actions at every control step.

    The recorder replaces the simulator's monitor.
    """

    def __init__(self, env: Any):
        """Construct the callback of an environment that was made with `render_mode="human"` and was reset."""
        super().__init__(env)
        self._query = self.base.diagram.query
        self._system = self._query.get_system()
        self._period = self.base.diagram.control_period
        self._contact_results = self.base.diagram.contact_results
        self._poses: list[np.ndarray] = []
        self._contacts: list[np.ndarray] = []  # points and forces, (CONTACTS, 6) each
        self._actions: list[np.ndarray] = []
        inspector = self._eval_query(self.base.simulator.get_context()).inspector()
        self._frames = {
            f"{VISUALIZER_PATH}/{inspector.GetName(frame).replace('::', '/')}": frame
            for frame in inspector.GetAllFrameIds()
            if frame != inspector.world_frame_id()
            and inspector.NumGeometriesForFrameWithRole(frame, Role.kIllustration) > 0
        }
        self.base.simulator.set_monitor(self._record_poses)

    def on_episode_start(self) -> None:
        """Clear the actions; the poses at time zero have already been recorded."""
        self._actions = []

    def on_step(self, transition: Transition) -> None:
        """Record the action for each of its control steps."""
        steps = len(self.base.trace) - len(self._actions)
        self._actions += steps * [np.clip(np.asarray(transition.action, float).ravel(), -1.0, 1.0)]

    def data(self) -> dict[str, Any]:
        """Return the episode as numbers for a page: `times` [s], `frames`, and the signals at those times.

        `contacts` has the points [m] and forces [N] of up to `CONTACTS` contacts, (n, 6) each in the same encoding.
        `frames` maps each body's path in Meshcat's scene tree to its poses (n, 7), [x, y, z, qw, qx, qy, qz] as float32
        in base64; a body that never moved has a single pose. To preserve peaks, forces [N] and violations are the
        largest since the previous sample. Violations are None without constraints. `time` is in percent of the longest
        possible episode. An episode that failed before its first control step has one sample.
        """
        trace = self.base.trace
        stride = max(1, -(-len(trace) // POINTS))
        ends = np.unique(np.append(np.arange(stride - 1, len(trace), stride), len(trace) - 1))
        ends = ends[ends >= 0]
        starts = np.append(0, ends[:-1] + 1)
        poses = np.array(self._poses[: len(trace) + 1])[np.append(0, ends + 1)]
        signals = trace.signals

        def largest(values: np.ndarray) -> list[float] | None:
            if not len(ends):
                return None
            values = np.maximum.reduceat(values.ravel(), starts)
            return None if values.max() <= ConstraintViolation.UNCONSTRAINED else _with_first(values)

        data = {
            "times": [0.0, *(round(float(t), 4) for t in trace.period * (ends + 1))],
            "frames": {path: _encode(poses[:, i]) for i, path in enumerate(self._frames)},
            "contacts": [_encode(values) for values in self._drawn_contacts(np.append(0, ends + 1))],
            "force": largest(trace.force),
            "commanded": largest(signals["commanded_violation"]),
            "measured": largest(signals["measured_violation"]),
            "action": [_with_first(values) for values in np.array(self._actions)[ends].T] if len(ends) else [],
            "time": [0.0, *(round(float(100 * (n + 1) / self.base.diagram.num_steps), 2) for n in ends)],
        }
        if "state" in signals and len(ends):
            data["state"] = _with_first(signals["state"].ravel()[ends])
        return data

    def _drawn_contacts(self, samples: np.ndarray) -> np.ndarray:
        """Return points and forces of contacts at samples (n,), (k, n, 6), without contacts that never have a force."""
        contacts = np.array(self._contacts).reshape(-1, CONTACTS, 6)[samples[samples < len(self._contacts)]]
        return contacts.transpose(1, 0, 2)[contacts.any(axis=(0, 2))]

    def _eval_query(self, root: Context) -> Any:
        return self._query.Eval(self._system.GetMyContextFromRoot(root))

    def _record_poses(self, root: Context) -> EventStatus:
        """Record the poses at time zero and after each control step, as the simulator's monitor."""
        time = root.get_time()
        if time == 0.0:
            self._poses.clear()
            self._contacts.clear()
        # The tolerance is far smaller than a simulation step, and far larger than rounding errors.
        if time > len(self._poses) * self._period - 1e-6:
            query = self._eval_query(root)
            poses = [query.GetPoseInWorld(frame) for frame in self._frames.values()]
            numbers = [[*X.translation(), *X.rotation().ToQuaternion().wxyz()] for X in poses]
            self._poses.append(np.array(numbers))
            if self._contact_results is not None:
                station = self._contact_results.get_system()
                found = contact_forces(self._contact_results.Eval(station.GetMyContextFromRoot(root)))[:CONTACTS]
                self._contacts.append(np.pad(found, ((0, CONTACTS - len(found)), (0, 0))))
        return EventStatus.DidNothing()


def violation_unit(constraints: LinearConstraints | None, outputs: int) -> tuple[str, float]:
    """Return the unit of plotted violations and the factor from m or rad to it.

    The unit is mm if only positions are constrained, and m or rad otherwise. `outputs` is the number of outputs of a
    command.
    """
    has_rotations = outputs >= 6 and (constraints is None or bool(np.any(constraints.G[..., 3:])))
    return (VIOLATION, 1.0) if has_rotations else ("mm", 1.0 / MM)


def _encode(poses: np.ndarray) -> str:
    """Return poses (n, 7) or contacts (n, 6) as float32 in base64; the first one alone if all are equal."""
    poses = poses.astype("<f4")
    return base64.b64encode((poses[:1] if (poses == poses[0]).all() else poses).tobytes()).decode()


def _with_first(values: np.ndarray) -> list[float]:
    """Return the values at the ends of control steps, and the first value also at time zero."""
    rounded = [float(f"{value:.{DIGITS}g}") for value in values]
    return [rounded[0], *rounded]


TEMPLATE = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
    Path(__file__).with_name("replay.html").read_text(encoding="utf-8")
)

TRANSPARENT_OPACITY = 0.35  # opacity of bodies when the page shows them transparent
EPISODES = 4  # number of held-out episodes

GRAY, BLACK = (0.55, 0.55, 0.6, 0.8), (0.1, 0.1, 0.1, 1.0)
GREEN, RED, ORANGE = (0.1, 0.65, 0.25, 1.0), (0.85, 0.1, 0.1, 1.0), (0.95, 0.55, 0.0, 1.0)
PALE_OPACITY = 0.3  # opacity of the paths of episodes that are not selected


@dataclass(frozen=True)
class Side:
    """Half of the page: a policy, and the color of its paths."""

    name: str
    label: str
    color: tuple[float, ...]


def default_page(run: Path, environment: Mapping[str, Any]) -> Path:
    """Return the default path of a page: in the folder `run` if it is a run's folder, otherwise in the current one."""
    name = f"replay-{environment['station']}.html" if "station" in environment else "replay.html"
    return run / name if run.is_dir() and not is_task_folder(run) else Path(name)


def write_page(html: Path, episode: EpisodeSpec, *, episodes: int | None = None) -> dict[str, Any]:
    """Run episodes and write them as a page; return the row of the policy's first episode.

    Each episode is run twice from the same conditions: by the policy and by a baseline without learning.
    The baseline is the demonstration alone (an action of zero) if the guidance has a demonstration, and otherwise
    uniform random actions.

    Args:
        html: File of the page, .html or .htm.
        episode: First episode; the others have the following seeds.
        episodes: Number of episodes, at least 1; None for `EPISODES`.
    """
    if environment_id(episode.task) == episode.task:
        raise InputError(f"{episode.task} is an environment of another package, which has no animation of guiderail")
    episodes = as_whole(EPISODES if episodes is None else episodes, "the number of episodes", 1)
    check_page(html)
    env = make_environment(episode.task, episode.environment, render_mode="human")
    base = cast(Any, env.unwrapped)
    meshcat = getattr(task_of(env, episode.task), "meshcat", None)
    if meshcat is None:
        raise InputError(f"{episode.task} has no animation: give --image or --video, if its environment renders images")
    base.simulator.set_target_realtime_rate(0.0)
    env.reset(seed=episode.run_seed)

    task = base.diagram.task
    scene = Scene(to_world=in_plane) if task is None else task.scene()
    constraints = None if task is None else base.diagram.config.constraints()
    is_demonstration = is_demonstrated(episode.environment.get("guidance"))
    before: PolicyFn = zero_policy(env) if is_demonstration else BaselinePolicy(uniform_random, env, episode.seed)
    sides = {
        Side("before", "before: demonstration alone" if is_demonstration else "before: random actions", BLACK): before,
        Side("after", episode.acting, GREEN): episode.policy(env),
    }
    _LOGGER.info("simulating held-out episodes (%d) before and after learning, then writing %s", episodes, html)
    motion = MotionRecorder(env)
    rows: list[dict[str, Any]] = []
    recorded: list[dict[str, Any]] = []
    for side, act in sides.items():
        side_episodes = []
        for index in range(episodes):
            row = rollout(env, act, motion, seed=episode.seed + index, held_out=True)
            rows.append(row)
            unit, scale = violation_unit(constraints, base.trace.measured.shape[1])
            numbers = {"outcome": outcome(row), "numbers": _format_numbers(row, unit, scale)}
            side_episodes.append(motion.data() | numbers)
            path = scene.to_world(base.trace.measured.copy())
            _draw(meshcat, f"/guiderail/{side.name}/{index}", path, 2.0 * scene.line_radius, side.color)
        recorded.append({"name": side.name, "color": _css(side.color), "rgba": side.color, "episodes": side_episodes})
    for name, lines, radius, color in (
        ("demonstrations", [scene.to_world(d) for d in scene.demonstrations], scene.line_radius, GRAY),
        ("constraint", scene.constraint, 2.0 * scene.line_radius, RED),
    ):
        for index, points in enumerate(lines):
            _draw(meshcat, f"/guiderail/{name}/{index}", points, radius, color)
    for index in range(max(len(each["contacts"]) for side in recorded for each in side["episodes"])):
        meshcat.SetObject(f"{CONTACT_PATH}/{index}", Cylinder(CONTACT_RADIUS, 1.0), Rgba(*ORANGE))
    for item in ("/Grid", "/Axes"):
        meshcat.SetProperty(item, "visible", False)
    views = dict(scene.arm_views) if episode.environment.get("station") == "arm" else {}
    camera = next(iter(views.values()), scene.viewpoint)
    if camera is not None:
        meshcat.SetCameraPose(*(np.array(point) for point in camera))
    placed = None if task is None else template_of(base.diagram.config)
    data = {
        "sides": recorded,
        "violation": {"unit": unit, "scale": scale},
        "contact_path": CONTACT_PATH,
        "newtons_per_meter": NEWTONS_PER_METER,
        "states": [] if placed is None else [state.name for state in placed.template.states],
        "pale_opacity": PALE_OPACITY,
        "transparent_opacity": TRANSPARENT_OPACITY,
    }
    page = meshcat.StaticHtml()
    env.close()
    legend = [(_css(GRAY), "demonstrations")] * bool(scene.demonstrations)
    legend += [(_css(RED), "the constraint")] * bool(len(scene.constraint))
    has_contacts = any(each["contacts"] for side in recorded for each in side["episodes"])
    legend += [(_css(ORANGE), f"forces of contacts, {NEWTONS_PER_METER / 100:g} N per 10 mm")] * has_contacts
    caption = TEMPLATE.render(
        heading=episode.heading,
        sides=sides,
        css=_css,
        legend=legend,
        seeds=[episode.seed + index for index in range(episodes)],
        report=find_report(html, episode.run),
        run=episode.run,
        # In the frame of Meshcat's camera, y points up.
        views=[(name, *([x, z, -y] for x, y, z in camera)) for name, camera in views.items()],
        # Escaped: otherwise the name of a body could end the script or begin a comment.
        data=json.dumps(data, separators=(",", ":")).replace("<", "\\u003c"),
    )
    write_atomically(html, _insert(page, episode.heading, caption).encode())
    return rows[episodes]


def find_report(html: Path, run: Path | None) -> str | None:
    """Return the path of a report relative to the page; None without a report.

    The report is searched in the page's folder, the run's folder and the folder of the run's study, in this order.
    """
    folders = [html.parent, *([] if run is None else [run, run.parent])]
    report = next((folder / "report.html" for folder in folders if (folder / "report.html").is_file()), None)
    return None if report is None else Path(os.path.relpath(report, html.parent)).as_posix()


def _format_numbers(row: Mapping[str, Any], unit: str, scale: float) -> str:
    """Format a row's return and largest constraint violations; `scale` is the number of units per m or rad."""
    violations = (
        f"{name} {violation_text(row[key], f'{scale * row[key]:.2g} {unit}')}"
        for name, key in (("commanded", "max_commanded_violation"), ("measured", "max_measured_violation"))
    )
    return f"return {row['return']:.1f}; largest constraint violation: {', '.join(violations)}"


def _css(color: tuple[float, ...]) -> str:
    return f"rgb({','.join(str(round(255 * c)) for c in color[:3])})"


def _draw(meshcat: Any, name: str, points: np.ndarray, radius: float, color: tuple[float, ...]) -> None:
    """Draw a path of at least two points as a tube, because browsers draw all lines one pixel wide."""
    if len(points) < 2:
        return
    vertices, faces = tube(points, radius)
    meshcat.SetTriangleMesh(name, vertices.T, faces.T, Rgba(*color))


def tube(points: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the vertices (V, 3) and triangles (T, 3) of a tube with a cross section of five sides.

    Args:
        points: Points of a path (n, 3) [m], at least two; the tube passes through every third point and the last.
        radius: Radius of the tube [m].
    """
    sides = 5
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


def _insert(page: str, title: str, caption: str) -> str:
    """Return Meshcat's page with a title, a viewport for phones, and the caption in its body."""
    head = '<meta name="viewport" content="width=device-width, initial-scale=1">'
    page = re.sub(r"<title>.*?</title>", lambda _: f"{head}\n<title>{markup.escape(title)}</title>", page, count=1)
    start, body, tail = page.rpartition("</body>")
    return f"{start}{caption}{body}{tail}" if body else page + caption
