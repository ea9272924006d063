"""Runs of a method by the rules of a protocol, and the check of a protocol's policies without learning."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from guiderail.models.common.errors import InputError
from guiderail.models.common.files import write_atomically
from guiderail.tools.evaluation.metrics import STATISTICS
from guiderail.tools.tables import read_table
from guiderail_studies.benchmark.protocol import (
    EVALUATED_FILE,
    FLOORS,
    BenchmarkMethod,
    Protocol,
    floor_study,
    load_protocol,
    method_study,
)
from guiderail_studies.engines.engine import Engine
from guiderail_studies.job import Job, cpu_time
from guiderail_studies.study import run_study

HOUR = 3600.0
METHOD_FILE = "method.json"  # the method and the version of the protocol, in the folder of its runs


@dataclass(frozen=True)
class Column:
    """Column of the benchmark's table: a number of one run."""

    name: str
    unit: str
    description: str
    compute: Callable[[pd.DataFrame, pd.DataFrame], float]  # function of training and evaluated episodes


COLUMNS = (
    Column("success_rate", "", "held-out episodes that succeeded", lambda t, e: float(e["success"].mean())),
    Column("training_episodes", "", "training episodes, with demonstrations", lambda t, e: len(t)),
    Column(
        "over_limit_events",
        "",
        "times at which the force or the task's collision signal exceeded its limit in training",
        lambda t, e: int(t["collisions"].sum()),
    ),
    Column("training_cost", "control steps", "sum of `info['cost']` in training", lambda t, e: int(t["cost"].sum())),
    Column(
        "commanded_violations",
        "episodes",
        "training episodes with a commanded pose outside the constraints",
        lambda t, e: STATISTICS["violating_episodes"].compute(t),
    ),
    Column(
        "measured_violations",
        "episodes",
        "training episodes with a measured pose outside the constraints",
        lambda t, e: STATISTICS["measured_violating_episodes"].compute(t),
    ),
    Column(
        "transient_force",
        "N",
        "largest contact force of any control step of a held-out episode, low-pass filtered (10 ms)",
        lambda t, e: float(e["peak_contact_force"].max()),
    ),
    Column(
        "quasi_static_force",
        "N",
        "largest contact force of a held-out episode that lasts 0.5 s",
        lambda t, e: float(e["quasi_static_force"].max()),
    ),
    Column(
        "impedance_force",
        "N",
        "largest force of the impedance, or of the contact without an impedance, in held-out episodes",
        lambda t, e: float(e["peak_force"].max()),
    ),
    Column(
        "training_transient_force",
        "N",
        "as `transient_force`, in training",
        lambda t, e: float(t["peak_contact_force"].max()),
    ),
    Column(
        "jerk_commanded",
        "m/s³",
        "mean commanded jerk of the position in held-out episodes",
        lambda t, e: float(e["jerk_commanded_linear"].mean()),
    ),
    Column(
        "jerk_measured",
        "m/s³",
        "mean measured jerk of the position in held-out episodes",
        lambda t, e: float(e["jerk_measured_linear"].mean()),
    ),
)
"""Columns of the table, computed from the episodes of a run; `core_seconds` is added by `run_row`."""


def run_row(task: str, seed: int, training: pd.DataFrame, evaluated: pd.DataFrame, seconds: float) -> dict[str, Any]:
    """Return the row of a run.

    Args:
        task: Name of the task in the protocol.
        seed: Seed of training.
        training: Training episodes.
        evaluated: Held-out episodes.
        seconds: CPU time of training and evaluation [s].

    Raises:
        InputError: If a column of the episodes is missing.
    """
    try:
        values = {column.name: column.compute(training, evaluated) for column in COLUMNS}
    except (KeyError, TypeError) as error:
        raise InputError(
            f"the episodes of {task}, seed {seed}, lack numbers that the table needs ({error}): run it again"
        ) from error
    return {"task": task, "seed": seed, **values, "core_seconds": seconds}


def estimate_hours(protocol: Protocol, method: BenchmarkMethod, tasks: Sequence[str], num_seeds: int) -> float:
    """Return the expected CPU time of a method's runs [core-hours], from the measured time of the reference method."""
    seconds = [protocol.tasks[name].core_seconds for name in tasks if method.applies(name)]
    return method.cost * num_seeds * sum(seconds) / HOUR


def run_method(
    protocol: Protocol,
    method: BenchmarkMethod,
    out: Path,
    *,
    tasks: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    engine: Engine | None = None,
    log: Callable[[str], object] = print,
) -> dict[str, Any]:
    """Train and evaluate a method; the same call resumes.

    Args:
        protocol: Protocol.
        method: Method.
        out: Folder of the method's runs; `out/TASK/SEED` is the folder of a run.
        tasks: Names of tasks; by default all that the method applies to.
        seeds: Seeds of the protocol; all by default.
        engine: Engine that runs the jobs; two processes by default.
        log: Function that prints the expected cost before anything is run.

    Returns:
        `core_hours`, the CPU time that the finished runs took, and the mean success rate by task.

    Raises:
        InputError: If a choice is not allowed by the protocol, or `out` has runs of another method or protocol.
        RunsFailedError: As in `run_study`.
    """
    chosen = [name for name in protocol.select(tasks) if method.applies(name)]
    numbers = list(protocol.seeds if seeds is None else seeds)
    if unknown := [seed for seed in numbers if seed not in protocol.seeds]:
        raise InputError(
            f"protocol {protocol.version} has no seed {unknown[0]}: its seeds are {', '.join(map(str, protocol.seeds))}"
        )
    if not chosen:
        raise InputError(f"{method.name} does not apply to these tasks: name others")
    studies = [method_study(protocol, name, method, numbers) for name in chosen]
    _write_method(protocol, method, chosen, out)
    hours = estimate_hours(protocol, method, chosen, len(numbers))
    number = len(chosen) * len(numbers)
    runs = f"{number} run{'s' * (number > 1)} of {method.name}"
    log(f"{runs}, about {hours:.2g} core-hours; finished runs are not repeated")
    result: dict[str, Any] = {}
    for study, name in zip(studies, chosen, strict=True):
        rows = run_study(study, out / name, engine)
        result[f"{name}, success"] = float(rows["success_rate"].mean())
    logs = [Job(study, method.name, seed, out / study.name).log for study in studies for seed in study.seeds]
    result["core_hours"] = sum(map(cpu_time, logs)) / HOUR
    return result


def _write_method(protocol: Protocol, method: BenchmarkMethod, tasks: Sequence[str], out: Path) -> None:
    """Write the method into the folder of its runs, or raise an InputError if it has runs of another one."""
    digests: dict[str, str] = {}
    if (out / METHOD_FILE).exists():
        stored_protocol, stored, digests = stored_method(out)
        if stored_protocol.version != protocol.version or stored != method:
            raise InputError(
                f"{out} has runs of another method, or of another protocol: name another folder with --out"
            )
    digests |= {name: protocol.task_digest(name) for name in tasks}
    content = {"protocol": protocol.version, "digests": digests, "method": method.model_dump(mode="json")}
    write_atomically(out / METHOD_FILE, json.dumps(content, indent=1).encode())


def stored_method(out: Path) -> tuple[Protocol, BenchmarkMethod, dict[str, str]]:
    """Return the protocol, the method and the digests of the tasks of a folder of runs.

    Raises:
        InputError: If there is no method in the folder, or the rules of a task have changed since its runs.
    """
    file = out / METHOD_FILE
    if not file.is_file():
        raise InputError(f"there is no {METHOD_FILE} in {out}: name a folder that guiderail benchmark run wrote")
    content = json.loads(file.read_text(encoding="utf-8"))
    protocol = load_protocol(content["protocol"])
    check_digests(protocol, content["digests"], out)
    return protocol, BenchmarkMethod.model_validate(content["method"]), content["digests"]


def check_digests(protocol: Protocol, digests: Mapping[str, str], source: Path) -> None:
    """Raise an InputError if tasks that were run are unknown to the protocol, or their rules have changed."""
    for name, digest in digests.items():
        if name not in protocol.tasks or protocol.task_digest(name) != digest:
            raise InputError(
                f"{source} was run on {name} with other rules than protocol {protocol.version}: run it again"
            )


@dataclass(frozen=True)
class FinishedRun:
    """Trained and evaluated run."""

    task: str  # name of the task in the protocol
    seed: int
    training: pd.DataFrame  # training episodes
    evaluated: pd.DataFrame  # held-out episodes
    policy: Path  # folder of the policy
    seconds: float  # CPU time [s]

    @property
    def row(self) -> dict[str, Any]:
        """Row of the table."""
        return run_row(self.task, self.seed, self.training, self.evaluated, self.seconds)


def finished_runs(protocol: Protocol, method: BenchmarkMethod, out: Path) -> Iterator[FinishedRun]:
    """Yield every trained and evaluated run in a folder of runs, in the order of the protocol."""
    for name, task in protocol.tasks.items():
        for seed in protocol.seeds:
            folder = out / name / str(seed)
            files = folder / "episodes.csv", folder / EVALUATED_FILE
            policy = folder / "after_episodes" / str(task.episodes)
            if not all(file.is_file() for file in (*files, policy / "policy.json")):
                continue
            training, evaluated = map(read_table, files)
            if len(training) == task.episodes and len(evaluated) == protocol.episodes:
                study = method_study(protocol, name, method, (seed,))
                seconds = cpu_time(Job(study, method.name, seed, out / name).log)
                yield FinishedRun(name, seed, training, evaluated, policy, seconds)


def check_floors(
    protocol: Protocol,
    out: Path,
    *,
    tasks: Sequence[str] | None = None,
    episodes: int | None = None,
    engine: Engine | None = None,
) -> tuple[list[dict[str, Any]], list[str]]:
    """Measure the success of the policies without learning, and compare it with the bounds of the protocol.

    Returns:
        A row for each task and policy, and a sentence for each bound that is not met.

    Raises:
        InputError, RunsFailedError: As in `run_study`.
    """
    rows, failures = [], []
    for name in protocol.select(tasks):
        study = floor_study(protocol, name, protocol.floor_episodes if episodes is None else episodes)
        table = run_study(study, out / name, engine).set_index("method")
        rates = {policy: float(table.loc[policy, "success_rate"]) for policy in FLOORS}
        rows += [{"task": name, "policy": policy, "success_rate": rate} for policy, rate in rates.items()]
        failures += floor_failures(protocol, name, rates)
    return rows, failures


def floor_failures(protocol: Protocol, task: str, rates: Mapping[str, float]) -> list[str]:
    """Return a sentence for each bound of the protocol that the success rates of policies without learning break."""
    failures = []
    if not rates.get("uniform_random", np.nan) <= protocol.max_random:
        failures.append(f"{task}: uniform random actions may succeed in at most {protocol.max_random:.0%}")
    if not rates.get("scripted", np.nan) >= protocol.min_scripted:
        failures.append(f"{task}: the scripted policy must succeed in at least {protocol.min_scripted:.0%}")
    return failures
