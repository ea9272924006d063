"""Wiring: stations, guidance, tasks, and the Gymnasium environments made of them.

Importing this package registers the environments; so does Gymnasium itself, through its plugin entry point. Neither
imports Drake before an environment is made.
"""

import gymnasium

TASKS = {
    "BncConnector": "guiderail.diagrams.tasks.bnc_connector:make_env",
    "GridClamp": "guiderail.diagrams.tasks.grid_clamp:make_env",
    "NarrowPassage": "guiderail.diagrams.tasks.narrow_passage:make_env",
    "Pouring": "guiderail.diagrams.tasks.pouring:make_env",
}


def register_envs() -> None:
    """Registers `guiderail/<Task>-v0` for every task; calling it again changes nothing."""
    for task, entry_point in TASKS.items():
        name = f"guiderail/{task}-v0"
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=entry_point)


register_envs()
