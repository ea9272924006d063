"""Figures 5.2 to 5.10: smoothness and learning of KGRL and sKGRL."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.tasks.bnc_connector import ALIGNMENT
from guiderail.models.common.errors import InputError
from guiderail.models.objects.bnc_connector import demonstrations as bnc_connector
from guiderail.models.objects.narrow_passage import PassageGeometry
from guiderail.models.primitives import LcNsKmp
from guiderail.models.primitives.gains import rms_gains
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import BaselinePolicy, uniform_random
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.rollout import Paths, rollout
from guiderail.tools.evaluation.subject import EpisodeSpec
from guiderail.tools.visualization.camera import draw_frames, record_frames
from guiderail.tools.visualization.figures import color, draw_passage, label, new_figure
from guiderail_studies.declaration import LearnerChoice
from guiderail_studies.study import each, run_study
from research.figures.chapter_4 import ACTION_REPEAT, CONNECTOR, FORCE, LEARNED, TASK, figure_4_3, random_episodes
from research.figures.runs import (
    episodes_of,
    figure_study,
    learning_curves,
    mean_of_last,
    numbers_of_seeds,
    save_results,
)

METHODS = ("kgrl", "skgrl")
VARIANCES = (1e-4, 1e-6, 1e-8, 1e-10)  # ρ [m²]
THESIS_VARIANCE = 1e-6  # ρ of the thesis [m²]
ACTION_REPEATS = (1, 5)  # control steps per action, in the thesis and in the studies of this project
EPISODES = 10  # largest number of episodes searched for a failure, and for a success, in figure 5.7
# Position in y at which the robot is pushed, and displacement in x [m]. The last two pushes end in the restricted zone.
PUSHES = ((0.20, -0.10), (0.20, 0.05), (0.54, -0.02), (0.54, 0.02), (0.78, -0.10), (0.20, 0.15), (0.78, 0.20))


def primitive_of(kind: str, variance: float = THESIS_VARIANCE) -> LcNsKmp:
    """Return the primitive of the narrow passage, with a history for sKGRL."""
    config = make_prior_knowledge("NarrowPassage", guidance=kind, history={"variance": variance}).primitive
    assert config is not None
    return config.primitive(history=kind == "skgrl")


def figure_5_2(out: Path) -> dict[str, Any]:
    """Draw reference windows, modified windows and executed paths of KGRL and sKGRL at the same exploration RMS."""
    figure, (axes,) = new_figure(1, 2, (11, 6))
    rows: list[dict[str, Any]] = []
    for axis, kind in zip(axes, ("kgrl", "skgrl"), strict=True):
        primitive = primitive_of(kind)
        steps, windows, executed = _explore(primitive, rms_gains(primitive), seed=0)
        draw_passage(axis, demonstrations=False)
        _draw_spread(axis, primitive)
        for n in range(60, 200, 12):
            reference = primitive.reference.means[np.minimum(n + np.arange(primitive.horizon + 1), len(steps) - 1)]
            past = executed[max(n - primitive.history, 0) : n]
            axis.plot(*np.vstack([past, reference]).T, ":", color="tab:blue", linewidth=0.9)
            axis.plot(*windows[n].T, color="tomato", linewidth=0.8, alpha=0.8)
        axis.plot(*executed[:300].T, color="firebrick", linewidth=1.6)
        axis.set(title=f"{label(kind)} exploration", xlim=(0.2, 0.65), ylim=(0.03, 0.5))
        # Distance of an executed point from the prediction for this point in the previous step's window.
        jumps = np.linalg.norm(executed[1:] - np.array([window[1] for window in windows[:-1]]), axis=1)
        rows.append(
            {
                "method": label(kind),
                "history_variance": primitive.history_variance if primitive.history else None,
                "mean_jump_between_windows": float(jumps.mean()),
                "largest_jump_between_windows": float(jumps.max()),
                "rms_deviation": float(np.sqrt(((executed - _zero_action_path(primitive)) ** 2).mean())),
            }
        )
    smaller = rows[0]["mean_jump_between_windows"] / rows[1]["mean_jump_between_windows"]
    return {
        **save_results(out, "figure_5_2", figure, rows),
        "sKGRL's mean jump from window to window is smaller by": f"{smaller:.0f} times, at the same RMS",
    }


def _explore(primitive: LcNsKmp, gain: np.ndarray, seed: int) -> tuple[range, list[np.ndarray], np.ndarray]:
    """Apply uniformly random actions; return steps, modified windows (H+1, 2) and executed motion (N, 2)."""
    random = np.random.default_rng(seed)
    steps = range(primitive.num_steps)
    past = [primitive.reference.means[0]] * primitive.history
    windows, executed = [], []
    for n in steps:
        history = np.array(past[-primitive.history :]) if primitive.history else None
        prediction = primitive.predict(n, gain * random.uniform(-1, 1, primitive.num_outputs), history)
        windows.append(prediction.trajectory)
        executed.append(prediction.output)
        past.append(prediction.output)
    return steps, windows, np.array(executed)


def _zero_action_path(primitive: LcNsKmp) -> np.ndarray:
    """Return the motion of the primitive with zero actions, (N, 2)."""
    return _explore(primitive, np.zeros(primitive.num_outputs), 0)[2]


def _draw_spread(axis: Axes, primitive: LcNsKmp) -> None:
    """Draw one and two standard deviations of the demonstrations in x."""
    means, deviation = primitive.reference.means, primitive.reference.standard_deviations[:, 0]
    for width in (1, 2):
        axis.fill_betweenx(
            means[:, 1],
            means[:, 0] - width * deviation,
            means[:, 0] + width * deviation,
            color="tab:blue",
            alpha=0.08,
            linewidth=0,
        )


def figure_5_3(out: Path) -> dict[str, Any]:
    """Draw the narrow passage; the picture is the same as in figure 4.3."""
    return figure_4_3(out, "figure_5_3")


def figure_5_4(out: Path) -> dict[str, Any]:
    """Draw the recovery from pushes at positions with a large and with a small variance of the demonstrations."""
    env: Any = make_environment(
        TASK, {"guidance": "skgrl", "action_repeat": 1, "history": 1, "history.source": "measured"}
    )
    nominal, _, _ = _run(env, None)
    figure, ((plane, time),) = new_figure(1, 2, (11, 5.6))
    draw_passage(plane)
    plane.plot(*nominal.T, color="black", linewidth=1.4, label="no push")
    period = env.unwrapped.trace.period
    time.plot(period * np.arange(len(nominal)), nominal[:, 0], color="black")
    rows: list[dict[str, Any]] = []
    for index, (height, push) in enumerate(PUSHES):
        step = int(np.argmax(nominal[:, 1] > height))
        path, commanded, row = _run(env, (step, np.array([push, 0.0])))
        color = f"C{index}"
        pushed = nominal[step - 1] + [push, 0.0]
        plane.plot(*np.vstack([pushed, path[step:]]).T, color=color, linewidth=1.1)
        plane.plot(*np.vstack([nominal[step - 1], pushed]).T, "--", color="firebrick", linewidth=1.2)
        time.plot(
            period * np.arange(step, len(path)), path[step:, 0], color=color, label=f"{push:+.2f} m at y {height}"
        )
        is_into_zone = bool(pushed[0] > PassageGeometry().zone_x)
        rows.append(_recovery(height, push, step, nominal, path, commanded, row) | {"is_into_zone": is_into_zone})
    env.close()
    time.axhline(PassageGeometry().zone_x, color="firebrick", linewidth=0.8)
    time.set(xlabel="time [s]", ylabel="x [m]")
    time.legend(frameon=False, fontsize=8)
    plane.legend(frameon=False, fontsize=8, loc="upper left")
    half = {
        height: [row["steps_to_half"] for row in rows if row["y"] == height and not row["is_into_zone"]]
        for height in (0.20, 0.54)
    }
    return {
        **save_results(out, "figure_5_4", figure, rows),
        "all reach the goal": bool(all(row["success"] for row in rows)),
        "max. commanded violation": max(row["max_commanded_violation"] for row in rows),
        "steps until half recovered, where demonstrations differ": str(half[0.20]),
        "steps until half recovered, in the passage": str(half[0.54]),
        "steps until half recovered, after a push into the zone": str(
            [row["steps_to_half"] for row in rows if row["is_into_zone"]]
        ),
        "measured steps in the zone after a push": max(row["steps_measured_in_the_zone"] for row in rows),
        "condition": "the history is the measured pose (P = 1), the action zero",
    }


def _run(env: Any, push: tuple[int, np.ndarray] | None) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Run an episode with zero actions and a push (step, offset) or None; return measured path, commanded path, row."""

    def act(observation: np.ndarray) -> np.ndarray:
        if push is not None and len(env.unwrapped.trace) == push[0]:
            _push(env, push[1])
        return np.zeros(env.action_space.shape, np.float32)

    row = rollout(env, act, Paths(env), seed=0)
    return row["measured"], row["commanded"], row


def _push(env: Any, displacement: np.ndarray) -> None:
    """Displace the robot, as a push by an operator between two control steps would."""
    station = env.unwrapped.diagram.diagram.GetSubsystemByName("station")
    context = env.unwrapped.simulator.get_mutable_context()
    pose = station.get_pose_output_port().Eval(station.GetMyContextFromRoot(context))
    station.set_pose(context, pose + displacement)


def _recovery(
    height: float,
    push: float,
    step: int,
    nominal: np.ndarray,
    path: np.ndarray,
    commanded: np.ndarray,
    row: dict[str, Any],
) -> dict[str, Any]:
    """Return a row with the speed and the safety of the recovery from a push."""
    length = min(len(nominal), len(path))
    deviation = np.abs(path[step:length, 0] - nominal[step:length, 0])

    def steps_until(share: float) -> int | None:
        below = np.flatnonzero(deviation < share * abs(push))
        return int(below[0]) + 1 if len(below) else None

    return {
        "y": height,
        "push": push,
        "steps_to_half": steps_until(0.5),
        "steps_to_a_tenth": steps_until(0.1),
        "largest_command_step": float(np.abs(np.diff(commanded[step:length, 0])).max()),
        "max_commanded_violation": float((commanded[:, 0] - PassageGeometry().zone_x).max()),
        "steps_measured_in_the_zone": int((path[step:, 0] > PassageGeometry().zone_x + 1e-6).sum()),
        "collisions": row["collisions"],
        "fallback_steps": row["fallback_steps"],
        "success": row["success"],
    }


def figure_5_5(out: Path, seeds: int = 3, episodes: int = 5) -> dict[str, Any]:
    """Draw one motion of KGRL, five of sKGRL, and the ratio of their jerks against ρ at the same exploration RMS.

    Args:
        out: Folder of the picture and the table.
        seeds: Number of seeds of the random actions.
        episodes: Number of episodes of each seed.
    """
    figure, (axes,) = new_figure(1, 3, (14, 5.4))
    rows: list[dict[str, Any]] = []
    for action_repeat in ACTION_REPEATS:
        rough = _smoothness(
            "kgrl",
            THESIS_VARIANCE,
            action_repeat,
            _explore_in_simulation("kgrl", THESIS_VARIANCE, action_repeat, range(seeds), episodes),
        )
        rows.append(rough | {"times_below_kgrl_commanded": 1.0, "times_below_kgrl_measured": 1.0})
        for variance in VARIANCES:
            row = _smoothness(
                "skgrl",
                variance,
                action_repeat,
                _explore_in_simulation("skgrl", variance, action_repeat, range(seeds), episodes),
            )
            for column in ("commanded", "measured"):
                row[f"times_below_kgrl_{column}"] = rough[f"jerk_{column}"] / row[f"jerk_{column}"]
            rows.append(row)
    for axis, kind, count, caption in ((axes[0], "kgrl", 1, "one motion"), (axes[1], "skgrl", 5, "five motions")):
        draw_passage(axis)
        for row in _explore_in_simulation(kind, THESIS_VARIANCE, ACTION_REPEATS[0], range(1), count):
            axis.plot(*row["commanded"].T, linewidth=1, color=color(kind) if count == 1 else None)
        axis.set_title(f"{label(kind)}, {caption}")
    for action_repeat, shade in zip(ACTION_REPEATS, ("tab:blue", "tab:orange"), strict=True):
        for column, style in (("commanded", "o-"), ("measured", "x--")):
            times = [
                row[f"times_below_kgrl_{column}"]
                for row in rows
                if row["action_repeat"] == action_repeat and row["method"] != label("kgrl")
            ]
            caption = f"{column}, an action lasts {action_repeat} control step{'s' if action_repeat > 1 else ''}"
            axes[2].loglog(VARIANCES, times, style, color=shade, label=caption)
    axes[2].axhline(1.0, color="0.6", linewidth=0.8)
    axes[2].set(xlabel="history variance ρ [m²]", ylabel="KGRL's mean jerk / sKGRL's, at the same exploration RMS")
    axes[2].legend(frameon=False, fontsize=8)
    return {
        **save_results(out, "figure_5_5", figure, rows),
        **{
            f"jerk below KGRL's at ρ = {row['history_variance']:.0e}, action repeat {row['action_repeat']}": (
                f"{row['times_below_kgrl_commanded']:.0f} times commanded, "
                f"{row['times_below_kgrl_measured']:.0f} times measured"
            )
            for row in rows
            if row["method"] != "KGRL"
        },
        "condition": "gains give every method an RMS of one demonstration deviation at its action repeat",
    }


def _explore_in_simulation(
    kind: str, variance: float, action_repeat: int, seeds: Sequence[int], episodes: int
) -> list[dict[str, Any]]:
    """Return the rows of episodes of random actions, with gains for an RMS of one standard deviation."""
    gains = tuple(rms_gains(primitive_of(kind, variance), action_repeat=action_repeat).tolist())
    arguments = {"guidance": kind, "action_repeat": action_repeat, "history.variance": variance, "gains": gains}
    env = make_environment(TASK, arguments)
    episode_rows = [row for seed in seeds for row in random_episodes(env, seed, episodes)]
    env.close()
    return episode_rows


def _smoothness(kind: str, variance: float, action_repeat: int, episode_rows: list[dict[str, Any]]) -> dict[str, Any]:
    primitive, rows = primitive_of(kind, variance), pd.DataFrame(episode_rows)
    quiet = _zero_action_path(primitive)
    deviation = np.sqrt((primitive.reference.standard_deviations**2).mean(0))
    moved = [((path - quiet[: len(path)]) / deviation) ** 2 for path in rows["commanded"]]
    return {
        "method": label(kind),
        "action_repeat": action_repeat,
        "history_variance": variance if kind == "skgrl" else None,
        "rms_in_deviations": float(np.sqrt(np.mean(np.concatenate(moved)))),
        "jerk_commanded": float(np.mean(rows["jerk_commanded_linear"])),
        "jerk_measured": float(np.mean(rows["jerk_measured_linear"])),
        **summary(rows, ("episodes", "success_rate", "collisions", "max_commanded_violation")),
    }


def figure_5_6(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw the return, its obstacle and action costs, and the commanded jerk over the training episodes.

    The runs in the picture repeat one random action in each of the first ten episodes. The table also has runs with
    a new random action at every step, where the success of sKGRL depends on the seed.
    """
    groups = {}
    for caption, preset in (
        ("first ten episodes constant", "tqc_cheap_correlated"),
        ("a new action at every step", "tqc_fast"),
    ):
        study = figure_study(
            "narrow_passage",
            seeds=seeds,
            episodes=episodes,
            methods=METHODS,
            learner=LearnerChoice(preset=preset, episodes=60),
            folder=f"runs/NarrowPassage/{{method}}-state-{preset}-{{episodes}}-{{seed}}",
        )
        groups[caption] = run_study(study, out)
    columns = {
        "return": "return",
        "reward_obstacle_cost": "obstacle cost",
        "reward_action_cost": "action cost",
        "jerk_commanded_linear": "commanded jerk [m/s³]",
    }
    figure, axes = learning_curves(next(iter(groups.values())), columns, (2, 2), (10, 7))
    axes[1, 1].set_yscale("log")
    result: dict[str, Any] = {}
    for exploration, rows in groups.items():
        for kind in METHODS:
            avoided = each(rows[rows["method"] == kind], "training_avoids_obstacle_from")
            result[f"{label(kind)}, {exploration}: obstacle avoided from episode"] = avoided
            result[f"{label(kind)}, {exploration}: return of the last ten"] = mean_of_last(rows, kind, "return")
            result[f"{label(kind)}, {exploration}: action cost"] = mean_of_last(rows, kind, "reward_action_cost")
        kgrl, skgrl = (mean_of_last(rows, kind, "return") for kind in METHODS)
        higher = "yes" if skgrl > kgrl else "no, not here"
        result[f"sKGRL has the higher return, as in the thesis ({exploration})"] = higher
    return {
        **save_results(
            out, "figure_5_6", figure, pd.concat([t.assign(exploration=caption) for caption, t in groups.items()])
        ),
        **result,
        "condition": f"an action lasts {ACTION_REPEAT} control steps; the obstacle's cost is part of the return",
    }


def figure_5_7(out: Path, episodes: int | None = None) -> dict[str, Any]:
    """Render four moments of a failing episode before learning and of a successful one after it (sKGRL, connector)."""
    runs = run_study(
        figure_study("connector_figures", seeds=1, episodes=episodes, methods=["skgrl"], evaluate=False), out
    )
    learned = EpisodeSpec.of_policy(Path(runs["folder"].iloc[0]))
    unlearned = replace(learned, policy=partial(BaselinePolicy, uniform_random), acting="before learning")
    figure, axes = new_figure(2, 4, (13, 6.2))
    rows = []
    for spec, panels, letter in ((unlearned, axes[0], "A"), (learned, axes[1], "B")):
        row, frames = record_frames(_first(spec, success=spec is learned), len(panels))
        draw_frames(panels, frames, letter)
        columns = ("success", "termination", "steps", "peak_force", "max_commanded_violation")
        rows.append({"episode": spec.acting} | {key: row[key] for key in columns})
    return {
        **save_results(out, "figure_5_7", figure, rows),
        **{f"{row['episode']}, the episode ends in": row["termination"] for row in rows},
        "condition": CONNECTOR,
    }


def _first(spec: EpisodeSpec, *, success: bool) -> EpisodeSpec:
    """Return the spec of the first held-out episode that ends in success, or in failure if `success` is False."""
    env = make_environment(spec.task, spec.environment)
    env.reset(seed=spec.run_seed)
    try:
        for k in range(EPISODES):
            act = spec.policy(env)  # a new random stream, as in the rendered episode
            if bool(rollout(env, act, seed=spec.seed + k, held_out=True)["success"]) == success:
                return replace(spec, seed=spec.seed + k)
    finally:
        env.close()
    raise InputError(f"{EPISODES} episodes {spec.acting} all ended alike: give more --episodes")


def figure_5_8(out: Path, seeds: int = 1, episodes: int = 3) -> dict[str, Any]:
    """Draw x and y of exploring motions over time, commanded and measured."""
    figure, axes = new_figure(2, 2, (11, 6.4))
    rows: list[dict[str, Any]] = []
    for index, kind in enumerate(METHODS):
        environment = {"guidance": kind, "fixture_offset": "per_run", "reward": "shaped"}
        env: Any = make_environment("BncConnector", environment)
        for seed in range(seeds):
            env.reset(seed=seed)
            for row in random_episodes(env, seed, episodes):
                time = env.unwrapped.trace.period * np.arange(1, len(row["commanded"]) + 1)
                for output, name in enumerate("xy"):
                    axis = axes[output, index]
                    axis.plot(time, 1e3 * row["commanded"][:, output], color=color(kind), linewidth=0.8)
                    axis.plot(time, 1e3 * row["measured"][:, output], color="0.5", linewidth=0.8)
                    axis.set(ylabel=f"{name} [mm]", xlabel="time [s]")
                numbers = {key: row[key] for key in row if key.startswith(("jerk", "max_", "peak"))}
                largest = {
                    f"largest_step_{which}": float(np.linalg.norm(np.diff(row[which][:, :2], axis=0), axis=1).max())
                    for which in ("commanded", "measured")
                }
                rows.append({"method": kind, **largest, **numbers})
        env.close()
        axes[0, index].set_title(f"{label(kind)}: commanded, and measured in gray")
    for axis in axes.flat:
        for bound in (-1e3 * ALIGNMENT, 1e3 * ALIGNMENT):
            axis.axhline(bound, color="firebrick", linewidth=0.8)
        axis.set_ylim(-1.2e3 * ALIGNMENT, 1.2e3 * ALIGNMENT)
    means = pd.DataFrame(rows).groupby("method").mean(numeric_only=True)
    numbers_of = {
        "sKGRL's largest change of x, y in a control step": "largest_step_{}",
        "sKGRL's linear jerk": "jerk_{}_linear",
    }
    return {
        **save_results(out, "figure_5_8", figure, rows),
        "demonstrations": bnc_connector.NUM_DEMONSTRATIONS,
        **{
            f"{name} below KGRL's, {which}": (
                f"{means.loc['kgrl', column.format(which)] / means.loc['skgrl', column.format(which)]:.1f} times"
            )
            for name, column in numbers_of.items()
            for which in ("commanded", "measured")
        },
        "condition": "random actions in x and y for ten control steps, gains calibrated by authority",
    }


def figure_5_9(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw success and return of KGRL and sKGRL over training episodes; return the held-out success as well."""
    rows = run_study(figure_study("connector_figures", seeds=seeds, episodes=episodes), out)
    columns = {"success": "success", "return": "return", "mean_force": FORCE}
    figure, _ = learning_curves(rows, columns, (1, 3), (13, 4))
    return {**save_results(out, "figure_5_9", figure, rows), **numbers_of_seeds(rows, LEARNED), "condition": CONNECTOR}


def figure_5_10(out: Path, seeds: int = 3, episodes: int | None = None) -> dict[str, Any]:
    """Draw the mean jerk of the first ten training episodes, linear and angular, commanded and measured."""
    runs = run_study(figure_study("connector_figures", seeds=seeds, episodes=episodes, evaluate=False), out)
    figure, (axes,) = new_figure(1, 2, (10, 4.4))
    rows: list[dict[str, Any]] = []
    for axis, part, unit in zip(axes, ("linear", "angular"), ("m/s³", "rad/s³"), strict=True):
        boxes, labels = [], []
        for kind in METHODS:
            for which in ("commanded", "measured"):
                values = np.concatenate([run[f"jerk_{which}_{part}"].head(10) for run in episodes_of(runs, kind)])
                boxes.append(values)
                labels.append(f"{label(kind)}\n{which}")
                numbers = {"median": np.median(values), "lowest": np.min(values), "highest": np.max(values)}
                rows.append({"part": part, "method": kind, "which": which, **numbers})
        axis.boxplot(boxes, tick_labels=labels)
        axis.set(yscale="log", ylabel=f"mean {part} jerk [{unit}]")
    median = {(row["part"], row["which"], row["method"]): row["median"] for row in rows}
    return {
        **save_results(out, "figure_5_10", figure, rows),
        **{
            f"sKGRL's {part} jerk below KGRL's, {which}": (
                f"{median[part, which, 'kgrl'] / max(median[part, which, 'skgrl'], 1e-12):.1f} times"
            )
            for part in ("linear", "angular")
            for which in ("commanded", "measured")
        },
        "condition": CONNECTOR
        + "; each of the first eight episodes repeats one action, which is smooth with both; gains calibrated by "
        "authority, not by RMS (figure 5.5 and research.smoothness compare random actions at the same RMS)",
    }
