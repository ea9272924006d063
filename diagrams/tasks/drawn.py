"""What a reset draws, as a signal."""

from __future__ import annotations

import numpy as np
from pydrake.systems.framework import Context, DiagramBuilder, OutputPort
from pydrake.systems.primitives import ConstantVectorSource


class Drawn:
    """Numbers that are constant during an episode, for whoever observes, rewards or ends it."""

    def __init__(self, builder: DiagramBuilder, name: str, size: int):
        """Adds their source to the builder; they are zero until a reset sets them."""
        self._source = builder.AddNamedSystem(name, ConstantVectorSource(np.zeros(size)))

    @property
    def port(self) -> OutputPort:
        """Where they come out, (size,)."""
        return self._source.get_output_port()

    def set(self, root_context: Context, values: np.ndarray) -> None:
        """Sets them, (size,); the context is the root diagram's."""
        context = self._source.GetMyMutableContextFromRoot(root_context)
        self._source.get_mutable_source_value(context).SetFromVector(values)
