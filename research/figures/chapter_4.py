"""Figures 4.2 to 4.8 and table 4.1: exploration in the null space of a KMP, and learning with KGRL."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.patches import Ellipse, Rectangle

from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.models.primitives import Demonstrations, LcNsKmp, LinearConstraints, ReferenceTrajectory
from guiderail.models.primitives.gains import rms_gains
from guiderail.models.primitives.mixture import fit_mixture
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.rollout import Paths, rollout
from guiderail.tools.visualization.figures import color, draw_passage, label, new_figure
from guiderail_studies.study import each, run_study
from research.figures.runs import figure_study, learning_curves, numbers_of_seeds, save_results, settings_table
from research.figures.thesis import TABLE_4_1

DURATION, STEPS, COMPONENTS = 6.0, 200, 8
MODULATED_AT = 3.2  # time of the action, as in the thesis [s]
NEARBY = 0.5  # time before and after the action, equal to the kernel's length scale [s]
MOVED_ELSEWHERE = f"moved_most_over_{NEARBY:g}_s_away"
LOWER, UPPER = np.array([-0.56, -0.26]), np.array([0.56, 0.42])
TASK, ACTION_REPEAT = "NarrowPassage", 5  # default control steps of an action
FREE_Y = (0.15, 0.40)  # y where the demonstrations of the narrow passage differ [m]
METHODS = ("residual", "safe_residual", "kgrl")
CONNECTOR = (
    "in simulation, on the gantry; a hidden offset of 1.0 to 1.5 mm per run and a few tenths per episode; the "
    "preset tqc_contact, actions in x and y for ten control steps; the thesis's reward and 5 per millimeter of depth"
)


def synthetic_demonstrations(seed: int = 0, count: int = 6) -> Demonstrations:
    """Return planar demonstrations over an arch, with little spread at both ends and most at the top."""
    random = np.random.default_rng(seed)
    times = np.linspace(0, DURATION, STEPS)
    phase = times / DURATION
    path = np.column_stack([phase - 0.5, 0.45 * np.sin(np.pi * phase) ** 2 - 0.2 * phase])
    spread = 0.01 + 0.07 * np.exp(-(((phase - 0.54) / 0.13) ** 2)) + 0.03 * np.exp(-(((phase - 0.15) / 0.07) ** 2))
    smooth = np.linalg.cholesky(np.exp(-0.5 * ((phase[:, None] - phase) / 0.2) ** 2) + 1e-8 * np.eye(STEPS))
    return Demonstrations(
        times, [path + spread[:, None] * (smooth @ random.standard_normal((STEPS, 2))) for _ in range(count)]
    )


def explore(primitive: LcNsKmp, gain: np.ndarray, seed: int) -> np.ndarray:
    """Return a motion, (N, O), with a normally distributed null-space action at every step."""
    random = np.random.default_rng(seed)
    return np.array(
        [primitive.predict(n, gain * random.standard_normal(2) / np.sqrt(3)).output for n in range(primitive.num_steps)]
    )


def figure_4_2(out: Path) -> dict[str, Any]:
    """Draw demonstrations with their mixture, motions with one action, and motions with random actions, inside bounds.

    The table has two distances of each motion from the motion without actions: at the time `MODULATED_AT`, and the
    largest one at times that differ from it by more than `NEARBY`.
    """
    demonstrations = synthetic_demonstrations()
    reference = ReferenceTrajectory.from_demonstrations(demonstrations, components=COMPONENTS)
    primitive = LcNsKmp(reference, constraints=LinearConstraints.box(LOWER, UPPER))
    gain = rms_gains(primitive)
    step = int(np.argmin(np.abs(reference.times - MODULATED_AT)))
    unmodulated = primitive.modified_trajectory([], []).trajectory

    def row(panel: str, case: str, path: np.ndarray) -> dict[str, Any]:
        away = np.linalg.norm(path - unmodulated, axis=1)
        elsewhere = np.abs(reference.times - reference.times[step]) > NEARBY
        moved = {"moved_at_3.2_s": float(away[step]), MOVED_ELSEWHERE: float(away[elsewhere].max())}
        return {"panel": panel, "case": case, "max_commanded_violation": _violation(primitive, path), **moved}

    figure, ((first, second, third),) = new_figure(1, 3, (15, 4.2))
    for outputs in demonstrations.outputs:
        first.plot(*outputs.T, color="0.6", linewidth=0.8)
    _draw_mixture(first, demonstrations)
    rows: list[dict[str, Any]] = []
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        action = 3 * gain * np.array([np.cos(angle), np.sin(angle)])
        path = primitive.modified_trajectory([step], [action]).trajectory
        second.plot(*path.T, linewidth=1)
        rows.append(row("A2, one action at 3.2 s", f"{np.degrees(angle):.0f}°", path))
    second.plot(*unmodulated.T, color="black", linewidth=1.5)
    second.plot(*unmodulated[step], "ko", markersize=5)
    paths = np.stack([explore(primitive, gain, seed) for seed in range(5)])
    for path in paths:
        third.plot(*path.T, linewidth=0.5, alpha=0.7)
        rows.append(row("A3, random actions", f"motion {len(rows) - 7}", path))
    for axis, title in zip((first, second, third), ("demonstrations and mixture", "one action", "random"), strict=True):
        if axis is not first:
            axis.add_patch(Rectangle(tuple(LOWER), *(UPPER - LOWER), fill=False, color="firebrick", linestyle="--"))
        axis.set(title=title, xlabel="x", ylabel="y", aspect="equal", xlim=(-0.65, 0.65), ylim=(-0.35, 0.6))
    explored = np.sqrt(((paths - paths.mean(0)) ** 2).mean((0, 2)))
    agreement = float(np.corrcoef(explored, np.sqrt((reference.standard_deviations**2).mean(1)))[0, 1])
    farthest = max(row[MOVED_ELSEWHERE] / row["moved_at_3.2_s"] for row in rows if row["panel"].startswith("A2"))
    return {
        **save_results(out, "figure_4_2", figure, rows),
        f"one action, change more than {NEARBY:g} s away": f"at most {farthest:.0%} of that at {MODULATED_AT:g} s",
        "max_commanded_violation": float(np.max([row["max_commanded_violation"] for row in rows])),
        "exploration_follows_the_demonstrated_spread": agreement,
    }


def _violation(primitive: LcNsKmp, path: np.ndarray) -> float:
    return float(np.max([primitive.constraints.violation(point) for point in path]))  # NaN if one is NaN


def _draw_mixture(axis: Any, demonstrations: Demonstrations) -> None:
    """Draw two standard deviations of each component in the plane."""
    mixture = fit_mixture(demonstrations.times[0], np.stack(demonstrations.outputs), COMPONENTS, 0)
    scale = mixture.scale[1:]
    for mean, covariance in zip(mixture.means, mixture.covariances, strict=True):
        values, vectors = np.linalg.eigh(covariance[1:, 1:] * scale[:, None] * scale)
        width, height = 4 * np.sqrt(values)
        angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
        center = mean[1:] * scale + mixture.center[1:]
        axis.add_patch(Ellipse(tuple(center), width, height, angle=angle, color="tab:blue", alpha=0.25, linewidth=0))


def figure_4_3(out: Path, name: str = "figure_4_3") -> dict[str, Any]:
    """Draw walls, zone, obstacle, goal and demonstrations of the narrow passage."""
    figure, ((axis,),) = new_figure(1, 1, (4.6, 6.0))
    draw_passage(axis)
    geometry = PassageGeometry()
    for text, point in {
        "restricted\nzone": (geometry.zone_x + 0.02, 0.1),
        "obstacle": (geometry.obstacle[0] + geometry.obstacle_radius, geometry.obstacle[1]),
        "goal": (geometry.goal[0] + geometry.goal_radius, geometry.goal[1]),
    }.items():
        axis.annotate(text, point, xytext=(4, 0), textcoords="offset points", fontsize=8, va="center")
    fields = ("start", "goal", "goal_radius", "gap_x", "obstacle", "obstacle_radius", "zone_x")
    rows = [{"quantity": field.replace("_", " "), "meters": str(getattr(geometry, field))} for field in fields]
    return save_results(out, name, figure, rows)


def table_4_1(out: Path) -> dict[str, Any]:
    """Compare the thesis's settings of TQC with those of the presets."""
    return settings_table(out / "table_4_1", TABLE_4_1, ("tqc_fast", "tqc_contact"))


def random_episodes(env: Any, seed: int, episodes: int) -> list[dict[str, Any]]:
    """Run episodes of uniformly random actions; return their rows with paths."""
    random = np.random.default_rng(seed)
    size = env.action_space.shape

    def act(observation: np.ndarray) -> np.ndarray:
        return random.uniform(-1, 1, size).astype(np.float32)

    return [rollout(env, act, Paths(env), index=index) for index in range(episodes)]


def figure_4_4(out: Path, seeds: int = 3, episodes: int = 10) -> dict[str, Any]:
    """Draw the positions that random exploration reaches. The table also has action repeat 1, which is not drawn.

    It has the RMS distance of the commanded x from that without actions, before the passage, where the demonstrations
    differ, and in the passage.

    Args:
        out: Folder.
        seeds: Number of seeds of the random actions.
        episodes: Episodes of each seed.
    """
    figure, (axes,) = new_figure(1, 3, (11, 5.2))
    rows: list[dict[str, Any]] = []
    for axis, kind in zip(axes, METHODS, strict=True):
        draw_passage(axis)
        axis.set_title(label(kind))
        for action_repeat in (ACTION_REPEAT, 1):
            env: Any = make_environment(TASK, {"guidance": kind, "action_repeat": action_repeat})
            episode_rows: list[dict[str, Any]] = []
            for seed in range(seeds):
                env.reset(seed=seed)
                episode_rows += random_episodes(env, seed, episodes)
            still = np.zeros(env.action_space.shape, np.float32)
            quiet = rollout(env, lambda observation, still=still: still, Paths(env), seed=0)["commanded"]
            env.close()
            counted = summary(pd.DataFrame(episode_rows), COUNTED)
            explored = _explored(quiet, [row["commanded"] for row in episode_rows])
            rows.append({"method": label(kind), "action_repeat": action_repeat, **counted, **explored})
            for row in episode_rows if action_repeat == ACTION_REPEAT else ():
                axis.plot(*row["measured"].T, ".", markersize=1.5, color=color(kind), alpha=0.35)
    return {
        **save_results(out, "figure_4_4", figure, rows),
        **{
            f"{row['method']}, an action lasts {row['action_repeat']}": (
                f"{row['rms_in_the_passage'] / row['rms_before_it']:.2f} times the exploration before the passage in "
                f"it; {row['success_rate']:.0%} succeed, {row['measured_violating_episodes']} of {row['episodes']} "
                "enter the zone"
            )
            for row in rows
        },
    }


def _explored(quiet: np.ndarray, paths: list[np.ndarray]) -> dict[str, float]:
    """Return the RMS distance in x [m] of motions from the motion without actions, in two ranges of its y."""
    ranges = {"rms_before_it": FREE_Y, "rms_in_the_passage": PassageGeometry().wall_y}
    apart = [(quiet[: len(path), 1], path[: len(quiet), 0] - quiet[: len(path), 0]) for path in paths]
    return {
        name: float(np.sqrt(np.mean(np.concatenate([dx[(low < y) & (y < high)] ** 2 for y, dx in apart]))))
        for name, (low, high) in ranges.items()
    }


COUNTED = (
    "episodes", "success_rate", "ended_blocked", "collisions", "measured_violating_episodes", "max_commanded_violation",
    "max_measured_violation",
)  # fmt: skip


def figure_4_5(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw success, return and its two costs while learning."""
    rows = run_study(figure_study("narrow_passage", seeds=seeds, episodes=episodes), out)
    columns = {
        "success": "success",
        "return": "return",
        "reward_obstacle_cost": "obstacle cost",
        "reward_action_cost": "action cost",
    }
    figure, _ = learning_curves(rows, columns, (2, 2), (10, 7))
    return {
        **save_results(out, "figure_4_5", figure, rows),
        **numbers_of_seeds(rows, {"training_success_rate": ("success of each seed", "{:.0%}")}),
        "condition": f"an action lasts {ACTION_REPEAT} control steps, and walls do not let the robot slide; figure 4.4 "
        "shows the other case",
    }


def figure_4_6(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw wall collisions and constraint violations per training episode."""
    rows = run_study(figure_study("narrow_passage", seeds=seeds, episodes=episodes), out)
    columns = {"collisions": "wall collisions per episode", "max_measured_violation": "max. violation [m]"}
    figure, axes = learning_curves(rows, columns, (1, 2), (10, 4), window=1)
    axes[0, 1].axhline(0, color="firebrick", linewidth=0.8)
    counts = ["training_collisions", "training_measured_violating_episodes", "training_episodes"]
    total = rows.groupby("method", sort=False)[counts].sum()
    return {
        **save_results(out, "figure_4_6", figure, rows),
        **{
            label(kind): f"{collisions} collisions, {violating} episodes in the zone, of {number}"
            for kind, collisions, violating, number in total.itertuples()
        },
    }


def figure_4_7(out: Path, seeds: int = 10, episodes: int = 30) -> dict[str, Any]:
    """Draw return, obstacle cost and success over 30 episodes with image observations.

    The numbers are the returns of the greedy policies, which are evaluated every five episodes.
    """
    study = figure_study("narrow_passage_images", seeds=seeds, episodes=episodes, methods=["kgrl"])
    rows = run_study(study, out)
    last = rows[rows["after_episodes"] == episodes]
    columns = {"return": "return", "reward_obstacle_cost": "obstacle cost", "success": "success"}
    figure, _ = learning_curves(last, columns, (1, 3), (13, 3.8))
    greedy = {
        f"KGRL, return of the greedy policy after {number} episodes": each(group, "mean_return", "{:.0f}")
        for number, group in rows.groupby("after_episodes", sort=False)
    }
    return {
        **save_results(out, "figure_4_7", figure, rows),
        **numbers_of_seeds(last, {"training_success_rate": ("success of each seed", "{:.0%}")}),
        **greedy,
        "condition": f"an action lasts {ACTION_REPEAT} control steps; pixels are averaged five by five",
    }


def figure_4_8(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw success, return, contact force and episode length of KGRL at the connector."""
    rows = run_study(figure_study("connector_figures", seeds=seeds, episodes=episodes, methods=["kgrl"]), out)
    columns = {"success": "success", "return": "return", "mean_force": FORCE, "steps": "control steps"}
    figure, _ = learning_curves(rows, columns, (2, 2), (10, 7))
    return {**save_results(out, "figure_4_8", figure, rows), **numbers_of_seeds(rows, LEARNED), "condition": CONNECTOR}


FORCE = "mean contact force [N]"
LEARNED = {
    "training_episodes_to_convergence": ("episodes to convergence", "{}"),
    "success_rate": ("held-out success", "{:.0%}"),
}
