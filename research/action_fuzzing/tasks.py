"""Campaigns of all tasks, and `fuzz`, which runs them."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from guiderail.diagrams.envs.config import prior_of
from guiderail.diagrams.guidance.registry import possible_guidance
from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import did_you_mean
from research.action_fuzzing import bnc_connector, pouring
from research.action_fuzzing.campaign import Campaign, Case, find_failures, outcome, run_campaign

# Guidance that satisfies the task's constraints, or the template's active ones.
CONSTRAINED = ("kgrl", "skgrl", "sct")


def grid_clamp() -> Campaign:
    """Return the campaign: with every guidance, commands stay in the template's cuboid and forces below the limit.

    While the clamp is blocked, the last command is repeated. This is an allowed fallback.
    """
    cases = [
        Case(
            f"{guidance}, {fixture_offset}",
            {"guidance": guidance, "fixture_offset": fixture_offset, "action_repeat": 1},
            constrained=True,
            options={"new_run": True},
            may_wait=True,
        )
        for guidance in ("sct", "none", "residual")
        for fixture_offset in ("per_run", "per_episode")
    ]
    return Campaign("GridClamp", cases, {"collisions": 0})


def narrow_passage() -> Campaign:
    """Return the campaign: KGRL and sKGRL, at two action repeats, must satisfy the constraint and touch no wall.

    Safe residual RL may stop before walls. Residual RL and the demonstrations alone are not constrained: their episodes
    test only the simulation.
    """
    cases = [
        Case(
            f"{guidance}, action repeat {action_repeat}",
            {"guidance": guidance, "action_repeat": action_repeat},
            constrained=True,
        )
        for guidance, action_repeat in itertools.product(("kgrl", "skgrl"), (1, 5))
    ]
    cases += [
        Case("safe_residual", {"guidance": "safe_residual", "action_repeat": 5}, constrained=True, may_wait=True),
        Case("residual", {"guidance": "residual", "action_repeat": 5}, constrained=False, limits={}),
        Case("kmp", {"guidance": "kmp", "action_repeat": 5}, constrained=False, limits={}),
    ]
    return Campaign("NarrowPassage", cases, {"collisions": 0})


def campaign_of(task: str) -> Campaign:
    """Return a campaign of every guidance of a task, with the default options.

    Violations of the task's constraints are recomputed. Violations of a template's constraints are only reported by the
    guidance, because the poses of the template's objects are unknown. A fallback (a wait, or a stop before a wall) is a
    failure with KGRL and sKGRL only.

    Args:
        task: Name of the task.
    """
    cases = [
        Case(name, {"guidance": name}, constrained=name in CONSTRAINED, may_wait=name not in ("kgrl", "skgrl"))
        for name in possible_guidance(prior_of(TASKS.get(task)).provides)
    ]
    return Campaign(task, cases, {}, frames=None)


CAMPAIGNS: dict[str, Callable[[], Campaign]] = {
    "BncConnector": bnc_connector.campaign,
    "GridClamp": grid_clamp,
    "NarrowPassage": narrow_passage,
    "Pouring": pouring.campaign,
}
ALL = "all"


def fuzz(
    task: str,
    *,
    episodes: int | None = None,
    steps: int | None = None,
    seed: int = 0,
    out: Path | None = None,
    environment: Mapping[str, Any] | None = None,
    report: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Fuzz a task, or all tasks, for a number of episodes or control steps.

    Args:
        task: Name of a task, or "all". A task that is not in `CAMPAIGNS` gets the campaign of `campaign_of`. With
            "all", every task of `CAMPAIGNS` gets the same number of control steps.
        episodes: Number of episodes of one task, 1000 by default.
        steps: Number of control steps, instead of `episodes`; with "all", of all tasks together.
        seed: Seed of the first episode of each task.
        out: Table of one task; with "all", a folder with a table of each task and a folder with every control step.
            Episodes in a table are not run again.
        environment: Options of every case, which override its own.
        report: Called with a line of text after every round.

    Returns:
        The entries `cases`, `all` and `failures`; with "all", the entries `tasks`, `control_steps`,
        `max_commanded_violation`, `disagreement` and `failures`.

    Raises:
        InputError: For an unknown task, a number out of range, both `episodes` and `steps`, or an argument that "all"
            does not support.
    """
    if (episodes is not None and episodes < 1) or (steps is not None and steps < 1) or seed < 0:
        raise InputError("a campaign has at least one episode or control step, and a seed from 0")
    if task == ALL:
        if steps is None or episodes is not None or environment:
            raise InputError("all tasks are fuzzed for a number of control steps, without --env: give --steps")
        if out is not None and out.suffix == ".csv":
            raise InputError(f"all tasks need a folder, not the table {out}: name a folder with --out")
        return _fuzz_all(-(-steps // len(CAMPAIGNS)), seed=seed, out=out, report=report)
    if episodes is not None and steps is not None:
        raise InputError("a campaign ends after a number of episodes or of control steps: give one of the two")
    if task not in CAMPAIGNS and task not in TASKS.names():
        remedy = did_you_mean(task, {*CAMPAIGNS, *TASKS.names(), ALL})
        raise InputError(
            f"there is no task {brief(task)} to fuzz: {remedy}"
            + ("" if remedy.endswith("?") else ", or --import the file that registers it")
        )
    return _fuzz(task, 1000 if episodes is None else episodes, steps, seed, out, None, environment, report)


def _fuzz_all(steps: int, *, seed: int, out: Path | None, report: Callable[[str], None] | None) -> dict[str, Any]:
    results = {}
    for task in CAMPAIGNS:
        table, step_log = (None, None) if out is None else (out / f"{task}.csv", out / "steps" / task)
        report_task = None if report is None else _with_prefix(report, task)
        results[task] = _fuzz(task, 0, steps, seed, table, step_log, None, report_task)
    return {
        "tasks": results,
        "control_steps": sum(result["all"]["control_steps"] for result in results.values()),
        "max_commanded_violation": max(result["all"]["max_commanded_violation"] for result in results.values()),
        "disagreement": max(result["all"]["disagreement"] for result in results.values()),
        "failures": [f"{task}: {failure}" for task, result in results.items() for failure in result["failures"]],
    }


def _with_prefix(report: Callable[[str], None], task: str) -> Callable[[str], None]:
    return lambda line: report(f"{task}: {line}")


def _fuzz(
    task: str,
    episodes: int,
    steps: int | None,
    seed: int,
    out: Path | None,
    step_log: Path | None,
    environment: Mapping[str, Any] | None,
    report: Callable[[str], None] | None,
) -> dict[str, Any]:
    campaign = CAMPAIGNS[task]() if task in CAMPAIGNS else campaign_of(task)

    def is_done(rows: list[dict[str, Any]]) -> bool:
        if steps is not None:
            return sum(row["steps"] for row in rows) >= steps
        return len(rows) >= episodes

    rows = run_campaign(
        campaign, is_done, seed=seed, out=out, step_log=step_log, environment=environment, report=report
    )
    cases, failures = {}, []
    for case in campaign.cases:
        if of_case := [row for row in rows if row["case"] == case.name]:
            cases[case.name] = outcome(of_case)
            limits = campaign.limits if case.limits is None else case.limits
            failures += [f"{case.name}: {failure}" for failure in find_failures(cases[case.name], limits)]
    return {"cases": cases, "all": outcome(rows), "failures": failures}
