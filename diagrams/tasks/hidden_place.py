"""Where the fixed part of an insertion may be, as options of the task."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator

from guiderail.diagrams.options import Numbers, Options
from guiderail.models.units import MM

LARGEST_OFFSET = 4.0 * MM  # farther away a plug no longer stands on the rim of what it belongs in


class HiddenPlace(Options):
    """Of a task whose fixed part is not where it should be."""

    uncertainty: Literal["calibration", "disc", "known"] = Field(
        "calibration", description="where the fixed part may be: one place for a run, one for each episode, or known"
    )
    offset_range: Numbers | None = Field(
        None,
        min_length=2,
        max_length=2,
        description="least and greatest distance of the fixed part from where it should be [m], the uncertainty's own",
    )

    @field_validator("offset_range")
    @classmethod
    def _is_a_range(cls, value: tuple[float, ...] | None) -> tuple[float, ...] | None:
        if value is not None and not 0.0 <= value[0] <= value[1] <= LARGEST_OFFSET:
            raise ValueError(f"give two distances from 0 to {LARGEST_OFFSET} m, the smaller one first")
        return value
