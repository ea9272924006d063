"""Kinds of guidance: the one place where tools ask what to call them, and which have a demonstration."""

from guiderail.diagrams.guidance.registry import GUIDANCE


def is_demonstrated(kind: str | None) -> bool:
    """Whether an action of zero is the demonstration, so that its success can be stated."""
    return kind in GUIDANCE.names() and GUIDANCE.get(str(kind)).demonstrates


def label(kind: str) -> str:
    """What a picture calls a kind of guidance."""
    return GUIDANCE.get(kind).label if kind in GUIDANCE.names() else kind


def colour(kind: str) -> str:
    """Its colour in every picture."""
    return GUIDANCE.get(kind).colour if kind in GUIDANCE.names() else "#8c564b"
