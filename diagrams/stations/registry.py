"""Registry of stations; the names are the values of the option `station`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from guiderail.models.common.registry import Registry, check_kind

if TYPE_CHECKING:
    from guiderail.diagrams.envs.options import Options
    from guiderail.diagrams.stations.station import Station


@dataclass(frozen=True)
class StationKind:
    """Entry of the registry: builder and requirements of a station."""

    name: str  # name for `station=`
    build: Callable[..., Station]  # builder; its arguments are a workcell, and the options by name
    workcell_kind: str  # kind of workcell that the station needs, such as "insertion" for a workpiece and a fixture
    description: str  # summary in one line
    options: type[Options] | None = None  # class of the station's environment options; None if it has none
    is_simulated: bool = True  # True for a simulation: a reset can set its state
    time_unit: float | None = None  # control periods are whole multiples of it [s]; None: `station.TIME_UNIT`
    control_period: float | None = None  # default control period [s]; None: `station.CONTROL_PERIOD`


STATIONS: Registry[StationKind] = Registry("station", plugin="station", check=check_kind(StationKind))


def register_station(
    name: str, *, workcell_kind: str, **declared: Any
) -> Callable[[Callable[..., Station]], Callable[..., Station]]:
    """Return a decorator that registers a class or function that builds a station from a workcell and options.

    Args:
        name: Name for `station=`.
        workcell_kind: Kind of workcell that the station needs.
        **declared: Further attributes of the `StationKind`, such as `options`, `is_simulated` and `time_unit`.

    Raises:
        InputError: When the decorator is applied, if another station has that name.
    """

    def add(build: Any) -> Any:
        description = str(build.__doc__ or "").strip().partition("\n")[0]
        build.kind = StationKind(name, build, workcell_kind, description, **declared)
        STATIONS.register(name, build.kind)
        return build

    return add


def stations_for(workcell_kind: str) -> list[str]:
    """Return the names of the stations for a kind of workcell."""
    return [name for name, kind in STATIONS.entries().items() if kind.workcell_kind == workcell_kind]
