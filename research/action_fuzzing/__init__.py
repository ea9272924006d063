"""Episodes of actions that no policy should send: a module for each task that is tried."""

STRESSED = {
    "BncConnector": "bnc_connector",
    "GridClamp": "grid_clamp",
    "NarrowPassage": "narrow_passage",
    "Pouring": "pouring",
}
EVERY = "all"


def stressed() -> list[str]:
    """What can be stressed."""
    return [*STRESSED, EVERY]
