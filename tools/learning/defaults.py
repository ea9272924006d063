"""How a task is learned where nobody says otherwise: the one place where tools know it."""

from typing import Any

DEFAULTS: dict[str, Any] = {"guidance": "skgrl", "algorithm": "tqc", "preset": "robust", "episodes": 60, "seed": 0}

# Tasks that were measured with a learner and settings of their own; taken where neither is asked for.
OWN_DEFAULTS: dict[str, dict[str, Any]] = {
    "GridClamp": {"guidance": "sct", "algorithm": "sac", "preset": "clamp"},
    "Pouring": {"guidance": "sct", "algorithm": "sac", "preset": "pouring"},
}
