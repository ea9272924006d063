"""Where the jack and the plug really are: what a reset of the BNC task draws."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field, field_validator

from guiderail.diagrams.envs.options import Number
from guiderail.diagrams.tasks.bnc_connector.workcell import BncWorkcell
from guiderail.diagrams.tasks.offsets import FixtureOffsetOptions, HiddenOffsets, in_ring
from guiderail.models.common.units import DEGREE, MM
from guiderail.models.objects.bnc_connector.geometry import BncDimensions
from guiderail.models.objects.bnc_connector.sdf import FRICTION, MARGIN
from guiderail.models.objects.insertion import COLLISION_FORCE

# Least and largest distance of the jack from where it is thought to be.
OFFSET_RANGES = {
    "per_run": (1.0 * MM, 1.5 * MM),
    "per_episode": (0.0, 1.5 * MM),
    "none": (0.0, 0.3 * MM),
}
GRASP_RADIUS = 0.3 * MM  # how exactly a plug is picked up again
LARGEST_GRASP_ANGLE = 2.0  # degrees; beyond it the plug would hang askew enough to be a fault and no uncertainty


class BncUncertainty(HiddenOffsets):
    """Draws the offsets of jack and plug; `HiddenOffsets` has the options of a reset.

    - "per_run": the jack is off by 1.0 to 1.5 mm in one direction, hidden and the same for a whole run; the plug
      sits in the tool within 0.3 mm of its place, anew every episode. The thesis's case.
    - "per_episode": the jack is anywhere within 1.5 mm, anew every episode.
    - "none": the jack is within 0.3 mm, anew every episode.

    The plug may also sit tilted in the tool, anew every episode: its offset then has two angles [rad] about x and y
    after x and y. The jack may be turned about its axis, as often as its place is drawn: its offset then has an angle
    [rad] after x and y. The option `offset` puts the jack there and the plug straight in its place.
    """

    def __init__(
        self,
        kind: str,
        grasp_angle: float = 0.0,
        *,
        offset_range: Sequence[float] | None = None,
        jack_turn: float = 0.0,
    ):
        """
        Args:
            kind: "per_run", "per_episode" or "none".
            grasp_angle: the largest tilt of the plug in the tool [degrees].
            offset_range: least and greatest distance of the jack from where it should be [m], instead of the kind's.
            jack_turn: the largest turn of the jack about its axis [degrees].
        """
        super().__init__()
        self.kind = kind
        self.grasp_angle = grasp_angle * DEGREE
        self.jack_turn = jack_turn * DEGREE
        self.offset_range = OFFSET_RANGES[kind] if offset_range is None else tuple(offset_range)

    def _draw_run(self, rng: np.random.Generator) -> np.ndarray:
        # Drawn of every kind, used or not; what "none" and "per_episode" draw of an episode came after it from the beginning.
        return self._turned(in_ring(rng, *self.offset_range), rng)

    def _draw_episode(self, rng: np.random.Generator, run: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if self.kind == "per_run":
            jack, plug = run, in_ring(rng, 0.0, GRASP_RADIUS)
        else:
            jack, plug = in_ring(rng, *self.offset_range), np.zeros(2)
        plug = self._tilted(plug, in_ring(rng, 0.0, self.grasp_angle))
        return (jack if self.kind == "per_run" else self._turned(jack, rng)), plug

    def _given(self, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        jack = np.append(offset, 0.0) if self.jack_turn > 0.0 else offset
        return jack, self._tilted(np.zeros(2), np.zeros(2))

    def _turned(self, jack: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        return np.append(jack, rng.uniform(-self.jack_turn, self.jack_turn)) if self.jack_turn > 0.0 else jack

    def _tilted(self, plug: np.ndarray, angles: np.ndarray) -> np.ndarray:
        return np.concatenate([plug, angles]) if self.grasp_angle > 0.0 else plug


ALIGNMENT = 2.0 * MM  # |x|, |y| of every command: equation 4.26
DRAWN = BncDimensions()
SHIPPED = ("insert", "search")  # demonstrations


class BncOptions(FixtureOffsetOptions):
    """Of the connector."""

    jack_turn: Number = Field(0.0, ge=0, le=10, description="largest turn of the jack about its axis [degrees]")
    grasp_angle: Number = Field(0.0, ge=0, le=LARGEST_GRASP_ANGLE, description="largest tilt of the plug [degrees]")
    start_offset_max: Number = Field(
        0.0, ge=0, le=ALIGNMENT, description="how far beside its start the tool may begin [m]"
    )
    bound: Number = Field(ALIGNMENT, ge=0.5 * MM, le=6.0 * MM, description="of a command's |x| and |y| [m]")
    force_limit: Number = Field(COLLISION_FORCE, ge=5, le=60, description="more than that ends an episode [N]")
    mouth_chamfer: Number = Field(
        DRAWN.mouth_chamfer, ge=0.05 * MM, le=0.6 * MM, description="of the plug's mouth and its slots' [m]"
    )
    bore_clearance: Number = Field(
        DRAWN.bore_clearance, ge=0.05 * MM, le=0.2 * MM, description="between barrel and bore, a side [m]"
    )
    slot_clearance: Number = Field(
        DRAWN.slot_clearance, ge=0.05 * MM, le=0.2 * MM, description="between lug and slot, a side [m]"
    )
    friction: Number = Field(FRICTION, ge=0.05, le=0.4, description="of the connector's metal")
    contact_margin: Number = Field(
        MARGIN, ge=0, le=0.5 * MM, description="from which on Drake feels the jack's metal before it is touched [m]"
    )
    equal_area: bool = Field(
        False, description="whether the polygons of barrel and bore in Drake have their circles' areas"
    )
    demonstrations: str = Field("insert", description="what was demonstrated: insert, search, or a file of one's own")

    @field_validator("demonstrations")
    @classmethod
    def _is_shipped_or_a_file(cls, value: str) -> str:
        if value in SHIPPED:
            return value
        path = Path(value)
        if not path.is_file():
            raise ValueError(f"it is {' or '.join(SHIPPED)}, or a file that there is, .npz or .csv")
        return str(path.resolve())  # whoever goes on with a run elsewhere finds it

    def workcell(self) -> BncWorkcell:
        """The connector that is meant."""
        dimensions = replace(
            DRAWN.with_bore_clearance(self.bore_clearance),
            mouth_chamfer=self.mouth_chamfer,
            slot_clearance=self.slot_clearance,
        )
        return BncWorkcell(dimensions, friction=self.friction, margin=self.contact_margin, equal_area=self.equal_area)


HARD: dict[str, Any] = {
    "observation": "center_of_pressure",
    "demonstrations": "search",
    "action_repeat": 5,
    "fixture_offset": "per_episode",
    "offset_range": (2.6 * MM, 3.0 * MM),
    "bound": 3.5 * MM,
    "force_limit": 20.0,
    "mouth_chamfer": 0.1 * MM,
}
"""A jack elsewhere in every episode, farther off than a lead-in catches, and less force than pressing on the rim takes.

The search is short, and the jack as far off as an action reaches: whoever wanders over the rim at random is mostly
nearer to its middle, whoever feels on which side of it the plug stands arrives. What an action is worth does not change
until the plug drops in, or a constant one would sweep across the rim by itself.
"""
