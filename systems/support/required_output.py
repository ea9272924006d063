"""Check that an output of a system is read, because a diagram in which it is not connected would be unsafe.

Used by `PhaseWrenchLimit` and `SctStateMachine`, which raise the error.
"""

import numpy as np
from pydrake.systems.framework import Context, LeafSystem

from guiderail.systems.support import declarations as declare


class ReadFlag:
    """Flag in the cache of a context: True if an output was computed since the last initialization.

    A system has no access to the diagram that it is a part of. But systems that follow a limit evaluate it in their own
    initialization (`LastValidBound`), so that an output that was not computed then is not connected to any of them.

    Args:
        system: System under construction, in which a cache entry and an event are declared.
    """

    def __init__(self, system: LeafSystem):
        self._entry = declare.cache(system, "is_read", lambda context: True, [system.nothing_ticket()])
        # Initialization updates of the abstract state precede those of the discrete state, in which outputs are read.
        system.DeclareInitializationUnrestrictedUpdateEvent(
            lambda context, state: context.SetAllCacheEntriesOutOfDate()
        )

    def marked(self, context: Context, value: np.ndarray) -> np.ndarray:
        """Set the flag and return `value`, in the computation of the output."""
        self._entry.Eval(context)
        return value

    def is_set(self, context: Context) -> bool:
        """Return True if the output was computed since the last initialization."""
        return not self._entry.is_out_of_date(context)
