"""State of an episode between two steps of an environment, as `DiagramEnv.save` returns it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.systems.framework import Context, Diagram

from guiderail.diagrams.envs.trace import EpisodeTrace


@dataclass(frozen=True)
class EpisodeState:
    """Everything on which the rest of an episode and the next resets depend; `DiagramEnv.restore` does not change it.

    It holds a context of the environment's diagram, so it exists in this process only and fits environments that run
    this diagram.
    """

    diagram: Diagram  # diagram that the context belongs to
    context: Context  # time, state and parameters
    action: np.ndarray  # last action, (A,)
    rng: Mapping[str, Any]  # state of the random generator that resets draw from
    trace: EpisodeTrace  # copy of the trace
    fields: Mapping[str, Any]  # attributes of the environment by name
