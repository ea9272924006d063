"""Fuzzing of the narrow passage: actions towards walls, obstacle and restricted zone."""

import itertools

from research.action_fuzzing.campaign import Campaign, Case


def campaign() -> Campaign:
    """Return the campaign: KGRL and sKGRL, at two action repeats, must satisfy the constraint and touch no wall.

    Safe residual learning may stop before walls. Residual learning and the demonstrations are not constrained; they
    check the simulation.
    """
    cases = [
        Case(
            f"{guidance}, action repeat {action_repeat}",
            {"guidance": guidance, "action_repeat": action_repeat},
            constrained=True,
        )
        for guidance, action_repeat in itertools.product(("kgrl", "skgrl"), (1, 5))
    ]
    cases += [
        Case("safe_residual", {"guidance": "safe_residual", "action_repeat": 5}, constrained=True, may_wait=True),
        Case("residual", {"guidance": "residual", "action_repeat": 5}, constrained=False, limits={}),
        Case("kmp", {"guidance": "kmp", "action_repeat": 5}, constrained=False, limits={}),
    ]
    return Campaign("NarrowPassage", cases, {"collisions": 0})
