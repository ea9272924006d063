"""`guiderail stress`: episodes of actions that no policy should send, and what became of them."""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd

from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from guiderail.tools.environments import check_environment, make_environment
from guiderail.tools.evaluation.baselines import BASELINES, Choose
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.rollout import Callback, EnvCallback, Transition, rollout
from guiderail.tools.evaluation.step_log import StepLog
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import read_table, table_text
from research.action_fuzzing import EVERY, STRESSED
from research.action_fuzzing.recompute import Frames, RecomputedViolation, nothing_moves

# Columns of an episode's row that a campaign's table has.
COLUMNS = (
    "termination", "steps", "peak_force", "collisions", "saturated_steps", "fallback_steps", "max_commanded_violation",
    "max_measured_violation",
)  # fmt: skip


ACTIONS = {name: BASELINES[name] for name in ("uniform_random", "random_hold", "bang_bang", "random_corner")}


class Finite(EnvCallback):
    """Counts the numbers of an episode that are none."""

    def on_episode_start(self) -> None:
        """None yet."""
        self._count = 0

    def on_step(self, decision: Transition) -> None:
        """Counts those that a policy saw."""
        self._count += int(np.sum(~np.isfinite(decision.following))) + (not np.isfinite(decision.reward))

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """`not_finite`, with those of the trace."""
        trace = self.base.trace
        recorded = (trace.commanded, trace.measured, trace.force)
        return {"not_finite": self._count + sum(int(np.sum(~np.isfinite(values))) for values in recorded)}


@dataclass(frozen=True)
class Case:
    """An environment that is tried with every kind of actions."""

    name: str  # in the table
    environment: Mapping[str, Any]  # its arguments
    constrained: bool  # whether no action may lead to a command that violates the constraints
    options: Mapping[str, Any] = field(default_factory=dict)  # of every reset
    waits: bool = False  # whether its fallback is to wait, or to stop before a wall, and no failure
    limits: Mapping[str, float] | None = None  # the campaign's unless given


@dataclass(frozen=True)
class Campaign:
    """What a task is tried with, and what must not come of it.

    In no case may the simulation fail, anything be infinite, a prediction fail or a constrained command violate its
    constraints.
    """

    task: str
    cases: Sequence[Case]
    limits: Mapping[str, float]  # of columns, the witness's among them
    # Makes what watches an environment's episodes for what their rows don't tell, in numbers: the greater, the worse.
    witness: Callable[[gymnasium.Env], Callback] | None = None
    actions: Mapping[str, Choose] = field(default_factory=lambda: ACTIONS)
    frames: Frames | None = nothing_moves  # where a template's objects are, by what a reset drew; None: nobody knows


def run_campaign(
    campaign: Campaign,
    enough: Callable[[list[dict[str, Any]]], bool],
    *,
    seed: int = 0,
    out: Path | None = None,
    step_log: Path | None = None,
    environment: Mapping[str, Any] | None = None,
    say: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Runs an episode of every case with every kind of actions in turn, until there are enough.

    Args:
        campaign: what is tried.
        enough: is asked before each episode, and told the rows so far.
        seed: of the first episode; episode i has seed + i.
        out: a table that grows with every round of the cases; episodes in it are not run again.
        step_log: a folder for every control step, a file an episode; none unless given.
        environment: arguments that every case has besides its own.
        say: is told what each round came to.

    Returns:
        A row an episode: case, actions, seed, a digest of the environment, constrained, waits, `COLUMNS`,
        `not_finite`, `recomputed_violation`, and what the witness saw.

    Raises:
        InputError: if `out` holds another campaign.
    """
    kinds = [(case, name) for name in campaign.actions for case in campaign.cases]
    wheres = {case.name: {**case.environment, **(environment or {})} for case in campaign.cases}
    digests = {name: _digest(campaign.task, where) for name, where in wheres.items()}
    rows: list[dict[str, Any]] = read_table(out).to_dict("records") if out is not None and out.exists() else []
    for index, row in enumerate(rows):
        case, name = kinds[index % len(kinds)]
        expected = (case.name, name, seed + index, digests[case.name])
        if tuple(row.get(key) for key in ("case", "actions", "seed", "environment")) != expected or (
            "recomputed_violation" not in row
        ):
            raise InputError(f"{out} holds another campaign: name another file")
    environments: dict[str, tuple[gymnasium.Env, list[Callback]]] = {}
    said, began = len(rows), time.process_time()
    while not enough(rows):
        case, name = kinds[len(rows) % len(kinds)]
        if case.name not in environments:
            env = make_environment(campaign.task, wheres[case.name])
            watching: list[Callback] = [Finite(env), RecomputedViolation(env, campaign.frames)]
            watching += [campaign.witness(env)] if campaign.witness else []
            watching += [StepLog(env, step_log)] if step_log is not None else []
            environments[case.name] = env, watching
        env, watching = environments[case.name]
        own = seed + len(rows)
        act = campaign.actions[name](np.random.default_rng([own, 1]), int(np.prod(env.action_space.shape or ())))
        found = rollout(env, act, *watching, index=len(rows), seed=own, options=case.options)
        row = {"case": case.name, "actions": name, "seed": own, "environment": digests[case.name]}
        row |= {"constrained": int(case.constrained), "waits": int(case.waits)}
        known = [*COLUMNS, *list(found)[list(found).index("not_finite") :]]
        rows.append(row | {column: found[column] for column in known})
        if len(rows) % len(campaign.cases) == 0 or enough(rows):
            if out is not None:
                write_atomically(out, table_text(rows).encode())
            if say is not None:
                clock = f"{len(rows)} episodes, {time.process_time() - began:.0f} s of CPU"
                say(f"{clock}: {json.dumps(outcome(rows[said:]))}")
            said = len(rows)
    return rows


def _digest(task: str, environment: Mapping[str, Any]) -> str:
    """What an environment comes to, in a word that no table takes for a number."""
    resolved = json.dumps(check_environment(task, environment), sort_keys=True, default=str)
    return f"env-{hashlib.blake2b(resolved.encode(), digest_size=6).hexdigest()}"


def outcome(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What episodes came to: counts, and the worst of everything; a violation is of constrained guidance's commands.

    `max_commanded_violation` is the greater of what the environment says and what was recomputed from the commands;
    `disagreement` is the greatest difference of the two.
    """
    table = pd.DataFrame(rows)
    own = [
        "case", "actions", "seed", "environment", "constrained", "waits", *COLUMNS, "not_finite",
        "recomputed_violation",
    ]  # fmt: skip
    witnessed = table.columns.drop(own, errors="ignore")
    said, recomputed = (table[name].to_numpy(float) for name in ("max_commanded_violation", "recomputed_violation"))
    constrained, bounded = table["constrained"].to_numpy() == 1, recomputed > -np.inf

    def worst(of: np.ndarray) -> float | None:
        violations = np.maximum(said, recomputed)[of]
        return float(violations.max()) if len(violations) else None

    failed = table[table["waits"] == 0]
    return {
        "episodes": len(table),
        "control_steps": int(table["steps"].sum()),
        "endings": dict(Counter(table["termination"])),
        "not_finite": int(table["not_finite"].sum()),
        "fallback_steps": int(failed["fallback_steps"].sum()),
        "waits": int(table["fallback_steps"].sum() - failed["fallback_steps"].sum()),
        "max_commanded_violation": worst(constrained),
        "worst_violation_unconstrained": worst(~constrained),
        "disagreement": float(np.abs(said - recomputed)[constrained & bounded].max(initial=0.0)),
        "collisions": int(table["collisions"].sum()),
        "peak_force": float(table["peak_force"].max(skipna=False)),
        **{name: float(table[name].max(skipna=False)) for name in witnessed},
    }


def complaints(found: Mapping[str, Any], limits: Mapping[str, float]) -> list[str]:
    """What of an outcome must not be, in words."""
    wrong = []
    if found["endings"].get("simulation_failure"):
        wrong.append("the simulation failed")
    if found["not_finite"]:
        wrong.append("something was not finite")
    if found["fallback_steps"]:
        wrong.append("a prediction failed")
    if found["max_commanded_violation"] is not None and not found["max_commanded_violation"] <= TOLERANCE:
        wrong.append("a command violated the constraints")
    if not found["disagreement"] <= TOLERANCE:
        wrong.append("what was said of a command is not what it was")
    wrong += [f"{name} beyond {limit:g}" for name, limit in limits.items() if not found[name] <= limit]
    return wrong


def stress(
    task: str,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    out: Path | None = None,
    environment: Mapping[str, Any] | None = None,
    say: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Stresses a task, or all of them, for so many episodes or control steps.

    Args:
        task: a task; one of your own is tried as `own_task` says. Or "all": each of `STRESSED` gets the same part of
            the control steps.
        episodes: how many; 1000 unless given, and not for all tasks.
        steps: control steps, instead.
        seed: of the first episode of each task.
        out: of one task a table; of all a folder with a table for each, and a step log with every control step. What is in
            it is not run again.
        environment: arguments that every case has besides its own.
        say: is told what each round came to.

    Returns:
        `cases` and `all` of what came of it, and `wrong`; of all tasks `tasks`, `control_steps` and `wrong`.

    Raises:
        InputError: for an unknown task, or a number out of range.
    """
    if (episodes is not None and episodes < 1) or (steps is not None and steps < 1) or seed < 0:
        raise InputError("a stress campaign has at least one episode or control step, and a seed from 0")
    if task == EVERY:
        if steps is None or episodes is not None or environment:
            raise InputError("all tasks are stressed for a number of control steps, without --env: give --steps")
        if out is not None and out.suffix == ".csv":
            raise InputError(f"all tasks leave a folder, not the table {out}: name a folder with --out")
        return _stress_all(-(-steps // len(STRESSED)), seed=seed, out=out, say=say)
    if task not in STRESSED and task not in TASKS.names():
        remedy = did_you_mean(task, {*STRESSED, *TASKS.names(), EVERY})
        raise InputError(
            f"there is no task {brief(task)} to stress: {remedy}"
            + ("" if remedy.endswith("?") else ", or --import the file that registers it")
        )
    return _stress(task, 1000 if episodes is None else episodes, steps, seed, out, None, environment, say)


def _stress_all(steps: int, *, seed: int, out: Path | None, say: Callable[[str], None] | None) -> dict[str, Any]:
    found = {}
    for task in STRESSED:
        table, step_log = (None, None) if out is None else (out / f"{task}.csv", out / "steps" / task)
        told = None if say is None else _told(say, task)
        found[task] = _stress(task, 0, steps, seed, table, step_log, None, told)
    return {
        "tasks": found,
        "control_steps": sum(one["all"]["control_steps"] for one in found.values()),
        "max_commanded_violation": max(one["all"]["max_commanded_violation"] for one in found.values()),
        "disagreement": max(one["all"]["disagreement"] for one in found.values()),
        "wrong": [f"{task}: {words}" for task, one in found.items() for words in one["wrong"]],
    }


def _told(say: Callable[[str], None], task: str) -> Callable[[str], None]:
    return lambda words: say(f"{task}: {words}")


def _stress(
    task: str,
    episodes: int,
    steps: int | None,
    seed: int,
    out: Path | None,
    step_log: Path | None,
    environment: Mapping[str, Any] | None,
    say: Callable[[str], None] | None,
) -> dict[str, Any]:
    if task in STRESSED:
        campaign = import_module(f"research.action_fuzzing.{STRESSED[task]}").campaign()
    else:
        from research.action_fuzzing.own_task import campaign_of

        campaign = campaign_of(task)

    def enough(rows: list[dict[str, Any]]) -> bool:
        if steps is not None:
            return sum(row["steps"] for row in rows) >= steps
        return len(rows) >= episodes

    rows = run_campaign(campaign, enough, seed=seed, out=out, step_log=step_log, environment=environment, say=say)
    cases, wrong = {}, []
    for case in campaign.cases:
        if some := [row for row in rows if row["case"] == case.name]:
            cases[case.name] = outcome(some)
            limits = campaign.limits if case.limits is None else case.limits
            wrong += [f"{case.name}: {words}" for words in complaints(cases[case.name], limits)]
    return {"cases": cases, "all": outcome(rows), "wrong": wrong}
