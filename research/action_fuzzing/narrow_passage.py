"""Tries to make the narrow passage fail: random, held and saturated actions against walls, obstacle and zone."""

import itertools

from research.action_fuzzing.campaign import Campaign, Case


def campaign() -> Campaign:
    """KGRL and sKGRL, whose commands must keep the constraint, at two lengths of a decision; no wall may be touched.

    The others are there for the physics: safe residual learning stops before walls, and nothing keeps plain residual
    learning and the demonstrations from anything.
    """
    cases = [
        Case(
            f"{guidance}, hold {action_repeat}",
            {"guidance": guidance, "action_repeat": action_repeat},
            constrained=True,
        )
        for guidance, action_repeat in itertools.product(("kgrl", "skgrl"), (1, 5))
    ]
    cases += [
        Case("safe_residual", {"guidance": "safe_residual", "action_repeat": 5}, constrained=True, waits=True),
        Case("residual", {"guidance": "residual", "action_repeat": 5}, constrained=False, limits={}),
        Case("kmp", {"guidance": "kmp", "action_repeat": 5}, constrained=False, limits={}),
    ]
    return Campaign("NarrowPassage", cases, {"collisions": 0})
