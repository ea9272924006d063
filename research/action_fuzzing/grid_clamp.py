"""Fuzzing of the grid clamp through every guidance; all of them stay in the template's cuboid."""

from research.action_fuzzing.campaign import Campaign, Case


def campaign() -> Campaign:
    """Return the campaign: the template, six velocities and a residual; exceeding the force limit is a collision.

    A clamp that is held back makes the command wait, which counts as a fallback and is allowed.
    """
    cases = [
        Case(
            f"{guidance}, {fixture_offset}",
            {"guidance": guidance, "fixture_offset": fixture_offset, "action_repeat": 1},
            constrained=True,
            options={"new_run": True},
            may_wait=True,
        )
        for guidance in ("sct", "none", "residual")
        for fixture_offset in ("per_run", "per_episode")
    ]
    return Campaign("GridClamp", cases, {"collisions": 0})
