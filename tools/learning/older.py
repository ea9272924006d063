"""What run folders of earlier versions call things, and what it is called here."""

from collections.abc import Mapping
from typing import Any

# Settings of a learner in `config.yaml`.
SETTINGS = {
    "steady_episodes": "constant_episodes",
    "bursts": "ez_greedy",
    "longest_burst": "ez_greedy_longest",
    "bursts_until": "ez_greedy_until",
    "practise": "greedy_episode_fraction",
    "proven_by": "selection_window",
}
# Values of a learner in a checkpoint, and the beginnings of its arrays' names.
VALUES = {"proving": "selection", "row": "greedy_successes"}
ARRAYS = {"proving/proven/": "selection/selected/", "proving/": "selection/"}
# Options of an environment that results are older than, and what they are where nobody asks for them.
OPTIONS: Mapping[str, Any] = {"impedance_control": "joint", "balls": 2, "balls_in": None, "ball_diameter": 0.04}
# Tasks whose results don't say which task they are of.
TASKS = ("NarrowPassage", "BncConnector", "GridClamp", "Pouring")


def settings(stored: Mapping[str, Any]) -> dict[str, Any]:
    """A learner's settings by the names that they have here."""
    return {SETTINGS.get(name, name): value for name, value in stored.items()}


def options(environment: Mapping[str, Any]) -> dict[str, Any]:
    """An environment's options without those that would say nothing new of an earlier result."""
    return {name: value for name, value in environment.items() if name not in OPTIONS or OPTIONS[name] != value}


def task(name: str) -> str:
    """What a digest of results says of their task."""
    return "" if name in TASKS else name


def checkpoint(arrays: Mapping[str, Any], values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """A learner's arrays and values by the names that they have here."""
    renamed = {VALUES.get(name, name): value for name, value in values.items()}
    # The oldest count successes in a row inside what was proven, or not at all.
    renamed.setdefault("greedy_successes", renamed["selection"].get("row", 0))
    if "proven" in (rows := renamed["selection"].get("rows", {})):
        rows = {"selected": rows["proven"], **{name: row for name, row in rows.items() if name != "proven"}}
        renamed["selection"] = {**renamed["selection"], "rows": rows}
    of_arrays = {}
    for name, value in arrays.items():
        old = next((old for old in ARRAYS if name.startswith(old)), "")
        of_arrays[ARRAYS.get(old, "") + name.removeprefix(old)] = value
    return of_arrays, renamed
