"""Whether a task's primitive follows what was demonstrated, said before anything is learned from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from guiderail.models.primitives.selection import ENOUGH, estimated_share


def leaves_demonstrations(task: str, environment: Mapping[str, Any]) -> str | None:
    """A sentence if the zero action leaves the demonstrations' spread; None if it doesn't, or there are none.

    Args:
        task: its name.
        environment: its options.

    Raises:
        InputError: for an unknown task or option.
    """
    from guiderail.diagrams.make import resolve  # Drake takes a second

    resolved = resolve(task, environment)
    if "demonstrations" not in resolved.task.knows():
        return None
    values = resolved.values
    chosen = {name: values[name] for name in ("inverse_length", "lambda_", "beta", "horizon")}
    share = estimated_share(resolved.task.reference(), **chosen)
    if share >= ENOUGH:
        return None
    return (
        f"without actions, {share:.0%} of the steps stay within a standard deviation of the demonstrations: let "
        "guiderail check FILE --fit choose inverse_length, lambda_ and beta, and give them by --env"
    )
