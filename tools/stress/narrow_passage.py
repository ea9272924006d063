"""Tries to make the narrow passage fail: random, held and saturated actions against walls, obstacle and zone."""

import itertools

from guiderail.tools.stress.campaign import Campaign, Case


def campaign() -> Campaign:
    """KGRL and sKGRL, whose commands must keep the constraint, at two lengths of a decision; no wall may be touched."""
    cases = [
        Case(f"{guidance}, hold {hold}", {"guidance": guidance, "hold": hold}, constrained=True)
        for guidance, hold in itertools.product(("kgrl", "skgrl"), (1, 5))
    ]
    return Campaign("NarrowPassage", cases, {"collisions": 0})
