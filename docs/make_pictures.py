"""Draws the pictures of the pages, with the same classes that the pages are about."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from guiderail.diagrams.make import known, make_env
from guiderail.models.objects.narrow_passage import NarrowPassage
from guiderail.models.primitives import LcNsKmp
from guiderail.models.primitives.gains import rms_gains
from guiderail.models.skills import load_skill
from guiderail.models.skills.drawing import draw
from guiderail.tools.viewing.style import new_figure, save_figure

ROOT = Path(__file__).parents[1]
BLUE, GREEN, GREY, RED = "#1f77b4", "#2ca02c", "0.65", "firebrick"
SAMPLES = 6  # motions in a panel
# Words stay words in an SVG, and the same picture is the same file.
matplotlib.rcParams.update({"svg.fonttype": "none", "svg.hashsalt": "guiderail", "font.size": 9})


def make(folder: Path) -> None:
    """Draws what is not there, or older than the code that it shows."""
    folder.mkdir(exist_ok=True)
    sources = [path for part in ("models", "systems", "diagrams") for path in (ROOT / part).rglob("*.*")]
    newest = max(path.stat().st_mtime for path in (Path(__file__), *sources) if "__pycache__" not in path.parts)
    for name, picture in PICTURES.items():
        path = folder / f"{name}.svg"
        if not path.exists() or path.stat().st_mtime < newest:
            picture(path)


@cache
def _passage() -> Any:
    """What is known about the narrow passage: a `PrimitiveSkill`."""
    return known("NarrowPassage").demonstrations


def motion(primitive: LcNsKmp, gains: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """(N, O): what is commanded where the actions (N, O) are, each in [−1, 1]."""
    reference = primitive.reference
    past = np.tile(reference.means[0], (primitive.history, 1))
    outputs = np.empty_like(reference.means)
    for n in range(reference.num_steps):
        outputs[n] = primitive.predict(n, gains * actions[n], past if primitive.history else None).output
        if primitive.history:
            past = np.vstack([past[1:], outputs[n]])
    return outputs


def held(rng: np.random.Generator, steps: int, hold: int) -> np.ndarray:
    """(N, 2): uniform white actions, each of which lasts `hold` control steps."""
    return np.repeat(rng.uniform(-1, 1, (-(-steps // hold), 2)), hold, axis=0)[:steps]


def _panel(axis: Any, primitive: LcNsKmp, gains: np.ndarray, hold: int, colour: str) -> None:
    reference, rng = primitive.reference, np.random.default_rng(1)
    mean, wide = reference.means[:, 0], 2 * reference.standard_deviations[:, 0]
    axis.fill_between(reference.times, mean - wide, mean + wide, color=GREY, alpha=0.35, linewidth=0)
    axis.axhline(NarrowPassage().zone_x, color=RED, linestyle="--", linewidth=0.8)
    for _ in range(SAMPLES):
        path = motion(primitive, gains, held(rng, reference.num_steps, hold))
        axis.plot(reference.times, path[:, 0], color=colour, linewidth=0.8, alpha=0.8)
    axis.set(xlabel="time [s]", ylim=(0.1, 0.75))


def multiples(values: Sequence[Any], vary: Callable[[Any], tuple[Any, int]], label: str, history: bool) -> Callable:
    """A picture with a panel for each value of one parameter, all else alike."""

    def picture(path: Path) -> None:
        figure, axes = new_figure(1, len(values), (5.8, 2.0))
        for axis, value in zip(axes[0], values, strict=True):
            skill, hold = vary(value)
            axis.set_xticks([0, 4, 8])
            primitive = skill.primitive(history=history)
            _panel(axis, primitive, skill.null_space_gains(primitive), hold, GREEN if history else BLUE)
            axis.set_title(label.format(f"{value:g}".replace("0.0001", "1e-04").replace("e-0", "e-")), fontsize=9)
            axis.label_outer()
        axes[0, 0].set_ylabel("x [m]")
        save_figure(figure, path)

    return picture


def primitive_picture(path: Path) -> None:
    """The demonstrations' mean, what a constant action adds, and what the constraint takes away."""
    skill = _passage()
    primitive, free = skill.primitive(history=False), skill.primitive(history=False, constrained=False)
    gains, reference = skill.null_space_gains(primitive), skill.reference
    figure, axes = new_figure(1, 1, (5.4, 3.2))
    axis = axes[0, 0]
    mean, wide = reference.means[:, 0], 2 * reference.standard_deviations[:, 0]
    axis.fill_between(
        reference.times,
        mean - wide,
        mean + wide,
        color=GREY,
        alpha=0.35,
        linewidth=0,
        label="±2 σ of the demonstrations",
    )
    right = np.tile([1.0, 0.0], (reference.num_steps, 1))
    axis.plot(reference.times, motion(free, gains, 0 * right)[:, 0], color="0.3", label="no action")
    axis.plot(
        reference.times, motion(free, gains, right)[:, 0], color=BLUE, linestyle=":", label="action +1, no constraint"
    )
    axis.plot(reference.times, motion(primitive, gains, right)[:, 0], color=BLUE, label="action +1, constrained")
    axis.plot(reference.times, motion(primitive, gains, -right)[:, 0], color=GREEN, label="action −1, constrained")
    axis.axhline(NarrowPassage().zone_x, color=RED, linestyle="--", linewidth=0.8, label="x ≤ 0.6 m")
    axis.set(xlabel="time [s]", ylabel="x [m]")
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    save_figure(figure, path)


def smoothness_picture(path: Path) -> None:
    """White actions through KGRL, a low-pass filter and sKGRL, at the same RMS, and how they jerk."""
    skill, hold = _passage(), 10
    rng = np.random.default_rng(3)
    kgrl, skgrl = skill.primitive(history=False, constrained=False), skill.primitive(history=True, constrained=False)
    period, steps = skill.control_period, skill.reference.num_steps
    actions = held(rng, steps, hold)
    gains = rms_gains(kgrl, hold=hold)
    still = motion(kgrl, gains, 0 * actions)
    paths = {"KGRL": motion(kgrl, gains, actions), "sKGRL": motion(skgrl, rms_gains(skgrl, hold=hold), actions)}
    cutoff = 0.5  # Hz
    weight = 1 - np.exp(-2 * np.pi * cutoff * period)
    filtered = np.zeros_like(actions)
    for n in range(1, steps):
        filtered[n] = filtered[n - 1] + weight * (actions[n] - filtered[n - 1])
    filtered *= np.sqrt(np.mean((paths["KGRL"] - still) ** 2)) / np.sqrt(
        np.mean(((motion(kgrl, gains, filtered)) - still) ** 2)
    )
    paths = {"KGRL": paths["KGRL"], "KGRL, low-pass 0.5 Hz": motion(kgrl, gains, filtered), "sKGRL": paths["sKGRL"]}
    figure, axes = new_figure(1, 2, (7.2, 2.8))
    colours = dict(zip(paths, (BLUE, "#ff7f0e", GREEN), strict=True))
    jerks = {}
    for name, way in paths.items():
        axes[0, 0].plot(skill.reference.times, way[:, 0], color=colours[name], linewidth=1, label=name)
        jerks[name] = float(np.mean(np.linalg.norm(np.diff(way, 3, axis=0), axis=1)) / period**3)
    axes[0, 0].set(xlabel="time [s]", ylabel="x [m]")
    axes[0, 1].hlines(list(jerks), 10, list(jerks.values()), color="0.85", linewidth=1)
    axes[0, 1].scatter(list(jerks.values()), list(jerks), color=list(colours.values()), zorder=3)
    axes[0, 1].set(xscale="log", xlim=(10, 10_000), xlabel="mean jerk of the command [m/s³]")
    axes[0, 1].invert_yaxis()
    save_figure(figure, path)


def safety_picture(path: Path) -> None:
    """What is commanded and what is measured, where a policy pushes at the constraint and the connector at the jack."""
    env = make_env("BncConnector", guidance="kgrl", kappa=3.0, hold=1)
    env.reset(seed=0)
    over, rows = False, []
    while not over:
        *_, terminated, truncated, info = env.step(np.ones(2, np.float32))
        over = terminated or truncated
        rows.append([info["constraint_violation"], info["measured_violation"], info["contact_force"]])
    commanded, measured, force = np.array(rows).T
    times = env.unwrapped.trace.period * np.arange(1, len(rows) + 1)
    figure, axes = new_figure(2, 1, (5.4, 3.6))
    upper, lower = axes[:, 0]
    for values, name, colour in ((measured, "measured", "#ff7f0e"), (commanded, "commanded", BLUE)):
        upper.plot(times, 1000 * values, color=colour, linewidth=1, label=name)
    upper.axhline(0, color=RED, linewidth=0.8, linestyle="--")
    upper.set(ylabel="violation [mm]", ylim=(-0.2, 0.1))
    upper.label_outer()
    upper.legend(frameon=False, loc="lower left")
    lower.plot(times, force, color="0.3", linewidth=1)
    lower.set(xlabel="time [s]", ylabel="contact force [N]")
    save_figure(figure, path)


def projection_picture(path: Path) -> None:
    """Random inputs through a template, and the same without its active constraints."""
    from pydrake.math import RigidTransform

    skill, period, steps = load_skill("pouring"), 0.05, 240
    frames = {"mug_tip": RigidTransform()}
    start = RigidTransform([0.0, -0.30, 0.15])
    figure, axes = new_figure(1, 2, (7.2, 2.9))
    for axis, template, title in (
        (axes[0, 0], skill, "with active constraints"),
        (axes[0, 1], skill.without_active_constraints(), "without"),
    ):
        for seed in range(SAMPLES):
            rng = np.random.default_rng(seed)
            pose, state = start, template.state_at(start, frames)
            way = []
            for n in range(steps):
                if n % 20 == 0:
                    inputs = rng.uniform(-1, 1, 3)
                wish = template.displace(pose, template.map(state, inputs, pose, frames, period))
                pose = template.command(state, pose, wish, frames, period).X_WE
                state = template.next_state(state, pose, frames)
                p = pose.translation()
                way.append((np.hypot(p[0], p[1]), p[2]))
            axis.plot(*np.array(way).T, linewidth=0.8)
        axis.plot([0, 0.044], [0, 0], color="0.3", linewidth=4, solid_capstyle="butt")
        axis.annotate("mug", (0.046, -0.02), color="0.3")
        axis.set(title=title, xlabel="from the mug's axis [m]", xlim=(0, 0.6), ylim=(-0.3, 0.5))
        axis.label_outer()
    axes[0, 0].set_ylabel("above the mug's rim [m]")
    save_figure(figure, path)


def state_machine(path: Path) -> None:
    """The pouring template's state machine."""
    draw(load_skill("pouring"), path)


PICTURES: dict[str, Callable[[Path], None]] = {
    "state_machine": state_machine,
    "projection": projection_picture,
    "primitive": primitive_picture,
    "kappa": multiples((0.5, 1.0, 2.0), lambda v: (replace(_passage(), kappa=v), 5), "κ = {}", False),
    "rho": multiples((1e-4, 1e-6, 1e-8), lambda v: (replace(_passage(), history_variance=v), 5), "ρ = {} m²", True),
    "history": multiples((2, 10, 20), lambda v: (replace(_passage(), history=v), 5), "P = {}", True),
    "hold": multiples((1, 5, 20), lambda v: (_passage(), v), "hold = {}", True),
    "smoothness": smoothness_picture,
    "safety": safety_picture,
}
