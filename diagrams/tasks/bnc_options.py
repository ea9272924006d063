"""What can be chosen of the connector, and what is chosen where it is hard."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import Field, field_validator

from guiderail.diagrams.options import Number
from guiderail.diagrams.stations.bnc_workcell import BncWorkcell
from guiderail.diagrams.tasks.bnc_uncertainty import LARGEST_GRASP_ANGLE
from guiderail.diagrams.tasks.hidden_place import HiddenPlace
from guiderail.models.insertion import COLLISION_FORCE
from guiderail.models.objects.bnc_connector import BncDimensions
from guiderail.models.objects.bnc_sdf import FRICTION, MARGIN
from guiderail.models.units import MM

ALIGNMENT = 2.0 * MM  # |x|, |y| of every command: equation 4.26
DRAWN = BncDimensions()
SHIPPED = ("insert", "search")  # demonstrations


class BncOptions(HiddenPlace):
    """Of the connector."""

    jack_turn: Number = Field(0.0, ge=0, le=10, description="largest turn of the jack about its axis [degrees]")
    grasp_angle: Number = Field(0.0, ge=0, le=LARGEST_GRASP_ANGLE, description="largest tilt of the plug [degrees]")
    start_beside: Number = Field(0.0, ge=0, le=ALIGNMENT, description="how far beside its start the tool may begin [m]")
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
    "observation": "lever",
    "demonstrations": "search",
    "hold": 5,
    "uncertainty": "disc",
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
