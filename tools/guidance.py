"""Kinds of guidance: the one place where tools ask what to call them, and in which a policy has a demonstration."""

# Guidance in which an action of zero is the demonstration, so that step-0 success can be stated.
DEMONSTRATED = ("kmp", "residual", "safe_residual", "kgrl", "skgrl")
COLOURS = {
    "none": "#7f7f7f",
    "sct": "#9467bd",
    "kmp": "#333333",
    "residual": "#d62728",
    "safe_residual": "#ff7f0e",
    "kgrl": "#1f77b4",
    "skgrl": "#2ca02c",
}
NAMES = {
    "none": "RL",
    "sct": "RL-SCT",
    "kmp": "demonstration alone",
    "residual": "residual RL",
    "safe_residual": "safe residual RL",
    "kgrl": "KGRL",
    "skgrl": "sKGRL",
}
