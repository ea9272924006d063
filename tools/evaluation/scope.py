"""Validity of an evaluation: its conditions, the guidance of the policy, and the baseline policies of the task."""

from collections.abc import Mapping
from typing import Any

from guiderail.diagrams.tasks.registry import TASKS
from guiderail.models.common.errors import InputError
from guiderail.tools.evaluation.baselines import scripted_policies
from guiderail.tools.visualization.style import is_demonstrated


def default_baselines(task: str, environment: Mapping[str, Any]) -> list[str]:
    """Return the names of the baseline policies that a task's evaluation includes by default.

    Args:
        task: Name of the task.
        environment: Options of its environment.
    """
    zero = [] if is_demonstrated(environment.get("guidance")) else ["zero"]
    has_scripted = bool(scripted_policies(task)) and environment.get("observation") != "image"
    return [*zero, "uniform_random", "constant", *(["scripted"] if has_scripted else [])]


def refuse_guidance_change(own: Mapping[str, Any], other: Mapping[str, Any]) -> None:
    """Refuse an environment with another guidance than a policy was trained with: actions mean something else there.

    Args:
        own: Options of the environment that the policy was trained in.
        other: Options of the environment that it acts in.

    Raises:
        InputError: If the guidance differs.
    """
    trained, used = own.get("guidance"), other.get("guidance")
    if trained != used:
        raise InputError(
            f"the policy was trained with guidance {trained}, and its actions mean something else with {used}: leave "
            "guidance out of --env, or train a policy with that guidance"
        )


def evaluation_scope(task: str, environment: Mapping[str, Any], resample_offsets: bool) -> str:
    """Return what an evaluation is valid for: the hidden offset of one run, or offsets sampled in every episode.

    Args:
        task: Name of the task.
        environment: Options of its environment.
        resample_offsets: Whether the hidden offset of the run is sampled again in every episode.

    Raises:
        InputError: If `resample_offsets` is True and a run of the task hides nothing.
    """
    if resample_offsets and not _can_hide(task):
        raise InputError(f"a run of {task} has no hidden offset to resample: leave --resample-offsets out")
    if not has_held_out_distribution(task):
        return f"conditions as in training: {task} declares no held-out conditions"
    if not _can_hide(task):
        return "held-out starts"
    if resample_offsets or not hides(task, environment):
        return "any offset: sampled again in every episode"
    return "the one offset that is hidden in this run (--resample-offsets: any offset)"


def hides(task: str, environment: Mapping[str, Any]) -> bool:
    """Return True if all episodes of a run have the same hidden offset, which only a reset with `new_run` changes."""
    return _can_hide(task) and environment.get("fixture_offset", "per_run") == "per_run"


def _can_hide(task: str) -> bool:
    return task in TASKS.names() and "new_run" in TASKS.get(task).Reset.model_fields


def counts_collisions(task: str) -> bool:
    """Return True if a task declares a collision signal; a `TerminationTerm` named collision is not one."""
    return task not in TASKS.names() or TASKS.get(task).declares_collision()


def has_held_out_distribution(task: str) -> bool:
    """Return True if a task declares held-out conditions, or is registered with Gymnasium only."""
    return task not in TASKS.names() or TASKS.get(task).has_held_out_distribution
