"""Smoothness of exploration methods that displace the command by the same root mean square (RMS).

Each method explores the connector with random actions, in free space (the jack is out of reach) and in contact: KGRL
and sKGRL through their null space, the others as a residual on the demonstrations. The jerk of a command has two parts:
the jerk of the demonstrations, and the jerk that exploration adds.

Run it with `python -m research.smoothness --out studies`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.tasks.bnc_connector import reference_trajectory
from guiderail.diagrams.tasks.insertion import MAX_GIVEN_OFFSET
from guiderail.diagrams.tasks.options import HISTORY_VARIANCE
from guiderail.models.common.errors import InputError
from guiderail.models.primitives.gains import deviation, exploration_rms, rms_gains
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import constant_policy
from guiderail.tools.evaluation.episode import PolicyFn
from guiderail.tools.evaluation.evaluation import load_or_compute
from guiderail.tools.evaluation.metrics import jerk, summary
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.tables import write_table
from guiderail.tools.visualization.figures import color, new_figure, save_figure
from research.command import Parser, print_result, run_program
from research.exploration import RMS, low_pass, open_loop, ornstein_uhlenbeck, pink, state_dependent, uniform


def log_dimensionless_jerk(positions: np.ndarray, period: float) -> float:
    """Return the log dimensionless jerk of a motion; higher (less negative) is smoother.

    The value is −ln(T³/v² ∫|jerk|² dt) with duration T and largest speed v. It does not depend on tempo or unit.

    Args:
        positions: Positions, (N, O).
        period: Time between two positions [s].

    Returns:
        The log dimensionless jerk; −inf for fewer than four positions or no motion.
    """
    positions = np.asarray(positions, dtype=float)
    if len(positions) < 4:
        return -np.inf
    jerks = np.diff(positions, 3, axis=0) / period**3
    peak = np.max(np.linalg.norm(np.diff(positions, axis=0), axis=1)) / period
    duration = (len(positions) - 1) * period
    if not peak > 0:
        return -np.inf
    return float(-np.log(duration**3 / peak**2 * np.sum(jerks**2) * period))


def spectral_arc_length(
    positions: np.ndarray, period: float, cutoff: float = 10.0, threshold: float = 0.05, padding: int = 4
) -> float:
    """Return the spectral arc length of a motion (Balasubramanian et al., 2015); higher (less negative) is smoother.

    It is the arc length of the normalized spectrum of the speed, up to the last frequency below the cutoff at which
    the spectrum is above the threshold.

    Args:
        positions: Positions, (N, O).
        period: Time between two positions [s].
        cutoff: Largest frequency [Hz].
        threshold: Smallest amplitude, as a fraction of the largest amplitude.
        padding: Base-2 logarithm of the factor by which zero-padding lengthens the signal.
    """
    speed = np.linalg.norm(np.diff(np.asarray(positions, dtype=float), axis=0), axis=1) / period
    if not len(speed) or not np.max(speed) > 0:
        return 0.0
    points = int(2 ** (np.ceil(np.log2(len(speed))) + padding))
    frequencies = np.arange(points) / (points * period)
    spectrum = np.abs(np.fft.fft(speed, points))
    spectrum /= spectrum.max()
    is_used = (frequencies <= min(cutoff, 0.5 / period)) & (spectrum >= threshold)
    end = np.flatnonzero(is_used)[-1] + 1
    frequencies, spectrum = frequencies[:end], spectrum[:end]
    if len(frequencies) < 2:
        return 0.0
    across = np.diff(frequencies) / (frequencies[-1] - frequencies[0])
    return float(-np.sum(np.hypot(across, np.diff(spectrum))))


TASK = "BncConnector"
ACTION_REPEAT = 10  # control steps per action, as in the training of BncConnector
SLOW = 25  # control steps per action; two actions per second resolve 1 Hz, the cutoff frequency of a low-pass filter
PLACES = ("free", "connector")
OUT_OF_REACH = (MAX_GIVEN_OFFSET, MAX_GIVEN_OFFSET)  # jack offset for motions in free space [m]
ALONE = "demonstration alone"
OUTPUTS = {"all": (0, 1, 2, 3, 4, 5), "xy": (0, 1)}

Explore = Callable[[np.random.Generator, int, int], PolicyFn]


@dataclass(frozen=True)
class Method:
    """Exploration method.

    Attributes:
        name: Name in the table.
        guidance: Kind of guidance.
        explore: Function of a random generator, the number of control steps and the action size; returns a policy.
        action_repeat: Control steps for which `explore` repeats an action. The environment's own action repeat is 1.
        environment: Further options of the environment.
    """

    name: str
    guidance: str
    explore: Explore
    action_repeat: int = 1
    environment: dict[str, Any] = field(default_factory=dict)


def methods() -> list[Method]:
    """Return all exploration methods."""
    repeated = {n: partial(open_loop, uniform, action_repeat=n) for n in (1, ACTION_REPEAT, SLOW)}
    listed = [Method(ALONE, "kmp", lambda rng, steps, size: lambda observation: np.zeros(size))]
    listed.append(Method("KGRL", "kgrl", repeated[1]))
    for history, variance in ((10, 1e-8), (10, 1e-10), (10, 1e-11), (10, 1e-12), (2, 1e-11), (20, 1e-11)):
        settings = {"history": history, "history.variance": variance}
        listed.append(Method(f"sKGRL P={history} ρ={variance:.0e}", "skgrl", repeated[1], 1, settings))
    defaults = {"history": 10, "history.variance": HISTORY_VARIANCE}
    listed.append(Method("sKGRL adaptive", "skgrl", repeated[1], 1, defaults | {"history.adaptive": True}))
    listed.append(Method(f"KGRL repeat {ACTION_REPEAT}", "kgrl", repeated[ACTION_REPEAT], ACTION_REPEAT))
    listed += [Method(f"sKGRL repeat {n}", "skgrl", repeated[n], n, defaults) for n in (ACTION_REPEAT, SLOW)]
    residual: dict[str, Explore] = {"white": repeated[1], f"repeat {ACTION_REPEAT}": repeated[ACTION_REPEAT]}
    residual |= {f"gSDE {n}": partial(state_dependent, interval=n) for n in (1, 8, 64)}
    residual |= {"pink": partial(open_loop, pink), "OU": partial(open_loop, ornstein_uhlenbeck)}
    residual |= {f"low-pass {f:g} Hz": partial(open_loop, low_pass, cutoff=f) for f in (2.0, 1.0, 0.5)}
    return [*listed, *(Method(f"residual {name}", "residual", explore) for name, explore in residual.items())]


def smoothness(
    out: Path, *, episodes: int = 4, action_scale: float = 1.0, outputs: str = "all", seed: int = 0
) -> dict[str, Any]:
    """Run the benchmark; write `smoothness.csv`, `smoothness.md` and `smoothness.png`.

    Args:
        out: Folder; methods that are already measured in it are not measured again.
        episodes: Episodes of each method in free space, and as many in contact.
        action_scale: Common exploration RMS, in demonstration standard deviations.
        outputs: "all" for all six outputs, as in the thesis, or "xy" for the outputs that the learned policies move.
        seed: Seed of the random actions and of the jack offsets, which are sampled again for every episode.

    Raises:
        InputError: If a number is out of range.
    """
    if episodes < 1 or not action_scale > 0 or outputs not in OUTPUTS:
        raise InputError(
            f"give at least one episode, a positive action_scale and outputs {' or '.join(OUTPUTS)}, "
            f"not {episodes}, {action_scale} and {outputs!r}"
        )
    quiet = quiet_commands()
    rows = []
    for method in methods():
        parts = [method.name, outputs, f"{action_scale:g}", str(episodes), str(seed)]
        file = out / "methods" / ("-".join(parts).replace(" ", "_") + ".csv")
        settings: dict[str, Any] = {"episodes": episodes, "action_scale": action_scale, "seed": seed}
        table = load_or_compute(file, lambda: pd.DataFrame(measure(method, OUTPUTS[outputs], quiet, **settings)))  # noqa: B023
        rows += table.to_dict("records")
    for row in rows:  # compared with uniform random actions through KGRL at the same place
        kgrl = next(kgrl for kgrl in rows if kgrl["method"] == "KGRL" and kgrl["place"] == row["place"])
        for part in ("linear", "angular"):
            row[f"times_below_kgrl_{part}"] = kgrl[f"jerk_commanded_{part}"] / row[f"jerk_commanded_{part}"]
    return {
        "table": str(write_table(out / "smoothness", rows)),
        "picture": str(_draw(rows, out / "smoothness.png")),
        "exploration_rms": f"{action_scale:g} demonstration standard deviations, {outputs} outputs",
        **_ratios(rows),
    }


def quiet_commands() -> np.ndarray:
    """Return the commands of the demonstrations' KMP without any action in free space, (N, 6)."""
    env: Any = make_environment(TASK, {"guidance": "kmp", "action_repeat": 1, "fixture_offset": "none"})
    rollout(env, constant_policy(env, np.zeros(env.action_space.shape)), seed=0, options={"offset": OUT_OF_REACH})
    commands = env.unwrapped.trace.commanded.copy()
    env.close()
    return commands


def measure(
    method: Method, action_dims: tuple[int, ...], quiet: np.ndarray, *, episodes: int, action_scale: float, seed: int
) -> list[dict[str, Any]]:
    """Measure a method; return a row for free space and one for the connector.

    Args:
        method: Exploration method.
        action_dims: Indices of the outputs that the method moves.
        quiet: Commands without any action, (N, 6): see `quiet_commands`.
        episodes: Episodes in each place.
        action_scale: Exploration RMS, in demonstration standard deviations.
        seed: Seed of the random actions and of the jack offsets.
    """
    arguments = {
        "guidance": method.guidance,
        "fixture_offset": "per_episode",
        "action_repeat": 1,
        "action_dims": action_dims,
    }
    arguments |= method.environment | _gains(method, action_dims, action_scale)
    env: Any = make_environment(TASK, arguments)
    unit = deviation(reference_trajectory("insert"))[list(action_dims)]
    rows = []
    for place in PLACES:
        episode_rows, deviations, shapes, jerks_added = [], [], [], []
        for index in range(episodes):
            rng = np.random.default_rng([seed, index])
            act = method.explore(rng, len(quiet), len(action_dims))
            options = {"offset": OUT_OF_REACH} if place == "free" else {"held_out": True}
            episode_rows.append(rollout(env, act, seed=seed + index, options=options))
            trace = env.unwrapped.trace
            deviated = trace.commanded - quiet[: len(trace)]
            jerks_added.append(jerk(deviated, trace.period))
            deviations.append(deviated[:, list(action_dims)] / unit)
            shapes.append(_shape(trace))
        rows.append(_row(method, place, pd.DataFrame(episode_rows), np.concatenate(deviations), shapes, jerks_added))
    env.close()
    return rows


def _gains(method: Method, action_dims: tuple[int, ...], action_scale: float) -> dict[str, Any]:
    """Return options that give random actions the RMS `action_scale` where no constraint is active."""
    if method.guidance == "kmp":
        return {}
    # The prior knowledge of the same environment, but with an action scale of 1.
    histories = {key: value for key, value in method.environment.items() if key in ("history", "history.variance")}
    config = make_prior_knowledge(TASK, guidance=method.guidance, action_dims=None, **histories).primitive
    assert config is not None
    indices = np.array(action_dims)
    if method.guidance == "residual":  # positions share one gain, and so do angles, although their deviations differ
        reached = RMS * (config.residual_gains() / deviation(config.reference))[indices]
        return {"action_scale": action_scale / float(np.sqrt(np.mean(reached**2)))}
    primitive = config.primitive(history=method.guidance == "skgrl")
    if not method.environment.get("history.adaptive"):
        return {"gains": tuple(rms_gains(primitive, action_scale, method.action_repeat, indices).tolist())}
    # An adaptive history has several lengths, but one action scale. It is computed for the full length, which is the
    # length in free space.
    reached = exploration_rms(primitive, config.null_space_gains(primitive), method.action_repeat)[indices]
    return {"action_scale": action_scale / float(np.sqrt(np.mean(reached**2)))}


def _shape(trace: Any) -> dict[str, float]:
    shape = {}
    for which, poses in (("commanded", trace.commanded), ("measured", trace.measured)):
        for part, columns in (("linear", slice(0, 3)), ("angular", slice(3, 6))):
            shape[f"ldlj_{which}_{part}"] = log_dimensionless_jerk(poses[:, columns], trace.period)
            shape[f"sparc_{which}_{part}"] = spectral_arc_length(poses[:, columns], trace.period)
    return shape


def _row(
    method: Method,
    place: str,
    episodes: pd.DataFrame,
    deviations: np.ndarray,
    shapes: list[dict[str, float]],
    jerks_added: list[dict[str, float]],
) -> dict[str, Any]:
    kinds = [f"jerk_{which}_{part}" for which in ("commanded", "measured") for part in ("linear", "angular")]
    return {
        "method": method.name,
        "place": place,
        "episodes": len(episodes),
        "rms_in_deviations": float(np.sqrt(np.mean(deviations**2))),
        **{kind: float(np.mean(episodes[kind])) for kind in kinds},
        **{f"jerk_added_{part}": float(np.mean([added[part] for added in jerks_added])) for part in jerks_added[0]},
        **{key: float(np.mean([shape[key] for shape in shapes])) for key in shapes[0]},
        **summary(
            episodes, ("peak_force", "mean_force", "success_rate", "ended_in_collision", "max_commanded_violation")
        ),
    }


def _ratios(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the ratios of the jerk of KGRL and of residual RL to the jerk of sKGRL, with the success rates."""
    free = {row["method"]: row for row in rows if row["place"] == "free"}
    success = {row["method"]: row["success_rate"] for row in rows if row["place"] == "connector"}
    others = {name: row for name, row in free.items() if name.startswith("residual")}
    kgrl = free[f"KGRL repeat {ACTION_REPEAT}"]
    ratios: dict[str, Any] = {}
    for action_repeat in (ACTION_REPEAT, SLOW):
        ours_name = f"sKGRL repeat {action_repeat}"
        ours = free[ours_name]
        ratios[f"{ours_name} explores and locks"] = f"{success[ours_name]:.0%}"
        for part in ("linear", "angular"):
            key, measured, added = f"jerk_commanded_{part}", f"jerk_measured_{part}", f"jerk_added_{part}"
            ratios[f"{ours_name}, {part} jerk below that of KGRL repeat {ACTION_REPEAT}"] = (
                f"{kgrl[key] / ours[key]:.0f} times commanded ({kgrl[added] / ours[added]:.0f} times in the part "
                f"that exploration adds), {kgrl[measured] / ours[measured]:.1f} times measured"
            )
            ratios[f"{ours_name}, commanded {part} jerk as a fraction of the demonstrations' own"] = (
                f"{ours[key] / free[ALONE][key]:.3g}"
            )
            for what, column in (("commanded", key), ("added", added)):
                ratios[f"{ours_name}, {what} {part} jerk below"] = ", ".join(
                    f"{name.removeprefix('residual ')} ({success[name]:.0%}) {row[column] / ours[column]:.3g} times"
                    for name, row in others.items()
                )
    return ratios


def _draw(rows: list[dict[str, Any]], path: Path) -> Path:
    """Draw the jerk of every method, commanded and measured, and its success and peak force on the connector."""
    figure, axes = new_figure(1, 4, (17, 0.32 * len(rows) / 2 + 2))
    free = [row for row in rows if row["place"] == "free"][::-1]
    contact = [row for row in rows if row["place"] == "connector"][::-1]
    height = np.arange(len(free))
    kinds = {ALONE: "0.6", "residual": color("residual"), "sKGRL": color("skgrl"), "KGRL": color("kgrl")}
    colors = [next(color for name, color in kinds.items() if row["method"].startswith(name)) for row in free]
    for axis, part, unit in zip(axes[0], ("linear", "angular"), ("m/s³", "rad/s³"), strict=False):
        axis.barh(height + 0.2, [row[f"jerk_commanded_{part}"] for row in free], 0.4, color=colors)
        axis.barh(height - 0.2, [row[f"jerk_measured_{part}"] for row in free], 0.4, color=colors, alpha=0.4)
        axis.set(xscale="log", xlabel=f"{part} jerk in free space [{unit}]", title="commanded, measured (pale)")
    axes[0, 2].barh(height, [row["success_rate"] for row in contact], 0.7, color=colors)
    axes[0, 2].set(xlabel="success on the connector, exploring")
    axes[0, 3].barh(height, [row["peak_force"] for row in contact], 0.7, color=colors)
    axes[0, 3].set(xlabel="peak force on the connector [N]")
    for index, axis in enumerate(axes[0]):
        axis.set_yticks(height, [row["method"] for row in free] if index == 0 else [""] * len(free))
    return save_figure(figure, path)


def main(arguments: list[str]) -> None:
    """Run the program."""
    parser = Parser("smoothness", "Compare the smoothness of exploration methods at the same RMS.", "--out studies")
    parser.add_argument("--episodes", type=int, default=16, help="episodes of each method and place (default: 16)")
    parser.add_argument(
        "--action-scale", type=float, default=1.0, help="exploration RMS in demonstration deviations (default: 1)"
    )
    parser.add_argument("--outputs", choices=[*OUTPUTS], default="all", help="outputs that actions move (default: all)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the actions (default: 0)")
    parser.add_out(None)
    parser.add_json()
    args = parser.parse_args(arguments)
    settings = {name: getattr(args, name) for name in ("episodes", "action_scale", "outputs", "seed")}
    print_result(smoothness(args.out, **settings), as_json=args.json)


if __name__ == "__main__":
    run_program(main)
