"""Campaigns of episodes with random actions, and the checks on their outcome."""

from __future__ import annotations

import hashlib
import json
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pandas as pd
from pydrake.math import RigidTransform

from guiderail.diagrams.envs.assemble import template_of
from guiderail.diagrams.envs.config import EnvConfig
from guiderail.models.common.errors import InputError
from guiderail.models.common.transforms import pose_to_transform
from guiderail.tools.environments import check_environment, make_environment
from guiderail.tools.evaluation.baselines import BASELINES, BaselineFactory
from guiderail.tools.evaluation.episode import Callback, EnvCallback, Transition
from guiderail.tools.evaluation.metrics import TOLERANCE
from guiderail.tools.evaluation.rollout import rollout
from guiderail.tools.evaluation.step_log import StepLog
from guiderail.tools.files import write_atomically
from guiderail.tools.tables import read_table, table_text

# Columns of an episode's row that the table of a campaign has.
COLUMNS = (
    "termination", "steps", "peak_force", "collisions", "saturated_steps", "fallback_steps", "max_commanded_violation",
    "max_measured_violation",
)  # fmt: skip
ACTIONS = {name: BASELINES[name] for name in ("uniform_random", "random_hold", "bang_bang", "random_corner")}


class NonFiniteCounter(EnvCallback):
    """Callback that counts the NaN and infinite values of an episode."""

    def on_episode_start(self) -> None:
        """Reset the count."""
        self._count = 0

    def on_step(self, transition: Transition) -> None:
        """Count the values in observation and reward."""
        self._count += int(np.sum(~np.isfinite(transition.next_observation))) + (not np.isfinite(transition.reward))

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return `not_finite`, which includes the values of the trace."""
        trace = self.base.trace
        recorded = (trace.commanded, trace.measured, trace.force)
        return {"not_finite": self._count + sum(int(np.sum(~np.isfinite(values))) for values in recorded)}


Frames = Callable[[Mapping[str, Any]], Mapping[str, RigidTransform]]
"""Function from the values sampled at a reset to the poses of a template's objects."""


def nominal_frames(sampled: Mapping[str, Any]) -> Mapping[str, RigidTransform]:
    """Return an empty mapping, which means that every object has its nominal pose."""
    return {}


class RecomputedViolation(EnvCallback):
    """Callback that adds `recomputed_violation`, the largest violation of an episode's commands; −inf if unconstrained.

    It is computed with NumPy from the recorded `desired_pose` and the task's constraints, or the template's active
    constraints in the state of each control step. It does not depend on the systems that report violations.
    """

    def __init__(self, env: gymnasium.Env, frames: Frames | None = nominal_frames):
        """Construct the callback.

        Args:
            env: Environment of a declared task.
            frames: Poses of the template's objects. If None, the poses are unknown, and only the task's constraints
                are recomputed.
        """
        super().__init__(env)
        self._frames = frames

    def on_episode_end(self, row: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return `recomputed_violation`."""
        config: EnvConfig | None = getattr(self.base.diagram, "config", None)
        if config is None or not len(self.base.trace):
            return {"recomputed_violation": -np.inf}
        return {"recomputed_violation": float(self._violations(config).max())}

    def _violations(self, config: EnvConfig) -> np.ndarray:
        """Return the violation of every control step, (n,)."""
        poses = self.base.trace.commanded
        constraints, placed = config.constraints(), template_of(config)
        if constraints is not None:
            # Command n of the trace (from zero) has to satisfy the constraints of step n.
            G, c = constraints.window(np.arange(len(poses)))
            return (c - np.einsum("nfo,no->nf", G, poses)).max(axis=1, initial=-np.inf)
        if self._frames is None or placed is None:
            return np.full(len(poses), -np.inf)
        frames = {**placed.frames, **self._frames(self.base.sampled)}
        states = self.base.trace.signals["state"][:, 0].astype(int)
        return np.array(
            [
                placed.template.violation(state, pose_to_transform(pose), frames)
                for state, pose in zip(states, poses, strict=True)
            ]
        )


@dataclass(frozen=True)
class Case:
    """Environment that is fuzzed with every kind of action.

    Attributes:
        name: Name in the table.
        environment: Options of the environment.
        constrained: True if every command must satisfy the constraints.
        options: Options of every reset.
        may_wait: True if a fallback is allowed, because it is a wait or a stop before a wall.
        limits: Limits of columns; by default the limits of the campaign.
    """

    name: str
    environment: Mapping[str, Any]
    constrained: bool
    options: Mapping[str, Any] = field(default_factory=dict)
    may_wait: bool = False
    limits: Mapping[str, float] | None = None


@dataclass(frozen=True)
class Campaign:
    """Cases of a task and the limits on their outcome.

    In every case the simulation must not fail, all numbers must be finite, predictions must succeed, and constrained
    commands must satisfy their constraints.

    Attributes:
        task: Name of the task.
        cases: Environments.
        limits: Largest allowed values of columns, including those of the callback.
        make_callback: Constructor of a callback that adds numbers to an episode's row; a larger number is worse.
        actions: Kinds of actions, by name.
        frames: Function from the values sampled at a reset to the poses of a template's objects; None if unknown.
    """

    task: str
    cases: Sequence[Case]
    limits: Mapping[str, float]
    make_callback: Callable[[gymnasium.Env], Callback] | None = None
    actions: Mapping[str, BaselineFactory] = field(default_factory=lambda: ACTIONS)
    frames: Frames | None = nominal_frames


def run_campaign(
    campaign: Campaign,
    is_done: Callable[[list[dict[str, Any]]], bool],
    *,
    seed: int = 0,
    out: Path | None = None,
    step_log: Path | None = None,
    environment: Mapping[str, Any] | None = None,
    report: Callable[[str], None] | None = None,
) -> list[dict[str, Any]]:
    """Run episodes until `is_done`, cycling through every case with every kind of action.

    Args:
        campaign: Campaign to run.
        is_done: Called with the rows before each episode; True ends the campaign.
        seed: Seed of the first episode; episode i has seed + i.
        out: Table that is written after every round of the cases. Episodes in it are not run again.
        step_log: Folder of the step logs, a file per episode.
        environment: Options of every case, which override its own.
        report: Called with a line of text after every round.

    Returns:
        A row per episode: case, actions, seed, a digest of the environment, constrained, may_wait, `COLUMNS`,
        `not_finite`, `recomputed_violation`, and the numbers of the campaign's callback.

    Raises:
        InputError: If `out` holds another campaign.
    """
    rounds = [(case, name) for name in campaign.actions for case in campaign.cases]
    options = {case.name: {**case.environment, **(environment or {})} for case in campaign.cases}
    digests = {name: _digest(campaign.task, own) for name, own in options.items()}
    rows: list[dict[str, Any]] = read_table(out).to_dict("records") if out is not None and out.exists() else []
    for index, row in enumerate(rows):
        case, name = rounds[index % len(rounds)]
        expected = (case.name, name, seed + index, digests[case.name])
        if tuple(row.get(key) for key in ("case", "actions", "seed", "environment")) != expected or (
            "recomputed_violation" not in row
        ):
            raise InputError(f"{out} holds another campaign: name another file")
    environments: dict[str, tuple[gymnasium.Env, list[Callback]]] = {}
    reported, began = len(rows), time.process_time()
    with ExitStack() as stack:
        while not is_done(rows):
            case, name = rounds[len(rows) % len(rounds)]
            if case.name not in environments:
                env = stack.enter_context(closing(make_environment(campaign.task, options[case.name])))
                callbacks: list[Callback] = [NonFiniteCounter(env), RecomputedViolation(env, campaign.frames)]
                callbacks += [campaign.make_callback(env)] if campaign.make_callback else []
                callbacks += [StepLog(env, step_log)] if step_log is not None else []
                environments[case.name] = env, callbacks
            env, callbacks = environments[case.name]
            episode_seed = seed + len(rows)
            size = int(np.prod(env.action_space.shape or ()))
            act = campaign.actions[name](np.random.default_rng([episode_seed, 1]), size)
            episode = rollout(env, act, *callbacks, index=len(rows), seed=episode_seed, options=case.options)
            row = {"case": case.name, "actions": name, "seed": episode_seed, "environment": digests[case.name]}
            row |= {"constrained": int(case.constrained), "may_wait": int(case.may_wait)}
            columns = [*COLUMNS, *list(episode)[list(episode).index("not_finite") :]]
            rows.append(row | {column: episode[column] for column in columns})
            if len(rows) % len(campaign.cases) == 0 or is_done(rows):
                if out is not None:
                    write_atomically(out, table_text(rows).encode())
                if report is not None:
                    progress = f"{len(rows)} episodes, {time.process_time() - began:.0f} s of CPU"
                    report(f"{progress}: {json.dumps(outcome(rows[reported:]))}")
                reported = len(rows)
    return rows


def _digest(task: str, environment: Mapping[str, Any]) -> str:
    """Return a digest of the resolved environment; its prefix keeps CSV readers from parsing it as a number."""
    resolved = json.dumps(check_environment(task, environment), sort_keys=True, default=str)
    return f"env-{hashlib.blake2b(resolved.encode(), digest_size=6).hexdigest()}"


def outcome(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Aggregate episodes: counts, and the largest value of every number.

    `max_commanded_violation` is the larger of the reported and the recomputed violation in constrained cases.
    `disagreement` is the largest difference between the two.
    """
    table = pd.DataFrame(rows)
    own = [
        "case", "actions", "seed", "environment", "constrained", "may_wait", *COLUMNS, "not_finite",
        "recomputed_violation",
    ]  # fmt: skip
    added = table.columns.drop(own, errors="ignore")
    reported, recomputed = (table[name].to_numpy(float) for name in ("max_commanded_violation", "recomputed_violation"))
    constrained, bounded = table["constrained"].to_numpy() == 1, recomputed > -np.inf

    def largest(selected: np.ndarray) -> float | None:
        violations = np.maximum(reported, recomputed)[selected]
        return float(violations.max()) if len(violations) else None

    must_not_wait = table[table["may_wait"] == 0]
    return {
        "episodes": len(table),
        "control_steps": int(table["steps"].sum()),
        "endings": dict(Counter(table["termination"])),
        "not_finite": int(table["not_finite"].sum()),
        "fallback_steps": int(must_not_wait["fallback_steps"].sum()),
        "waiting_steps": int(table["fallback_steps"].sum() - must_not_wait["fallback_steps"].sum()),
        "max_commanded_violation": largest(constrained),
        "max_commanded_violation_unconstrained": largest(~constrained),
        "disagreement": float(np.abs(reported - recomputed)[constrained & bounded].max(initial=0.0)),
        "collisions": int(table["collisions"].sum()),
        "peak_force": float(table["peak_force"].max(skipna=False)),
        **{name: float(table[name].max(skipna=False)) for name in added},
    }


def find_failures(result: Mapping[str, Any], limits: Mapping[str, float]) -> list[str]:
    """Return a sentence for each check that an outcome fails.

    Args:
        result: From `outcome`.
        limits: Largest allowed values of columns.
    """
    failures = []
    if result["endings"].get("simulation_failure"):
        failures.append("the simulation failed")
    if result["not_finite"]:
        failures.append("a number was NaN or infinite")
    if result["fallback_steps"]:
        failures.append("a prediction failed")
    if result["max_commanded_violation"] is not None and not result["max_commanded_violation"] <= TOLERANCE:
        failures.append("a command violated the constraints")
    if not result["disagreement"] <= TOLERANCE:
        failures.append("reported and recomputed violations differ")
    return failures + [f"{name} beyond {limit:g}" for name, limit in limits.items() if not result[name] <= limit]
