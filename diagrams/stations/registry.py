"""Registry of stations; the names are the values of the option `station`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from guiderail.models.common.errors import InputError, brief
from guiderail.models.common.registry import Registry, check_callable

if TYPE_CHECKING:
    from guiderail.diagrams.envs.options import Options
    from guiderail.diagrams.stations.station import Station


@dataclass(frozen=True)
class StationKind:
    """Entry of the registry: builder and requirements of a station."""

    name: str  # name for `station=`
    build: Callable[..., Station]  # builder; its arguments are a workcell, and the options by name
    workcell_kind: str  # kind of workcell that the station needs, such as "insertion" for a workpiece and a fixture
    options: type[Options] | None  # class of the station's environment options; None if it has none
    description: str  # summary in one line
    is_simulated: bool = True  # True for a simulation: a reset can set its state
    time_unit: float | None = None  # default of `Task.time_unit` [s]; None: `station.TIME_UNIT`
    control_period: float | None = None  # default of `Task.default_control_period` [s]; None: `station.CONTROL_PERIOD`


def _check(name: str, kind: object) -> None:
    """Raise an InputError unless an entry is a `StationKind` with a builder, a workcell and an options class."""
    if not isinstance(kind, StationKind):
        raise InputError(f"the station {name!r} is registered by @register_station, not as {brief(kind)}")
    check_callable(name, kind.build)
    if not (isinstance(kind.workcell_kind, str) and kind.workcell_kind):
        raise InputError(f"workcell_kind of {name} must be a word, such as 'plane', not {brief(kind.workcell_kind)}")
    if kind.options is not None:
        from guiderail.diagrams.envs.options import Options, check_options_class

        check_options_class(name, "options", kind.options, Options)


STATIONS: Registry[StationKind] = Registry(
    "station",
    plugin="station",
    check=_check,
)


def register_station(
    name: str,
    *,
    workcell_kind: str,
    options: type[Options] | None = None,
    is_simulated: bool = True,
    time_unit: float | None = None,
    control_period: float | None = None,
) -> Callable[[Callable[..., Station]], Callable[..., Station]]:
    """Return a decorator that registers a class or function that builds a station from a workcell and options.

    Args:
        name: Name for `station=`.
        workcell_kind: Kind of workcell that the station needs.
        options: Class of the station's environment options; None if it has none.
        is_simulated: True for a simulation: a reset can set its state.
        time_unit: Control periods are whole multiples of this time [s]; default: 5 ms.
        control_period: Control period without the option `control_period` [s]; default: 20 ms.

    Raises:
        InputError: When the decorator is applied, if another station has that name, or an argument or the decorated
            object has the wrong type.
    """

    def add(build: Any) -> Any:
        lines = str(build.__doc__ or "").strip().splitlines()
        description = lines[0] if lines else ""
        periods = time_unit, control_period
        kind = StationKind(name, build, workcell_kind, options, description, is_simulated, *periods)
        STATIONS.register(name, kind)
        build.kind = kind
        return build

    return add


def kind_of(station: Any, task: str) -> StationKind:
    """Return the registered kind of a class or function; error messages name the `task` whose station it is.

    Raises:
        InputError: If it is not registered.
    """
    kind = getattr(station, "kind", None)
    if not isinstance(kind, StationKind):
        raise InputError(f"station of {task} is a class that register_station registers, not {brief(station)}")
    return kind


def stations_for(workcell_kind: str) -> list[str]:
    """Return the names of the stations for a kind of workcell."""
    return [name for name, kind in STATIONS.entries().items() if kind.workcell_kind == workcell_kind]
