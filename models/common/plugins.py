"""Plug-ins: entries of installed packages, all in one group of entry points, and the sibling distributions.

A package declares a plug-in in the group "guiderail" of its entry points, as "KIND:NAME" = "module:attribute":

    [project.entry-points.guiderail]
    "station:mujoco" = "guiderail_mujoco.station:MujocoStation"
"""

from collections.abc import Iterator
from importlib import metadata
from importlib.util import find_spec
from typing import Any

from guiderail.models.common.errors import InputError

GROUP = "guiderail"  # group of the entry points of all plug-ins
SIBLINGS = {
    "hardware": ("deploy", "train-on-robot", "teleoperate", "sim-driver", "safety-monitor"),
    "parts": ("create-task",),
    "studies": ("study", "robustness", "certify", "report"),
    "data": ("dataset",),
    "lerobot": (),
    "mujoco": (),
    "cpp": (),
}
"""Commands of each sibling distribution guiderail-NAME, by NAME, to name the distribution if it is not installed."""


def find_plugins(kind: str) -> Iterator[tuple[str, metadata.EntryPoint]]:
    """Yield the name and the entry point of each plug-in of a kind, without importing it."""
    for point in metadata.entry_points(group=GROUP):
        prefix, _, name = point.name.partition(":")
        if prefix == kind and name:
            yield name, point


def load_plugin(kind: str, name: str, sibling: str) -> Any:
    """Import a plug-in and return its object; `sibling` is the distribution that has it.

    Raises:
        MissingSiblingError: If there is no such plug-in.
    """
    for found, point in find_plugins(kind):
        if found == name:
            return point.load()
    raise MissingSiblingError(f"this {kind}", sibling)


def is_from_sibling(point: metadata.EntryPoint) -> bool:
    """Return True if an entry point belongs to a sibling distribution of guiderail."""
    return point.dist is not None and point.dist.name in {f"guiderail-{name}" for name in SIBLINGS}


def is_sibling_module(module: str) -> bool:
    """Return True if a module, given by its dotted name, belongs to guiderail or to one of its siblings."""
    top = module.partition(".")[0]
    return top == "guiderail" or top in {f"guiderail_{name}" for name in SIBLINGS}


def require_sibling(name: str, what: str) -> None:
    """Raise a MissingSiblingError unless the sibling distribution guiderail-NAME is installed; `what` needs it."""
    if find_spec(f"guiderail_{name}") is None:
        raise MissingSiblingError(what, name)


class MissingSiblingError(InputError):
    """Error for a feature of a sibling distribution that is not installed; the message has the line that installs it.

    Args:
        what: Feature that needs the distribution, such as "guiderail deploy".
        name: Name of the distribution, without "guiderail-".
    """

    def __init__(self, what: str, name: str):
        super().__init__(f'{what} needs guiderail-{name}, which is not installed: pip install "guiderail[{name}]"')
