"""The environments of all tasks, as Gymnasium knows them."""

import gymnasium

from guiderail.diagrams.tasks.registry import TASKS, environment_id


def register_envs() -> None:
    """Registers `guiderail/<Task>-v0`, or `<namespace>/<Task>-v0`, for every task; calling it again adds new ones."""
    for name in TASKS.names():
        if environment_id(name) not in gymnasium.registry:
            gymnasium.register(
                id=environment_id(name), entry_point="guiderail.diagrams.make:make_env", kwargs={"task": name}
            )
