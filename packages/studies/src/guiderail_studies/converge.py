"""Convergence of simulated contact: one policy in the same episodes at several plant steps and in several engines."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.diagrams.stations.station import CONTROL_PERIOD, exact_periods, plant_period
from guiderail.models.common.errors import InputError, brief, require_extra
from guiderail.tools.environments import check_environment
from guiderail.tools.evaluation.episode import HELD_OUT_SEED, check_seed
from guiderail.tools.evaluation.evaluate import check_num_episodes, evaluate_once
from guiderail.tools.evaluation.forks import check_processes
from guiderail.tools.evaluation.metrics import summary
from guiderail.tools.evaluation.subject import Subject, find_subject
from guiderail.tools.tables import write_table

STEPS = (10.0, 5.0, 2.5, 1.25)  # default plant steps in Drake [ms]
ENGINES = {"drake": "Drake", "mujoco": "MuJoCo", "pybullet": "Bullet", "sapien": "PhysX"}  # label of each engine
ARM_OPTIONS = ("robot", "end_effector", "impedance_control")  # options that the stations of other engines lack
EPISODES = 40  # default number of episodes of each condition
MAX_DIFFERENCE = 0.05  # largest difference of success rates between a step and the finest one that agrees with it


@dataclass(frozen=True)
class Condition:
    """Engine, step [ms] and options of an environment: the plant's step in Drake, in another engine its own.

    A step of None is the engine's default. `change` describes further differences, such as the friction.
    """

    engine: str
    step: float | None
    environment: Mapping[str, Any]
    change: str = ""

    @property
    def name(self) -> str:
        """Name in the table."""
        step = "" if self.step is None else f"{self.step:g} ms"
        return ", ".join(part for part in (ENGINES[self.engine], step, self.change) if part)

    @property
    def drake_step(self) -> float | None:
        """Plant step in Drake [ms]; None in another engine."""
        return self.step if self.engine == "drake" else None


def parse_engines(text: str) -> list[str]:
    """Return engines of a comma-separated text.

    Raises:
        InputError: If an engine is unknown, repeated, or not installed.
    """
    names = [name.strip() for name in text.split(",") if name.strip()]
    if not names or set(names) - set(ENGINES) or len(set(names)) < len(names):
        raise InputError(f"--engines are {', '.join(ENGINES)}, comma-separated, not {brief(text)}")
    for name in names:
        if name != "drake":
            require_extra(name)
    return names


def in_engine(engine: str, environment: Mapping[str, Any], step: float | None) -> Condition:
    """Return the condition of an environment in an engine, with a step [ms] or None for the engine's default."""
    if engine == "drake":
        assert step is not None
        station = {"station": "gantry"} if environment.get("station") in ENGINES else {}
        kept = {name: value for name, value in environment.items() if name != "engine_step"}
        return Condition(engine, step, {**kept, **station, "time_step": step / 1e3})
    own = {} if step is None else {"engine_step": step / 1e3}
    kept = {name: value for name, value in environment.items() if name not in (*ARM_OPTIONS, "time_step")}
    return Condition(engine, step, {**kept, "station": engine, **own})


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
    names = parse_engines(engines)
    resolved = check_environment(task, environment)
    if "time_step" not in resolved:
        raise InputError(f"{task} on station={resolved.get('station')!r} has no time_step that could be refined")
    found = [
        in_engine(name, environment, step)
        for name in sorted(names, key=list(ENGINES).index)
        for step in (steps if name == "drake" else [None])
    ]
    for condition in found:
        changed = check_environment(task, condition.environment)
        if condition.drake_step is not None:
            exact_periods(changed.get("control_period") or CONTROL_PERIOD, condition.drake_step / 1e3)
    return found


def converge(
    policy: Path | str,
    *,
    task: str | None = None,
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
        policy: Run, or `pretrained:NAME`; with `task`, any policy that `find_subject` takes.
        task: Task of a policy without a run.
        steps: Plant steps in Drake [ms].
        engines: "drake", "mujoco", "pybullet" and "sapien", comma-separated.
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
    subject, out = find_run(policy, environment, out, "converge", task=task, trust_policy=trust_policy)
    config = subject.config
    assert config is not None  # a run has one
    found = conditions(config.task, subject.changed_environment(dict(environment or {})), steps, engines)
    evaluated = evaluate_conditions(subject, found, out, episodes=episodes, seed=seed, processes=processes)
    outcomes = [table["success"].to_numpy(dtype=bool) for table in evaluated]
    reference = max((i for i, c in enumerate(found) if c.drake_step is not None), default=0)
    rows = [
        {
            "condition": condition.name,
            "step_ms": condition.drake_step,
            **success_and_force(table),
            "agree_with_finest": int((outcome == outcomes[reference]).sum()),
            **_measure_contact(config.task, condition),
        }
        for condition, table, outcome in zip(found, evaluated, outcomes, strict=True)
    ]
    coarsest = coarsest_step(rows)
    table = write_table(out / "converge", rows).with_suffix(".csv")
    trained = 1e3 * plant_step(config.task, config.environment)
    warning = None
    if coarsest is not None and trained > coarsest * (1.0 + 1e-9):
        warning = (
            f"the policy was trained at {trained:g} ms, and its success changes at shorter steps: train it at "
            f"{coarsest:g} ms (--env time_step={coarsest / 1e3:g})"
        )
    return {"table": table, "rows": rows, "coarsest": coarsest, "warning": warning}


def find_run(
    policy: Path | str,
    environment: Mapping[str, Any] | None,
    out: Path | None,
    name: str,
    *,
    task: str | None = None,
    trust_policy: bool = False,
) -> tuple[Subject, Path]:
    """Return the policy of a run or one that acts in a task, and the folder to write, by default `name` in the run.

    Raises:
        InputError: If there is no trained run, or a policy without a folder has no `out`.
    """
    subject = find_subject(policy, task, environment, trust_policy=trust_policy)
    if out is None:
        if subject.folder is None or not subject.is_stored:
            raise InputError("a policy without a folder needs one for the results: give --out")
        out = subject.folder.path / name
    return subject, out


def evaluate_conditions(
    subject: Subject, found: Sequence[Condition], out: Path, *, episodes: int, seed: int, processes: int | None
) -> list[pd.DataFrame]:
    """Return the rows of the same held-out episodes under each condition, stored in the folder `out`.

    Raises:
        InputError: If an argument is invalid, or the policy does not fit an environment.
    """
    episodes, seed, processes = check_num_episodes(episodes), check_seed(seed), check_processes(processes)
    assert subject.config is not None  # a run has one
    tables = []
    for number, condition in enumerate(found, start=1):
        evaluated = evaluate_once(
            out / "episodes", subject.name, subject.config, subject.make_policy, condition.environment,
            about=subject.digest, episodes=episodes, seed=seed, label=f"{number}/{len(found)} {condition.name}",
            processes=processes,
        )  # fmt: skip
        if evaluated is None:
            raise InputError(f"the policy does not fit the environment of {condition.name}: its spaces differ")
        tables.append(evaluated)
    return tables


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


def plant_step(task: str, environment: Mapping[str, Any]) -> float:
    """Return the plant step of an environment in Drake [s]."""
    from guiderail.diagrams.envs.config import EnvConfig

    config = EnvConfig.resolve(task, dict(environment))
    return float(environment.get("time_step") or plant_period(config.declared.workcell()))


def success_and_force(rows: pd.DataFrame) -> dict[str, Any]:
    """Return success with its interval, and the largest forces of the impedance and of the contact [N]."""
    names = ("success_rate", "success_low", "success_high", "peak_force", "peak_contact_force")
    return {"episodes": len(rows), "successes": int(rows["success"].sum()), **summary(rows, names)}


def _measure_contact(task: str, condition: Condition) -> dict[str, Any]:
    """Return drag, lever arm and capture of a task with a rim, and the CPU time per simulated time; None without it."""
    from guiderail.diagrams.envs.config import EnvConfig
    from guiderail_studies.contact_probe import probe_contact

    made = EnvConfig.resolve(task, dict(condition.environment)).declared
    names = ("drag_20", "drag_40", "lever_mm", "capture_mm", "cost")
    if getattr(made, "rim_contact", lambda: None)() is None:
        return dict.fromkeys(names)
    step = {} if condition.step is None else {"time_step": condition.step / 1e3}
    probe = probe_contact(made, "gantry" if condition.engine == "drake" else condition.engine, **step)
    values = (*probe.drags, 1e3 * probe.lever, 1e3 * probe.capture, probe.cost)
    return dict(zip(names, (float(value) for value in values), strict=True))
