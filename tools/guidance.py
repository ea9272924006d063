"""Kinds of guidance: the one place where tools ask what to call them, and in which a policy has a demonstration."""

_DEMONSTRATED = ("kmp", "residual", "safe_residual", "kgrl", "skgrl")
_LABELS = {
    "none": ("RL", "#7f7f7f"),
    "sct": ("RL-SCT", "#9467bd"),
    "kmp": ("demonstration alone", "#333333"),
    "residual": ("residual RL", "#d62728"),
    "safe_residual": ("safe residual RL", "#ff7f0e"),
    "kgrl": ("KGRL", "#1f77b4"),
    "skgrl": ("sKGRL", "#2ca02c"),
}


def guidance_names() -> list[str]:
    """Every kind that there is; which of them make sense depends on the task."""
    return list(_LABELS)


def is_demonstrated(kind: str | None) -> bool:
    """Whether an action of zero is the demonstration, so that its success can be stated."""
    return kind in _DEMONSTRATED


def label(kind: str) -> str:
    """What a picture calls a kind of guidance."""
    return _LABELS[kind][0] if kind in _LABELS else kind


def colour(kind: str) -> str:
    """Its colour in every picture."""
    return _LABELS[kind][1] if kind in _LABELS else "#8c564b"
