"""Options of BncConnector, the overrides of difficulty="hard", and the sampler of its offsets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from guiderail.diagrams.envs.options import Integer, Number
from guiderail.diagrams.tasks.options import (
    COLLISION_FORCE,
    FORCE_LIMITS,
    NEGLIGIBLE_OFFSET,
    FixtureOffsetOptions,
    ForceOptions,
    HiddenOffsets,
    PriorOptions,
    in_ring,
)
from guiderail.models.common.transforms import DEGREE, MM
from guiderail.models.objects.bnc_connector.geometry import BncDimensions
from guiderail.models.objects.bnc_connector.sdf import FRICTION

# Smallest and largest offset of the jack [m].
OFFSET_RANGES = {
    "per_run": (1.0 * MM, 1.5 * MM),
    "per_episode": (0.0, 1.5 * MM),
    "none": (0.0, NEGLIGIBLE_OFFSET),
}
GRASP_RADIUS = 0.3 * MM  # largest offset of the plug in the tool [m]


class BncUncertainty(HiddenOffsets):
    """Sampler of the offsets of jack and plug; see `HiddenOffsets` for the options of a reset.

    - "per_run": the jack is offset by 1.0 to 1.5 mm in a random direction, sampled once per run; the plug is within
      0.3 mm of its nominal position in the tool, sampled each episode. The thesis uses this setting.
    - "per_episode": the jack is within 1.5 mm of its nominal position, sampled each episode.
    - "none": the jack is within 0.3 mm of its nominal position, sampled each episode.

    With `jack_turn`, the jack is also rotated about its axis; the jack's offset is then [x, y, angle]. The reset option
    `offset` sets the jack's position; the jack is then not rotated, and the plug not offset.
    """

    def __init__(
        self,
        kind: str,
        *,
        offset_range: Sequence[float] | None = None,
        jack_turn: float = 0.0,
    ):
        """Construct the sampler.

        `jack_turn` is the largest turn of the jack [degrees]. `offset_range` is the smallest and largest offset of the
        jack [m]; default: that of the kind.
        """
        super().__init__(kind)
        self.jack_turn = jack_turn * DEGREE
        self.offset_range = OFFSET_RANGES[kind] if offset_range is None else tuple(offset_range)

    def _draw_run(self, rng: np.random.Generator) -> np.ndarray:
        # Every kind samples this offset, so that all kinds take the same random numbers.
        return self._append_turn(in_ring(rng, *self.offset_range), rng)

    def _draw_episode(self, rng: np.random.Generator, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "per_run":
            jack, plug = run, in_ring(rng, 0.0, GRASP_RADIUS)
        else:
            jack, plug = in_ring(rng, *self.offset_range), np.zeros(2)
        rng.uniform(size=2)  # stored results of a seed depend on the number of samples
        return (jack if self.kind == "per_run" else self._append_turn(jack, rng)), plug

    def _offsets_of(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        jack = np.append(offset, 0.0) if self.jack_turn > 0.0 else offset
        return jack, np.zeros(2)

    def _append_turn(self, jack: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.append(jack, rng.uniform(-self.jack_turn, self.jack_turn)) if self.jack_turn > 0.0 else jack


ALIGNMENT = 2.0 * MM  # largest |x| and |y| of every command: equation 4.26
NOMINAL = BncDimensions()
SHIPPED = ("insert", "search", "firm_search")  # names of the demonstrations in this package


class BncOptions(FixtureOffsetOptions, PriorOptions, ForceOptions):
    """Options of BncConnector."""

    reward: Literal["sparse", "shaped", "aligned"] = Field("sparse", description="name of the reward")
    observation: Literal["state", "center_of_pressure", "mean_contact_point", "image", "image_and_state"] = Field(
        "state", description="name of the observation"
    )

    start_offset_max: Number = Field(
        0.0, ge=0, le=ALIGNMENT, description="largest sampled offset of the start along x and y [m]"
    )
    bound: Number = Field(ALIGNMENT, ge=0.5 * MM, le=6.0 * MM, description="bound of a command's |x| and |y| [m]")
    force_limit: Number = Field(
        COLLISION_FORCE, ge=5, le=FORCE_LIMITS[1], description="force that ends an episode as a collision [N]"
    )
    mouth_chamfer: Number = Field(
        NOMINAL.mouth_chamfer, ge=0.05 * MM, le=0.6 * MM, description="chamfer of the plug's mouth and slots [m]"
    )
    bore_clearance: Number = Field(
        NOMINAL.bore_clearance,
        ge=0.05 * MM,
        le=0.2 * MM,
        description="clearance between barrel and bore on each side [m]",
    )
    friction: Number = Field(FRICTION, ge=0.05, le=0.4, description="friction coefficient of the connector's metal")
    demonstrations: str = Field(
        "insert", description="demonstrations: insert, search, firm_search, or the path of a file"
    )
    num_demonstrations: Integer | None = Field(
        None, ge=1, description="number of demonstrations to use, from the first on; a single one needs prior_std"
    )

    @field_validator("demonstrations")
    @classmethod
    def _check_file(cls, value: str) -> str:
        if value in SHIPPED:
            return value
        path = Path(value)
        if not path.is_file():
            raise ValueError(f"must be {', '.join(SHIPPED)}, or the path of an existing file, .npz or .csv")
        return str(path.resolve())  # so that a run can be resumed from another folder


HARD: dict[str, Any] = {
    "observation": "mean_contact_point",
    "demonstrations": "search",
    "action_repeat": 5,
    "fixture_offset": "per_episode",
    "offset_range": (2.6 * MM, 3.0 * MM),
    "bound": 3.5 * MM,
    "force_limit": 20.0,
    "mouth_chamfer": 0.1 * MM,
}
"""Options of difficulty="hard": the jack's offset is sampled in every episode and is larger than the chamfer can
correct. Without `bounded_force`, pressing on the rim exceeds the force limit.

The search is short, and the jack's offset is close to the largest displacement by an action. Most random actions
displace the plug less and miss the jack. A policy can reach the jack if it observes the side of the rim on which the
contact is. The demonstrations' covariance in x and y, and so the displacement per action, is constant during the
search; otherwise a constant action would sweep the plug across the rim.
"""
