"""Fuzzing of tasks with actions that no trained policy sends, `python -m research.action_fuzzing TASK`."""

CAMPAIGNS = {
    "BncConnector": "bnc_connector",
    "GridClamp": "grid_clamp",
    "NarrowPassage": "narrow_passage",
    "Pouring": "pouring",
}
ALL = "all"
