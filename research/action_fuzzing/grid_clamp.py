"""Tries to make the clamp fail: random, held and saturated actions through every guidance that it has.

All of them stay in the template's cuboid. A clamp that is held back makes the command wait, which is a fallback.
"""

from research.action_fuzzing.campaign import Campaign, Case


def campaign() -> Campaign:
    """The template, six velocities and a residual, each in the cuboid; what pushes too hard is a collision."""
    cases = [
        Case(
            f"{guidance}, {fixture_offset}",
            {"guidance": guidance, "fixture_offset": fixture_offset, "action_repeat": 1},
            constrained=True,
            options={"new_run": True},
            waits=True,
        )
        for guidance in ("sct", "none", "residual")
        for fixture_offset in ("per_run", "per_episode")
    ]
    return Campaign("GridClamp", cases, {"collisions": 0})
