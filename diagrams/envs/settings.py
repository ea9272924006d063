"""Settings of an environment as its task reads them.

Base of `EnvConfig`, in a file of its own because tasks need it and `config.py` imports tasks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from guiderail.diagrams.envs.options import CommonOptions, Options, option_fields
from guiderail.diagrams.guidance.registry import GUIDANCE, GuidanceKind
from guiderail.diagrams.stations.registry import STATIONS, StationKind


@dataclass(frozen=True)
class EnvSettings:
    """Settings of an environment; `EnvConfig.resolve` validates them."""

    task: str  # name of the task
    guidance: str  # name of the guidance
    station: str  # name of the station
    reward: str  # name of the reward
    observation: str  # name of the observation
    difficulty: str  # name of the difficulty
    action_repeat: int  # control steps per action
    control_period: float | None  # time between commands [s]; None: that of the task's station
    # All other options by the part that they configure: "task", "station", "primitive", "template", "guidance" and
    # "disturbances".
    parts: Mapping[str, Options] = field(hash=False)

    @property
    def options(self) -> dict[str, Any]:
        """All options by name, as `gymnasium.make` takes them."""
        common = {name: getattr(self, name) for name in CommonOptions.model_fields}
        parts = (
            (part, name, field) for part in self.parts.values() for name, field in option_fields(type(part)).items()
        )
        return common | {name: getattr(part, field) for part, name, field in parts}

    def part(self, name: str) -> dict[str, Any]:
        """Return the options of a part, a key of `parts`, as a dictionary from field to value."""
        model = self.parts[name]
        return {option: getattr(model, option) for option in type(model).model_fields}

    @property
    def guidance_kind(self) -> GuidanceKind:
        """Registered kind of the guidance."""
        return GUIDANCE.get(self.guidance)

    @property
    def station_kind(self) -> StationKind:
        """Registered kind of the station."""
        return STATIONS.get(self.station)
