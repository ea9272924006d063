"""Passport of a policy: success and forces in several physics engines, at finer steps and under disturbances."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.stations.station import CONTROL_PERIOD, exact_periods
from guiderail.models.common.errors import InputError
from guiderail.tools.environments import check_environment
from guiderail.tools.evaluation.episode import HELD_OUT_SEED
from guiderail.tools.tables import write_table
from guiderail_studies.converge import (
    ENGINES,
    Condition,
    evaluate_conditions,
    find_run,
    in_engine,
    parse_engines,
    plant_step,
    success_and_force,
)
from guiderail_studies.robustness import points, select_axes

EPISODES = 20  # default number of episodes of each condition
# Divisors of each engine's default step.
DIVISIONS = {"drake": (1, 2, 4), "mujoco": (1, 2), "pybullet": (1, 2), "sapien": (1, 2)}
ENGINE_STEP = 1.0  # default step of the engines other than Drake [ms]
CHANGES = {"friction": (0.5, 2.0), "clearance": (0.5,)}  # values of the axes of `robustness`, at the default step


def installed_engines() -> str:
    """Return the engines that are installed, comma-separated."""
    return ",".join(name for name in ENGINES if name == "drake" or find_spec(name) is not None)


def passport_conditions(
    task: str, environment: Mapping[str, Any], engines: str, log: Callable[[str], None]
) -> list[Condition]:
    """Return the conditions of an environment: each engine's default and finer steps, and changes at the default.

    A sentence on each change that an environment does not have is logged.

    Raises:
        InputError: If an engine is unknown or not installed, the task does not run in it, or it has no plant step.
    """
    names = parse_engines(engines)
    resolved = check_environment(task, environment)
    if "time_step" not in resolved:
        raise InputError(f"{task} on station={resolved.get('station')!r} has no contact that other engines simulate")
    axes = [replace(axis, values=CHANGES[axis.name]) for axis in select_axes(",".join(CHANGES))]
    steps: list[Condition] = []
    changes: list[Condition] = []
    for name in names:
        own_step = 1e3 * (environment.get("engine_step") or 0.0) or ENGINE_STEP
        # Rounded, because Drake's exact period differs from 5 ms by 1e-10; `converge` evaluates the same steps.
        default = round(1e3 * plant_step(task, environment), 6) if name == "drake" else own_step
        own = [in_engine(name, environment, default / division) for division in DIVISIONS[name]]
        for condition in own:
            check_environment(task, condition.environment)
            if condition.drake_step is not None:
                exact_periods(resolved.get("control_period") or CONTROL_PERIOD, condition.drake_step / 1e3)
        changed, left_out = points(task, own[0].environment, axes)
        for sentence in left_out:
            log(f"{ENGINES[name]}: {sentence}")
        steps += own
        changes += [
            replace(own[0], environment=point.environment, change=f"{point.axis.name} × {point.value:g}")
            for point in changed
        ]
    return steps + changes


def passport(
    policy: Path | str,
    *,
    task: str | None = None,
    engines: str | None = None,
    episodes: int = EPISODES,
    seed: int = HELD_OUT_SEED,
    environment: Mapping[str, Any] | None = None,
    out: Path | None = None,
    log: Callable[[str], None] = lambda sentence: None,
    processes: int | None = None,
    trust_policy: bool = False,
) -> dict[str, Any]:
    """Evaluate a run's policy in the same held-out episodes in several engines, at finer steps and with changes.

    The episodes are stored in `out`, so that the same call resumes an interrupted evaluation.

    Args:
        policy: Run, or `pretrained:NAME`; with `task`, any policy that `find_subject` takes.
        task: Task of a policy without a run.
        engines: "drake", "mujoco", "pybullet" and "sapien", comma-separated; None for those that are installed.
        episodes: Number of held-out episodes of each condition, with the same seeds.
        seed: Seed of the first episode.
        environment: Options of the environment that differ from training.
        out: Folder to write; by default `passport` in the run.
        log: Function called with a sentence on each change that is left out.
        processes: Largest number of processes; None for the number of cores.
        trust_policy: True to read a policy file that can execute code.

    Returns:
        `table`, the path of the table; `rows`, its rows; `predictions`, those of `predict_left_out`; `weakest`, the
        name of the condition with the lowest success rate.

    Raises:
        InputError: If there is no trained run, or an argument is invalid or missing.
    """
    subject, out = find_run(policy, environment, out, "passport", task=task, trust_policy=trust_policy)
    config = subject.config
    assert config is not None  # a run has one
    options = subject.changed_environment(dict(environment or {}))
    found = passport_conditions(config.task, options, engines or installed_engines(), log)
    evaluated = evaluate_conditions(subject, found, out, episodes=episodes, seed=seed, processes=processes)
    rows = [
        {
            "condition": condition.name, "engine": condition.engine, "step_ms": condition.step,
            "change": condition.change, **success_and_force(table),
        }
        for condition, table in zip(found, evaluated, strict=True)
    ]  # fmt: skip
    predictions = predict_left_out(rows)
    table = write_table(out / "table", rows).with_suffix(".csv")
    if predictions:
        write_table(out / "predictions", predictions)
    weakest = min(rows, key=lambda row: row["success_rate"])["condition"]
    return {"table": table, "rows": rows, "predictions": predictions, "weakest": weakest}


def predict_left_out(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Predict the success rate in each engine from the other engines; no rows with a single engine.

    The prediction is the mean success rate under all conditions of the other engines, because a policy that fails with
    other friction or clearance can be expected to fail in another engine as well. Its interval contains the intervals
    of these conditions. The measured rate is that at the engine's default step without changes.
    """
    engines = list(dict.fromkeys(row["engine"] for row in rows))
    if len(engines) < 2:
        return []
    predictions = []
    for engine in engines:
        measured = next(row["success_rate"] for row in rows if row["engine"] == engine)
        others = [row for row in rows if row["engine"] != engine]
        predicted = float(np.mean([row["success_rate"] for row in others]))
        predictions.append(
            {
                "left_out": ENGINES[engine], "predicted": predicted,
                "low": min(row["success_low"] for row in others), "high": max(row["success_high"] for row in others),
                "measured": measured, "error": predicted - measured,
            }
        )  # fmt: skip
    return predictions
