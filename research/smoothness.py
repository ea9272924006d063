"""The study `smoothness`: what exploring does to the motion, all ways at the same exploration RMS.

Each method explores the connector's skill with random actions, in free space (the jack is somewhere else) and on the
connector: KGRL and sKGRL through their null space, everything else as a residual on the demonstrations. One table, one
picture. A command's jerk has two parts: the demonstrations' own, and what exploring adds.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.envs.make import make_prior_knowledge
from guiderail.diagrams.tasks.bnc_connector.task import reference_trajectory
from guiderail.diagrams.tasks.insertion import FARTHEST
from guiderail.models.common.errors import InputError
from guiderail.models.objects.insertion import HISTORY_VARIANCE
from guiderail.models.primitives.gains import deviation, exploration_rms, rms_gains
from guiderail.tools.environments import make_environment
from guiderail.tools.evaluation.baselines import zero
from guiderail.tools.evaluation.evaluate import cached
from guiderail.tools.evaluation.metrics import jerk, summary
from guiderail.tools.evaluation.rollout import PolicyFn, rollout
from guiderail.tools.tables import write_table
from guiderail.tools.visualization.style import colour, new_figure, save_figure
from research.exploration import RMS, low_pass, open_loop, ornstein_uhlenbeck, pink, state_dependent, white


def log_dimensionless_jerk(positions: np.ndarray, period: float) -> float:
    """Log dimensionless jerk of `positions` (N, O), higher (less negative) is smoother.

    −ln(T³/v² ∫|jerk|² dt), T the duration and v the largest speed: the same for the same motion at another tempo or in
    another unit. −inf where nothing moves, or fewer than four positions are given.
    """
    positions = np.asarray(positions, dtype=float)
    if len(positions) < 4:
        return -np.inf
    jerk = np.diff(positions, 3, axis=0) / period**3
    peak = np.max(np.linalg.norm(np.diff(positions, axis=0), axis=1)) / period
    duration = (len(positions) - 1) * period
    if not peak > 0:
        return -np.inf
    return float(-np.log(duration**3 / peak**2 * np.sum(jerk**2) * period))


def spectral_arc_length(
    positions: np.ndarray, period: float, cutoff: float = 10.0, threshold: float = 0.05, padding: int = 4
) -> float:
    """SPARC of `positions` (N, O) (Balasubramanian et al., 2015): higher (less negative) is smoother.

    The length of the curve that the normalized spectrum of the speed draws, up to the last frequency below `cutoff`
    [Hz] at which it is above `threshold`.
    """
    speed = np.linalg.norm(np.diff(np.asarray(positions, dtype=float), axis=0), axis=1) / period
    if not len(speed) or not np.max(speed) > 0:
        return 0.0
    points = int(2 ** (np.ceil(np.log2(len(speed))) + padding))
    frequencies = np.arange(points) / (points * period)
    spectrum = np.abs(np.fft.fft(speed, points))
    spectrum /= spectrum.max()
    kept = np.flatnonzero((frequencies <= min(cutoff, 0.5 / period)) & (spectrum >= threshold))
    frequencies, spectrum = frequencies[: kept[-1] + 1], spectrum[: kept[-1] + 1]
    if len(frequencies) < 2:
        return 0.0
    across = np.diff(frequencies) / (frequencies[-1] - frequencies[0])
    return float(-np.sum(np.hypot(across, np.diff(spectrum))))


TASK = "BncConnector"
HOLD = 10  # control steps that an action lasts where the connector is learned
SLOW = 25  # half a second: actions that are as slow as what a low-pass at 1 Hz lets through
PLACES = ("free", "connector")
ELSEWHERE = (FARTHEST, FARTHEST)  # m: where the jack is while the robot moves in free space
ALONE = "demonstration alone"
OUTPUTS = {"all": (0, 1, 2, 3, 4, 5), "xy": (0, 1)}

Explore = Callable[[np.random.Generator, int, int], PolicyFn]


@dataclass(frozen=True)
class Method:
    """One way to explore."""

    name: str
    guidance: str
    explore: Explore
    action_repeat: int = 1  # decisions that an action lasts; the environment itself takes one at every control step
    environment: dict[str, Any] = field(default_factory=dict)


def methods() -> list[Method]:
    """Everything that is compared."""
    white_of = {n: partial(open_loop, white, action_repeat=n) for n in (1, HOLD, SLOW)}
    listed = [Method(ALONE, "kmp", lambda rng, steps, size: lambda observation: np.zeros(size))]
    listed.append(Method("KGRL", "kgrl", white_of[1]))
    for history, variance in ((10, 1e-8), (10, 1e-10), (10, 1e-11), (10, 1e-12), (2, 1e-11), (20, 1e-11)):
        settings = {"history": history, "history_variance": variance}
        listed.append(Method(f"sKGRL P={history} ρ={variance:.0e}", "skgrl", white_of[1], 1, settings))
    usual = {"history": 10, "history_variance": HISTORY_VARIANCE}
    listed.append(Method("sKGRL adaptive", "skgrl", white_of[1], 1, usual | {"adaptive_history": True}))
    listed.append(Method(f"KGRL repeat {HOLD}", "kgrl", white_of[HOLD], HOLD))
    listed += [Method(f"sKGRL repeat {n}", "skgrl", white_of[n], n, usual) for n in (HOLD, SLOW)]
    residual: dict[str, Explore] = {"white": white_of[1], f"repeat {HOLD}": white_of[HOLD]}
    residual |= {f"gSDE {n}": partial(state_dependent, interval=n) for n in (1, 8, 64)}
    residual |= {"pink": partial(open_loop, pink), "OU": partial(open_loop, ornstein_uhlenbeck)}
    residual |= {f"low-pass {f:g} Hz": partial(open_loop, low_pass, cutoff=f) for f in (2.0, 1.0, 0.5)}
    return [*listed, *(Method(f"residual {name}", "residual", explore) for name, explore in residual.items())]


def smoothness(
    out: Path, *, episodes: int = 4, action_scale: float = 1.0, outputs: str = "all", seed: int = 0
) -> dict[str, Any]:
    """Runs the benchmark; writes `smoothness.csv`, `smoothness.md` and `smoothness.png`.

    Args:
        out: the folder.
        episodes: of each method, in free space and on the connector alike.
        action_scale: the common exploration RMS, in demonstration standard deviations.
        outputs: "all" six, as in the thesis, or "xy", which the connector is learned with.
        seed: of the random actions and of the connector's offsets (a new one in every episode).

    Raises:
        InputError: if a number is out of range.
    """
    if episodes < 1 or not action_scale > 0 or outputs not in OUTPUTS:
        raise InputError(
            f"give at least one episode, a positive action_scale and outputs {' or '.join(OUTPUTS)}, "
            f"not {episodes}, {action_scale} and {outputs!r}"
        )
    quiet = quiet_commands()
    rows = []
    for method in methods():
        # A method that is measured already is not measured again: the benchmark goes on where it was interrupted.
        words = [method.name, outputs, f"{action_scale:g}", str(episodes), str(seed)]
        file = out / "methods" / ("-".join(words).replace(" ", "_") + ".csv")
        how: dict[str, Any] = {"episodes": episodes, "action_scale": action_scale, "seed": seed}
        found = cached(file, lambda: pd.DataFrame(measure(method, OUTPUTS[outputs], quiet, **how)))  # noqa: B023
        rows += found.to_dict("records")
    for row in rows:  # against white actions through KGRL, at the same place
        kgrl = next(one for one in rows if one["method"] == "KGRL" and one["place"] == row["place"])
        for part in ("linear", "angular"):
            row[f"times_below_kgrl_{part}"] = kgrl[f"jerk_commanded_{part}"] / row[f"jerk_commanded_{part}"]
    return {
        "table": str(write_table(out / "smoothness", rows)),
        "picture": str(_draw(rows, out / "smoothness.png")),
        "exploration_rms": f"{action_scale:g} demonstration standard deviations, {outputs} outputs",
        **_claims(rows),
    }


def quiet_commands() -> np.ndarray:
    """The commands of the demonstrations alone, (N, 6)."""
    env: Any = make_environment(TASK, {"guidance": "kmp", "action_repeat": 1, "fixture_offset": "none"})
    rollout(env, still(env), seed=0, options={"offset": ELSEWHERE})
    commands = env.unwrapped.trace.commanded.copy()
    env.close()
    return commands


def measure(
    method: Method, action_dims: tuple[int, ...], quiet: np.ndarray, *, episodes: int, action_scale: float, seed: int
) -> list[dict[str, Any]]:
    """A row for free space and one for the connector.

    Args:
        method: the way to explore.
        explored: which outputs it moves.
        quiet: the commands of the demonstrations alone, (N, 6): see `quiet_commands`.
        episodes: in each place.
        action_scale: the exploration RMS, in demonstration standard deviations.
        seed: of the random actions and of the connector's offsets.
    """
    arguments = {
        "guidance": method.guidance,
        "fixture_offset": "per_episode",
        "action_repeat": 1,
        "action_dims": action_dims,
    }
    arguments |= method.environment | _strength(method, action_dims, action_scale)
    env: Any = make_environment(TASK, arguments)
    unit = deviation(reference_trajectory("insert"))[list(action_dims)]
    rows = []
    for place in PLACES:
        seen, moved, smooth, added = [], [], [], []
        for index in range(episodes):
            rng = np.random.default_rng([seed, index])
            act = method.explore(rng, len(quiet), len(action_dims))
            options = {"offset": ELSEWHERE} if place == "free" else {"held_out": True}
            seen.append(rollout(env, act, seed=seed + index, options=options))
            trace = env.unwrapped.trace
            deviated = trace.commanded - quiet[: len(trace)]
            added.append(jerk(deviated, trace.period))
            moved.append(deviated[:, list(action_dims)] / unit)
            smooth.append(_shape(trace))
        rows.append(_row(method, place, pd.DataFrame(seen), np.concatenate(moved), smooth, added))
    env.close()
    return rows


def _strength(method: Method, action_dims: tuple[int, ...], action_scale: float) -> dict[str, Any]:
    """Arguments with which random actions have an RMS of κ standard deviations where no constraint is in the way."""
    if method.guidance == "kmp":
        return {}
    # Built once more, only for its primitive: what the environment would explore with at κ = 1.
    histories = {key: value for key, value in method.environment.items() if key in ("history", "history_variance")}
    skill = make_prior_knowledge(TASK, guidance=method.guidance, action_dims=None, **histories).demonstrations
    assert skill is not None
    indices = np.array(action_dims)
    if method.guidance == "residual":  # the same for all outputs of a unit, whose deviations differ
        reached = RMS * (skill.residual_gains() / deviation(skill.reference))[indices]
        return {"action_scale": action_scale / float(np.sqrt(np.mean(reached**2)))}
    primitive = skill.primitive(history=method.guidance == "skgrl")
    if not method.environment.get("adaptive_history"):
        return {"gains": tuple(rms_gains(primitive, action_scale, method.action_repeat, indices).tolist())}
    # Each length of an adaptive history has gains of its own, which one κ sets: it is the longest that is free.
    reached = exploration_rms(primitive, skill.null_space_gains(primitive), method.action_repeat)[indices]
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
    seen: pd.DataFrame,
    moved: np.ndarray,
    smooth: list[dict[str, float]],
    added: list[dict[str, float]],
) -> dict[str, Any]:
    kinds = [f"jerk_{which}_{part}" for which in ("commanded", "measured") for part in ("linear", "angular")]
    return {
        "method": method.name,
        "place": place,
        "episodes": len(seen),
        "rms_in_deviations": float(np.sqrt(np.mean(moved**2))),
        **{kind: float(np.mean(seen[kind])) for kind in kinds},
        **{f"jerk_added_{part}": float(np.mean([one[part] for one in added])) for part in added[0]},
        **{key: float(np.mean([one[key] for one in smooth])) for key in smooth[0]},
        # In free space nothing succeeds.
        **summary(seen, ("peak_force", "mean_force", "success_rate", "ended_in_collision", "max_commanded_violation")),
    }


def _claims(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """sKGRL against KGRL with actions kept as long, and against every other way to explore, with how often it locks."""
    free = {row["method"]: row for row in rows if row["place"] == "free"}
    success = {row["method"]: row["success_rate"] for row in rows if row["place"] == "connector"}
    others = {name: row for name, row in free.items() if name.startswith("residual")}
    kgrl = free[f"KGRL repeat {HOLD}"]
    claims: dict[str, Any] = {}
    for action_repeat in (HOLD, SLOW):
        mine = f"sKGRL repeat {action_repeat}"
        ours = free[mine]
        claims[f"{mine} explores and locks"] = f"{success[mine]:.0%}"
        for part in ("linear", "angular"):
            key, measured, added = f"jerk_commanded_{part}", f"jerk_measured_{part}", f"jerk_added_{part}"
            claims[f"{mine}, {part} jerk below that of KGRL repeat {HOLD}"] = (
                f"{kgrl[key] / ours[key]:.0f} times commanded ({kgrl[added] / ours[added]:.0f} times what exploring "
                f"adds), {kgrl[measured] / ours[measured]:.1f} times measured"
            )
            claims[f"{mine}, commanded {part} jerk as a part of the demonstrations' own"] = (
                f"{ours[key] / free[ALONE][key]:.3g}"
            )
            for what, column in (("commanded", key), ("added", added)):
                claims[f"{mine}, {what} {part} jerk below"] = ", ".join(
                    f"{name.removeprefix('residual ')} ({success[name]:.0%}) {row[column] / ours[column]:.3g} times"
                    for name, row in others.items()
                )
    return claims


def _draw(rows: list[dict[str, Any]], path: Path) -> Path:
    """Jerk of every method, commanded and measured, and what it leads to on the connector."""
    figure, axes = new_figure(1, 4, (17, 0.32 * len(rows) / 2 + 2))
    free = [row for row in rows if row["place"] == "free"][::-1]
    contact = [row for row in rows if row["place"] == "connector"][::-1]
    height = np.arange(len(free))
    kinds = {ALONE: "0.6", "residual": colour("residual"), "sKGRL": colour("skgrl"), "KGRL": colour("kgrl")}
    colours = [next(colour for name, colour in kinds.items() if row["method"].startswith(name)) for row in free]
    for axis, part, unit in zip(axes[0], ("linear", "angular"), ("m/s³", "rad/s³"), strict=False):
        axis.barh(height + 0.2, [row[f"jerk_commanded_{part}"] for row in free], 0.4, color=colours)
        axis.barh(height - 0.2, [row[f"jerk_measured_{part}"] for row in free], 0.4, color=colours, alpha=0.4)
        axis.set(xscale="log", xlabel=f"{part} jerk in free space [{unit}]", title="commanded, measured (pale)")
    axes[0, 2].barh(height, [row["success_rate"] for row in contact], 0.7, color=colours)
    axes[0, 2].set(xlabel="success on the connector, exploring")
    axes[0, 3].barh(height, [row["peak_force"] for row in contact], 0.7, color=colours)
    axes[0, 3].set(xlabel="peak force on the connector [N]")
    for index, axis in enumerate(axes[0]):
        axis.set_yticks(height, [row["method"] for row in free] if index == 0 else [""] * len(free))
    return save_figure(figure, path)
