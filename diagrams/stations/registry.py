"""Stations by name: what each works on, and how it is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from guiderail.models.common.registry import Registry

if TYPE_CHECKING:
    from guiderail.diagrams.envs.options import Options
    from guiderail.diagrams.stations.station import Station


@dataclass(frozen=True)
class StationKind:
    """A kind of station.

    Attributes:
        name: what `station=` calls it.
        build: from a world, and its options by name, to a station.
        world: the kind of world that it works on: "workcell" for whoever puts a workpiece into a fixture.
        options: a model of further options of the environment; none unless given.
        words: what it is, in a line.
        simulated: whether it is a simulation, which a reset can put to any state.
    """

    name: str
    build: Callable[..., Station]
    world: str
    options: type[Options] | None
    words: str
    is_simulated: bool = True


STATIONS: Registry[StationKind] = Registry(
    "station",
    package=("guiderail.diagrams.stations", "guiderail.diagrams.hardware"),
    decorator="register_station",
    entry_points="guiderail.stations",
)


def register_station(
    name: str, *, world: str, options: type[Options] | None = None, is_simulated: bool = True
) -> Callable[[Callable[..., Station]], Callable[..., Station]]:
    """A decorator that adds a station; it decorates a class or a function that takes a world and its options.

    Args:
        name: what `station=` calls it.
        world, options, simulated: see `StationKind`.
    """

    def add(build: Any) -> Any:
        words = str(build.__doc__ or "").strip().splitlines()
        STATIONS.register(name, StationKind(name, build, world, options, words[0] if words else "", is_simulated))
        return build

    return add


def stations_for(world: str) -> list[str]:
    """The names of the stations that work on such a world."""
    return [name for name in STATIONS.names() if STATIONS.get(name).world == world]
