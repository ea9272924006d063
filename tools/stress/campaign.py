"""Episodes of actions that no policy should send, and what became of them: what the tools `stress_…` share."""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from guiderail.diagrams.env import GuidedEnv
from guiderail.models.errors import InputError
from guiderail.tools.files import write_atomically
from guiderail.tools.learning.progress import TOLERANCE
from guiderail.tools.learning.run_folder import read_table, table_text
from guiderail.tools.rollouts.rollout import EpisodeRecord

Actions = Callable[[np.ndarray], np.ndarray]
KEPT = 10  # decisions for which a held action is kept
TURNS = 0.1  # how likely corner actions turn into another corner at a decision

# What is kept of an episode's row.
COLUMNS = (
    "termination",
    "steps",
    "peak_force",
    "collisions",
    "saturations",
    "fallbacks",
    "worst_violation",
    "worst_measured_violation",
)


def white(rng: np.random.Generator, size: int) -> Actions:
    """Uniform, drawn anew at every decision: an untrained policy."""
    return lambda observation: rng.uniform(-1.0, 1.0, size)


def held(rng: np.random.Generator, size: int) -> Actions:
    """Uniform, each kept for `KEPT` decisions: they lead further than white ones."""
    return _kept(lambda: rng.uniform(-1.0, 1.0, size), lambda count: count % KEPT == 0)


def corners(rng: np.random.Generator, size: int) -> Actions:
    """Full deflection, that turns into another corner now and then."""
    return _kept(lambda: rng.choice([-1.0, 1.0], size), lambda count: rng.uniform() < TURNS)


def stuck(rng: np.random.Generator, size: int) -> Actions:
    """Full deflection into one corner for the whole episode."""
    return _kept(lambda: rng.choice([-1.0, 1.0], size), lambda count: False)


def _kept(draw: Callable[[], np.ndarray], turns: Callable[[int], bool]) -> Actions:
    count, action = 0, draw()

    def act(observation: np.ndarray) -> np.ndarray:
        nonlocal count, action
        if count > 0 and turns(count):
            action = draw()
        count += 1
        return action

    return act


ACTIONS = {"white": white, "held": held, "corners": corners, "stuck": stuck}


class Witness:
    """Looks at every decision of an episode, for what its row doesn't tell."""

    def look(self) -> None:
        """Called after every decision."""

    def report(self) -> dict[str, float]:
        """What was seen, by name: the greater, the worse."""
        return {}


@dataclass(frozen=True)
class Case:
    """An environment that is tried with every kind of actions.

    Args:
        name: in the table.
        make: builds the environment.
        constrained: whether no action may lead to a command that violates the constraints.
        options: of every reset.
        witness: makes what looks at an episode.
    """

    name: str
    make: Callable[[], GuidedEnv]
    constrained: bool
    options: Mapping[str, Any] = field(default_factory=dict)
    witness: Callable[[GuidedEnv], Witness] = lambda env: Witness()


def episode(
    env: GuidedEnv,
    act: Actions,
    seed: int,
    options: Mapping[str, Any] | None = None,
    witness: Callable[[GuidedEnv], Witness] = lambda env: Witness(),
) -> dict[str, Any]:
    """Runs one episode.

    Returns:
        `COLUMNS` of its row; `not_finite`, how many numbers that came out of it were none; what the witness reports.
    """
    observation, _ = env.reset(seed=seed, options=dict(options or {}))
    record, seen, over, not_finite = EpisodeRecord(env), witness(env), False, 0
    while not over:
        observation, reward, terminated, truncated, info = env.step(act(observation))
        record.add(float(reward), info)
        seen.look()
        not_finite += np.sum(~np.isfinite(observation)) + (not np.isfinite(reward))
        over = terminated or truncated
    for recorded in (env.trace.commanded, env.trace.measured, env.trace.force):
        not_finite += np.sum(~np.isfinite(recorded))
    row = record.row(0)
    return {name: row[name] for name in COLUMNS} | {"not_finite": int(not_finite)} | seen.report()


def campaign(
    cases: Sequence[Case],
    enough: Callable[[list[dict[str, Any]]], bool],
    *,
    seed: int = 0,
    out: Path | None = None,
    say: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Runs an episode of every case with every kind of actions in turn, until there are enough.

    Args:
        cases: what is tried.
        enough: is asked before each episode, and told the rows so far.
        seed: of the first episode; episode i has seed + i.
        out: a table that grows with every round of the cases; episodes in it are not run again.
        say: is told what each round came to.

    Returns:
        A row an episode: case, actions, seed, constrained, and what `episode` returns.

    Raises:
        InputError: if `out` holds another campaign.
    """
    kinds = [(case, name) for name in ACTIONS for case in cases]
    rows = read_table(out) if out is not None and out.exists() else []
    for index, row in enumerate(rows):
        case, name = kinds[index % len(kinds)]
        if (row.get("case"), row.get("actions"), row.get("seed")) != (case.name, name, seed + index):
            raise InputError(f"{out} holds another campaign: name another file")
    environments: dict[str, GuidedEnv] = {}
    said, began = len(rows), time.process_time()
    while not enough(rows):
        case, name = kinds[len(rows) % len(kinds)]
        if case.name not in environments:
            environments[case.name] = case.make()
        env = environments[case.name]
        drawn = seed + len(rows)
        act = ACTIONS[name](np.random.default_rng([drawn, 1]), int(np.prod(env.action_space.shape)))
        row = {"case": case.name, "actions": name, "seed": drawn, "constrained": int(case.constrained)}
        rows.append(row | episode(env, act, drawn, case.options, case.witness))
        if len(rows) % len(cases) == 0 or enough(rows):
            if out is not None:
                write_atomically(out, table_text(rows).encode())
            if say is not None:
                clock = f"{len(rows)} episodes, {time.process_time() - began:.0f} s of CPU"
                say(f"{clock}: {json.dumps(summary(rows[said:]))}")
            said = len(rows)
    return rows


def summary(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """What episodes came to: counts, and the worst of everything; a violation is of constrained guidance's commands."""
    known = {"case", "actions", "seed", "constrained", *COLUMNS, "not_finite"}
    witnessed = [name for name in rows[0] if name not in known] if rows else []

    def worst(name: str, constrained: int) -> float | None:
        return max((row[name] for row in rows if row["constrained"] == constrained), default=None)

    return {
        "episodes": len(rows),
        "control_steps": sum(row["steps"] for row in rows),
        "endings": dict(Counter(str(row["termination"]) for row in rows)),
        "not_finite": sum(row["not_finite"] for row in rows),
        "fallbacks": sum(row["fallbacks"] for row in rows),
        "worst_violation": worst("worst_violation", 1),
        "worst_violation_unconstrained": worst("worst_violation", 0),
        "collisions": sum(row["collisions"] for row in rows),
        "peak_force": max(row["peak_force"] for row in rows),
        **{name: max(row[name] for row in rows) for name in witnessed},
    }


def complaints(found: Mapping[str, Any], limits: Mapping[str, float] | None = None) -> list[str]:
    """What of a summary must not be, in words; `limits` are of what witnesses reported."""
    wrong = []
    if found["endings"].get("simulation_failure"):
        wrong.append("the simulation failed")
    if found["not_finite"]:
        wrong.append("something was not finite")
    if found["fallbacks"]:
        wrong.append("a prediction failed")
    if found["worst_violation"] is not None and not found["worst_violation"] <= TOLERANCE:
        wrong.append("a command violated the constraints")
    wrong += [f"{name} beyond {limit:g}" for name, limit in (limits or {}).items() if not found[name] <= limit]
    return wrong


def run(
    description: str,
    cases: Sequence[Case],
    arguments: Sequence[str] | None = None,
    limits: Mapping[str, float] | None = None,
) -> int:
    """The command line of a campaign; prints a summary per case and of all, and returns the exit code."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--episodes", type=int, default=1000, help="in all")
    parser.add_argument("--steps", type=int, help="control steps in all, instead of --episodes")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode; each has its own")
    parser.add_argument("--out", type=Path, help="a table (.csv); with it, a campaign that was stopped goes on")
    options = parser.parse_args(arguments)
    if (options.steps or options.episodes) < 1 or options.seed < 0:
        parser.error("there must be at least one episode, and a seed from 0")

    def enough(rows: list[dict[str, Any]]) -> bool:
        if options.steps is not None:
            return sum(row["steps"] for row in rows) >= options.steps
        return len(rows) >= options.episodes

    try:
        rows = campaign(
            cases,
            enough,
            seed=options.seed,
            out=options.out,
            say=lambda words: print(words, file=sys.stderr, flush=True),
        )
    except InputError as error:
        parser.error(str(error))
    by_case = {case.name: [row for row in rows if row["case"] == case.name] for case in cases}
    total = summary(rows)
    wrong = complaints(total, limits)
    found = {"cases": {name: summary(some) for name, some in by_case.items() if some}, "all": total, "wrong": wrong}
    print(json.dumps(found, indent=2))
    return 1 if wrong else 0
