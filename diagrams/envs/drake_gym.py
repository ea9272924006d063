"""Reset of Drake's own Gymnasium environment."""

from collections.abc import Callable

from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import Context


def drake_gym_reset(
    set_start: Callable[[Simulator, Context, int | None], object] | None = None,
) -> Callable[[Simulator, Context, int | None], None]:
    """Return a `reset_handler` of `pydrake.gym.DrakeGymEnv` for diagrams with systems of this package.

    Drake initializes the simulator and then replaces the context by its defaults or by random values. The commands of
    these systems begin at the measured pose of an initialization, and without one they are refused. The handler
    therefore initializes again after the start is set.

    Args:
        set_start: Function of simulator, root context and seed that sets the start, such as joint positions; None: the
            defaults of the diagram.
    """

    def reset(simulator: Simulator, context: Context, seed: int | None) -> None:
        if set_start is not None:
            set_start(simulator, context, seed)
        simulator.Initialize()

    return reset
