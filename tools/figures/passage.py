"""What the figures on the narrow passage share: its runs, its drawing, and the words for what was found."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from guiderail.tools.figures import runs
from guiderail.tools.viewing.passage import avoided_from

TASK = "NarrowPassage"
HOLD = 5  # control steps of an action, unless a figure says otherwise
PRESET = "quick"


def train_all(
    out: Path,
    guidance: Sequence[str],
    *,
    seeds: int,
    episodes: int,
    observation: str = "state",
    preset: str = PRESET,
) -> list[dict[str, Any]]:
    """Runs in the narrow passage (see `runs.train_all`)."""
    environment = {"hold": HOLD, "observation": observation}
    return runs.train_all(out, TASK, guidance, seeds=seeds, episodes=episodes, preset=preset, environment=environment)


def learned(result: dict[str, Any]) -> dict[str, Any]:
    """A run's row in a table, with the episode from which it avoided the obstacle."""
    return runs.table_row(result, avoids_obstacle_from=avoided_from(result["rows"]))
