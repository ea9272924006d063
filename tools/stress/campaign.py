"""`guiderail stress`: episodes of actions that no policy should send, and what became of them."""

from __future__ import annotations

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

from guiderail.models.errors import InputError
from guiderail.models.registry import did_you_mean
from guiderail.tools.files import write_atomically
from guiderail.tools.rollouts.metrics import TOLERANCE
from guiderail.tools.rollouts.null_policies import NULL_POLICIES, Choose
from guiderail.tools.rollouts.rollout import Decision, EnvObserver, Observer, rollout
from guiderail.tools.stress import STRESSED
from guiderail.tools.tables import read_table, table_text
from guiderail.tools.tasks import make_environment

# Columns of an episode's row that a campaign's table has.
COLUMNS = (
    "termination", "steps", "peak_force", "collisions", "saturations", "fallbacks", "worst_violation",
    "worst_measured_violation",
)  # fmt: skip


ACTIONS = {name: NULL_POLICIES[name] for name in ("white", "held", "corners", "stuck")}


class Finite(EnvObserver):
    """Counts the numbers of an episode that are none."""

    def begin(self) -> None:
        """None yet."""
        self._count = 0

    def see(self, decision: Decision) -> None:
        """Counts those that a policy saw."""
        self._count += int(np.sum(~np.isfinite(decision.following))) + (not np.isfinite(decision.reward))

    def end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
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
    witness: Callable[[gymnasium.Env], Observer] | None = None
    actions: Mapping[str, Choose] = field(default_factory=lambda: ACTIONS)


def run_campaign(
    campaign: Campaign,
    enough: Callable[[list[dict[str, Any]]], bool],
    *,
    seed: int = 0,
    out: Path | None = None,
    environment: Mapping[str, Any] | None = None,
    say: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Runs an episode of every case with every kind of actions in turn, until there are enough.

    Args:
        campaign: what is tried.
        enough: is asked before each episode, and told the rows so far.
        seed: of the first episode; episode i has seed + i.
        out: a table that grows with every round of the cases; episodes in it are not run again.
        environment: arguments that every case has besides its own.
        say: is told what each round came to.

    Returns:
        A row an episode: case, actions, seed, constrained, `COLUMNS`, `not_finite`, and what the witness saw.

    Raises:
        InputError: if `out` holds another campaign.
    """
    kinds = [(case, name) for name in campaign.actions for case in campaign.cases]
    rows: list[dict[str, Any]] = read_table(out).to_dict("records") if out is not None and out.exists() else []
    for index, row in enumerate(rows):
        case, name = kinds[index % len(kinds)]
        if (row.get("case"), row.get("actions"), row.get("seed")) != (case.name, name, seed + index):
            raise InputError(f"{out} holds another campaign: name another file")
    environments: dict[str, tuple[gymnasium.Env, list[Observer]]] = {}
    said, began = len(rows), time.process_time()
    while not enough(rows):
        case, name = kinds[len(rows) % len(kinds)]
        if case.name not in environments:
            env = make_environment(campaign.task, {**case.environment, **(environment or {})})
            watching = [Finite(env), *([campaign.witness(env)] if campaign.witness else [])]
            environments[case.name] = env, watching
        env, watching = environments[case.name]
        own = seed + len(rows)
        act = campaign.actions[name](np.random.default_rng([own, 1]), int(np.prod(env.action_space.shape or ())))
        found = rollout(env, act, *watching, seed=own, options=case.options)
        row = {"case": case.name, "actions": name, "seed": own, "constrained": int(case.constrained)}
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


def outcome(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What episodes came to: counts, and the worst of everything; a violation is of constrained guidance's commands."""
    table = pd.DataFrame(rows)
    witnessed = table.columns.drop(["case", "actions", "seed", "constrained", *COLUMNS, "not_finite"], errors="ignore")

    def worst(constrained: int) -> float | None:
        violations = table["worst_violation"][table["constrained"] == constrained]
        return float(violations.max(skipna=False)) if len(violations) else None

    return {
        "episodes": len(table),
        "control_steps": int(table["steps"].sum()),
        "endings": dict(Counter(table["termination"])),
        "not_finite": int(table["not_finite"].sum()),
        "fallbacks": int(table["fallbacks"].sum()),
        "worst_violation": worst(1),
        "worst_violation_unconstrained": worst(0),
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
    if found["fallbacks"]:
        wrong.append("a prediction failed")
    if found["worst_violation"] is not None and not found["worst_violation"] <= TOLERANCE:
        wrong.append("a command violated the constraints")
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
    """Stresses a task for so many episodes or control steps; `cases` and `all` of what came of it, and `wrong`.

    Raises:
        InputError: for a task without a campaign, or a number out of range.
    """
    episodes = 1000 if episodes is None else episodes
    if episodes < 1 or (steps is not None and steps < 1) or seed < 0:
        raise InputError("a stress campaign has at least one episode or control step, and a seed from 0")
    if task not in STRESSED:
        raise InputError(f"nobody wrote down how to stress {task!r}: {did_you_mean(task, STRESSED)}")
    campaign = import_module(f"guiderail.tools.stress.{STRESSED[task]}").campaign()

    def enough(rows: list[dict[str, Any]]) -> bool:
        if steps is not None:
            return sum(row["steps"] for row in rows) >= steps
        return len(rows) >= episodes

    rows = run_campaign(campaign, enough, seed=seed, out=out, environment=environment, say=say)
    by_case = {case.name: [row for row in rows if row["case"] == case.name] for case in campaign.cases}
    total = outcome(rows)
    cases = {name: outcome(some) for name, some in by_case.items() if some}
    return {"cases": cases, "all": total, "wrong": complaints(total, campaign.limits)}
