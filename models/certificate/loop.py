"""A primitive in its loop: what is certified, and the motions that its free regime consists of."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from guiderail.models.primitives.lc_ns_kmp import LcNsKmp


@dataclass(frozen=True)
class SharedControlTemplate:
    """A primitive in its loop.

    Attributes:
        primitive: of the skill.
        gains: (O,), what an action of one is worth; zero for outputs that no action moves.
        period: between two commands [s].
        start, start_within: (O,) each, where the robot is when it begins, and how far beside.
    """

    primitive: LcNsKmp
    gains: np.ndarray
    period: float
    start: np.ndarray
    start_within: np.ndarray


@dataclass(frozen=True)
class Bounds:
    """Of a regime: lower and upper (N, O) of the command, largest speed and acceleration (N, O) in its units per s, s².

    A speed is that of the step before; infinite where nothing is known. The first commands have none.
    """

    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray
    acceleration: np.ndarray


def reach(skill: SharedControlTemplate) -> tuple[np.ndarray, np.ndarray]:
    """The motion without actions (P + N, O), the start before it, and the generators around it (P + N, O, B)."""
    primitive, past = skill.primitive, skill.primitive.history
    steps, outputs = primitive.num_steps, primitive.num_outputs
    moved = np.flatnonzero(skill.gains)
    batch = steps * len(moved) + (outputs if past else 0)
    middle, generators = np.zeros((past + steps, outputs)), np.zeros((past + steps, outputs, batch))
    if past:
        middle[:past] = skill.start
        generators[:past, :, batch - outputs :] = np.diag(skill.start_within)
    for n in range(steps):
        of_history, of_action, offset = primitive.linear_response(n)
        middle[past + n] = offset
        if past:
            middle[past + n] += of_history @ middle[n : past + n].ravel()
            generators[past + n] = of_history @ generators[n : past + n].reshape(past * outputs, batch)
        generators[past + n, :, n * len(moved) : (n + 1) * len(moved)] += of_action[:, moved] * skill.gains[moved]
    return middle, generators


def caps(skill: SharedControlTemplate) -> tuple[np.ndarray, np.ndarray]:
    """The least and the greatest value (N, O) that the constraints on a single output leave it."""
    primitive = skill.primitive
    G, c = primitive.constraints.window(np.arange(primitive.num_steps))
    lower, upper = np.full((2, primitive.num_steps, primitive.num_outputs), [[[-np.inf]], [[np.inf]]])
    for n, row in itertools.product(range(primitive.num_steps), range(G.shape[1])):
        alone = np.flatnonzero(G[n, row])
        if len(alone) == 1:
            o, bound = alone[0], c[n, row] / G[n, row, alone[0]]
            if G[n, row, o] > 0.0:
                lower[n, o] = max(lower[n, o], bound)
            else:
                upper[n, o] = min(upper[n, o], bound)
    return lower, upper
