"""Convergence of simulated contact: one policy in the same episodes at several plant steps and in several engines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.stations.station import CONTROL_PERIOD, exact_periods, plant_period
from guiderail.models.common.errors import InputError, brief
from guiderail.tools.environments import check_environment
from guiderail.tools.evaluation.episode import HELD_OUT_SEED, check_seed
from guiderail.tools.evaluation.evaluate import check_num_episodes, evaluate_once
from guiderail.tools.evaluation.forks import check_processes
from guiderail.tools.evaluation.metrics import wilson
from guiderail.tools.evaluation.subject import find_subject
from guiderail.tools.tables import write_table

STEPS = (10.0, 5.0, 2.5, 1.25)  # default plant steps in Drake [ms]
ENGINES = ("drake", "mujoco")
EPISODES = 40  # default number of episodes of each condition
MAX_DIFFERENCE = 0.05  # largest difference of success rates between a step and the finest one that agrees with it


@dataclass(frozen=True)
class Condition:
    """Engine, and plant step [ms] in Drake; MuJoCo has its own step."""

    engine: str
    step: float | None
    environment: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name in the table."""
        return "MuJoCo" if self.step is None else f"Drake, {self.step:g} ms"


def parse_steps(text: str) -> tuple[float, ...]:
    """Return plant steps [ms] of a comma-separated text, the longest first.

    Raises:
        InputError: If a step is not a positive number, or is repeated.
    """
    try:
        steps = sorted((float(part) for part in text.split(",")), reverse=True)
    except ValueError:
        steps = []
    if not steps or not all(np.isfinite(step) and step > 0.0 for step in steps) or len(set(steps)) < len(steps):
        raise InputError(f"--steps are different positive numbers of milliseconds, such as 10,5,2.5, not {brief(text)}")
    return tuple(steps)


def conditions(task: str, environment: Mapping[str, Any], steps: Sequence[float], engines: str) -> list[Condition]:
    """Return the conditions of an environment, the longest step first.

    Raises:
        InputError: If an engine is unknown, the task has no plant step or does not run in an engine, or a step does not
            divide the control period.
    """
    names = [name.strip() for name in engines.split(",") if name.strip()]
    if not names or set(names) - set(ENGINES):
        raise InputError(f"--engines are {' and '.join(ENGINES)}, comma-separated, not {brief(engines)}")
    resolved = check_environment(task, environment)
    if "time_step" not in resolved:
        raise InputError(f"{task} on station={resolved.get('station')!r} has no time_step that could be refined")
    found = []
    if "drake" in names:
        station = {"station": "gantry"} if resolved.get("station") == "mujoco" else {}
        found = [Condition("drake", step, {**environment, **station, "time_step": step / 1e3}) for step in steps]
    if "mujoco" in names:
        arm_options = ("robot", "end_effector", "impedance_control")  # options that the station of MuJoCo lacks
        kept = {name: value for name, value in environment.items() if name not in (*arm_options, "time_step")}
        found.append(Condition("mujoco", None, {**kept, "station": "mujoco"}))
    for condition in found:
        changed = check_environment(task, condition.environment)
        if condition.step is not None:
            exact_periods(changed.get("control_period") or CONTROL_PERIOD, condition.step / 1e3)
    return found


def converge(
    policy: Path | str,
    *,
    steps: Sequence[float] = STEPS,
    engines: str = "drake",
    episodes: int = EPISODES,
    seed: int = HELD_OUT_SEED,
    environment: Mapping[str, Any] | None = None,
    out: Path | None = None,
    processes: int | None = None,
    trust_policy: bool = False,
) -> dict[str, Any]:
    """Evaluate a run's policy in the same held-out episodes at several plant steps, and measure the contact.

    The episodes are stored in `out`, so that the same call resumes an interrupted evaluation.

    Args:
        policy: Run, or `pretrained:NAME`.
        steps: Plant steps in Drake [ms].
        engines: "drake", "mujoco", or both, comma-separated.
        episodes: Number of held-out episodes of each condition, with the same seeds.
        seed: Seed of the first episode.
        environment: Options of the environment that differ from training.
        out: Folder to write; by default `converge` in the run.
        processes: Largest number of processes; None for the number of cores.
        trust_policy: True to read a policy file that can execute code.

    Returns:
        `table`, the path of the table; `rows`, its rows; `coarsest`, the longest step [ms] that agrees with the
        shortest one, as all steps between them do; `warning`, a sentence if the policy was trained at a longer one.

    Raises:
        InputError: If there is no trained run, or an argument is invalid or missing.
    """
    episodes, seed, processes = check_num_episodes(episodes), check_seed(seed), check_processes(processes)
    subject = find_subject(policy, None, environment, trust_policy=trust_policy)
    config = subject.config
    assert config is not None  # a run has one
    if out is None:
        if subject.folder is None or not subject.is_stored:
            raise InputError("a policy without a folder needs one for the table: give --out")
        out = subject.folder.path / "converge"
    options = subject.changed_environment(dict(environment or {}))
    found = conditions(config.task, options, steps, engines)
    rows: list[dict[str, Any]] = []
    outcomes: list[np.ndarray] = []
    for number, condition in enumerate(found, start=1):
        evaluated = evaluate_once(
            out / "episodes", subject.name, config, subject.make_policy, condition.environment,
            about=subject.digest, episodes=episodes, seed=seed, label=f"{number}/{len(found)} {condition.name}",
            processes=processes,
        )  # fmt: skip
        if evaluated is None:
            raise InputError(f"the policy does not fit the environment of {condition.name}: its spaces differ")
        outcomes.append(evaluated["success"].to_numpy(dtype=bool))
        rows.append({"condition": condition.name, "step_ms": condition.step, **_statistics(evaluated)})
    reference = max((i for i, c in enumerate(found) if c.step is not None), default=0)
    for row, outcome, condition in zip(rows, outcomes, found, strict=True):
        row["agree_with_finest"] = int((outcome == outcomes[reference]).sum())
        row |= _measure_contact(config.task, condition)
    coarsest = coarsest_step(rows)
    table = write_table(out / "converge", rows).with_suffix(".csv")
    trained = 1e3 * _trained_step(config.task, config.environment)
    warning = None
    if coarsest is not None and trained > coarsest * (1.0 + 1e-9):
        warning = (
            f"the policy was trained at {trained:g} ms, and its success changes at shorter steps: train it at "
            f"{coarsest:g} ms (--env time_step={coarsest / 1e3:g})"
        )
    return {"table": table, "rows": rows, "coarsest": coarsest, "warning": warning}


def coarsest_step(rows: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the longest step [ms] from which on all steps agree with the shortest one; None without steps.

    Steps agree if their success rates differ by at most `MAX_DIFFERENCE`.
    """
    of_steps = sorted((row for row in rows if row["step_ms"] is not None), key=lambda row: row["step_ms"])
    coarsest = None
    for row in of_steps:
        if abs(row["success_rate"] - of_steps[0]["success_rate"]) > MAX_DIFFERENCE + 1e-9:
            break
        coarsest = float(row["step_ms"])
    return coarsest


def _trained_step(task: str, environment: Mapping[str, Any]) -> float:
    """Return the plant step of an environment [s]."""
    from guiderail.diagrams.envs.config import EnvConfig

    config = EnvConfig.resolve(task, dict(environment))
    return float(environment.get("time_step") or plant_period(config.declared.workcell()))


def _statistics(rows: pd.DataFrame) -> dict[str, Any]:
    successes = int(rows["success"].sum())
    low, high = wilson(successes, len(rows))
    return {
        "episodes": len(rows),
        "successes": successes,
        "success_rate": successes / len(rows),
        "success_low": low,
        "success_high": high,
        "peak_force": float(rows["peak_force"].max()),
    }


def _measure_contact(task: str, condition: Condition) -> dict[str, Any]:
    """Return drag, lever arm and capture of a task with a rim, and the CPU time per simulated time; None without it."""
    from guiderail.diagrams.envs.config import EnvConfig
    from guiderail_studies.contact_probe import probe_contact

    made = EnvConfig.resolve(task, dict(condition.environment)).declared
    names = ("drag_20", "drag_40", "lever_mm", "capture_mm", "cost")
    if getattr(made, "rim_contact", lambda: None)() is None:
        return dict.fromkeys(names)
    step = {} if condition.step is None else {"time_step": condition.step / 1e3}
    probe = probe_contact(made, "gantry" if condition.engine == "drake" else "mujoco", **step)
    values = (*probe.drags, 1e3 * probe.lever, 1e3 * probe.capture, probe.cost)
    return dict(zip(names, (float(value) for value in values), strict=True))
